"""The scene's own lights as parts of light: by name, dimmed, and what they are in a scene."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from ..errors import LightError
from .from_mitsuba import distant_part
from .light import Light, as_light
from .local_emitters import local_part
from .part import LIGHTS, LightPart, LocalPart
from .values import rgb_factor


@LIGHTS.register
@dataclass(frozen=True, eq=False)
class SceneLight(LightPart):
    """The scene's own light, all of it or one by its name, dimmed if need be.

    >>> asset.irradiance(SceneLight("lamp_2") * 0.3)

    Parameters
    ----------
    name : str, optional
        One of `Scene.own_lights`; by default all of them.
    factor : float or (3,) array, default 1
        On its radiance, RGB.
    turns : tuple of (axis, degrees)
        Rotations of its distant light, the first one first.

    Raises
    ------
    LightError
        If the factor is negative or not finite.
    """

    name: str | None = None
    factor: Any = 1.0  # stored as (3,) float64
    turns: tuple = field(default=())

    kind = "scene"
    FORM = "scene (its own), scene:NAME (one of its lights)"
    of_scene = True

    def __post_init__(self):
        object.__setattr__(self, "factor", rgb_factor(self.factor))

    @property
    def words(self):
        """See `LightPart.words`."""
        return "the scene's own light" + (f" '{self.name}'" if self.name else "")

    @classmethod
    def parse(cls, text):
        """See `LightPart.parse`."""
        return cls(text or None)

    @property
    def is_distant(self):
        """Not known before it is looked up.

        Raises
        ------
        LightError
            Always.
        """
        raise LightError(f"{self.words} has to be looked up in the scene first: use resolve")

    def to_mitsuba(self):
        """Refused as `is_distant` is."""
        return self.is_distant

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(self, factor=self.factor * rgb_factor(factor))

    def rotated(self, axis, degrees):
        """See `LightPart.rotated`."""
        return replace(self, turns=(*self.turns, (axis, degrees)))

    def resolved(self, own_lights):
        """See `LightPart.resolved`."""
        return tuple(
            self._distant(own_lights.opened(name)) if is_distant else Lamp(name, self.factor, own)
            for name, is_distant, own in own_lights.named(self.name)
        )

    def _distant(self, own):
        part = distant_part(own)
        for axis, degrees in self.turns:
            part = part.rotated(axis, degrees)
        return part if (self.factor == 1).all() else part.scaled(self.factor)


@dataclass(frozen=True, eq=False)
class Lamp(LocalPart):
    """A local light of the scene itself.

    Parameters
    ----------
    name : str
    factor : (3,) array or float
        On its radiance, RGB.
    own : OwnLight or None
        The emitter; None where the scene is not open.
    """

    name: str
    factor: Any = 1.0  # stored as (3,) float64
    own: Any = None

    kind = "lamp"

    def __post_init__(self):
        object.__setattr__(self, "factor", rgb_factor(self.factor))

    @property
    def own_name(self):
        """See `LightPart.own_name`."""
        return self.name

    @property
    def lacks_emitter(self):
        """See `LightPart.lacks_emitter`."""
        return self.own is None

    @property
    def words(self):
        """See `LightPart.words`."""
        return f"the scene's lamp '{self.name}'"

    @property
    def is_shape(self):
        """Whether it is a shape that shines; False where the scene is not open."""
        return self.own is not None and self.own.shape is not None

    def emission(self):
        """Places that shine as the emitter does, see `local_emitters`, times the factor.

        Raises
        ------
        LightError
            If the scene is not open, or the emitter is none that places can stand for.
        """
        return self._emission

    @cached_property
    def _emission(self):
        if self.own is None:
            raise LightError(
                f"{self.words} is known by its name only: to compute its light, pass the scene"
            )
        emission = local_part(self.own.emitter).emission()
        return emission if (self.factor == 1).all() else emission.scaled(self.factor)

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(self, factor=self.factor * rgb_factor(factor))

    def to_mitsuba(self):
        """Refused: it shines in its own scene only, see `to_mitsuba.lit_scene`.

        Raises
        ------
        LightError
            Always.
        """
        raise LightError(f"{self.words} cannot be put into another scene: use lit_scene")

    def resolved(self, own_lights):
        """With its emitter, where the scene is open; see `LightPart.resolved`."""
        if self.own is not None or not own_lights.is_open:
            return (self,)
        return (replace(self, own=own_lights.opened(self.name)),)


def resolve(light, scene, names=None):
    """Light with the scene's own lights in the place of `SceneLight` parts.

    Parameters
    ----------
    light : what `as_light` accepts, or None
        None is all of the scene's own light.
    scene : Scene, callable() -> Scene, or None
        A callable opens the scene, and is called only if something of it is needed.
    names : mapping of str to bool, optional
        Names of the scene's own lights, and whether each is distant, as they were recorded. With
        these, and a scene that is not open, lamps are known by their names only; distant light
        needs the scene.

    Returns
    -------
    Light
        Of distant parts, `Lamp`s, and the parts that were there.

    Raises
    ------
    LightError
        If the scene has no such light, or none at all, or is needed and not given.
    """
    light = as_light(SceneLight() if light is None else light)
    own_lights = _OwnLights(scene, names)
    return Light(sum((part.resolved(own_lights) for part in light.parts), ()))


class _OwnLights:
    """Own lights of a scene that is open, can be opened, or is known by names."""

    def __init__(self, scene, names):
        self.is_open = scene is not None and not callable(scene)
        self._scene, self._names = scene, names

    def named(self, name):
        """(name, is_distant, OwnLight or None) of the light of a name, or of all if it is None."""
        if self.is_open or self._names is None:
            known = [(own.name, own.is_distant, own) for own in self._own_lights]
        else:
            known = [(key, is_distant, None) for key, is_distant in self._names.items()]
        if not known:
            raise LightError(
                "the scene has no light of its own: pass a light (--envmap sky.exr, or --light)"
            )
        found = [entry for entry in known if name in (None, entry[0])]
        if not found:
            raise LightError(
                f"the scene has no light '{name}'; it has"
                f" {', '.join(entry[0] for entry in known)} (--light scene:NAME)"
            )
        return found

    def opened(self, name):
        """The OwnLight of a name."""
        found = [own for own in self._own_lights if own.name == name]
        if not found:
            raise LightError(
                f"the scene has no light '{name}' any more; it has"
                f" {', '.join(own.name for own in self._own_lights) or 'none'}"
            )
        return found[0]

    @cached_property
    def _own_lights(self):
        if self._scene is None:
            raise LightError("the scene's own light is needed: pass the scene, or another light")
        return (self._scene if self.is_open else self._scene()).own_lights  # pyright: ignore[reportAttributeAccessIssue]
