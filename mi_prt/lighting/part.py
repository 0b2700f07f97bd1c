"""What every light can do, and all kinds of light by their names.

A kind of light is one file with one class, derived from `DistantPart` or `LocalPart` and registered
in `LIGHTS`.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

from ..errors import LightError
from ..system.registry import Registry

LIGHTS = Registry("light", "mi_prt.lighting", LightError)


class LightPart(ABC):
    """One light of a sum of lights.

    Attributes
    ----------
    kind : str
        Its name in texts: what stands before the first colon.
    FORM : str
        The form of its text, for help and errors.
    is_distant : bool
        Whether its light comes from infinity.
    is_environment : bool
        Whether Mitsuba shows it as an environment, of which a scene takes only one. It then has
        `size` (rows, columns), `rotation` (3, 3), `at(vectors)` (k, 3), `quadrature(spacing)` and
        `pixels`, (h, w, 3) or None, as `EnvironmentMap` has them, so that several are summed.
    is_movable : bool
        Whether `moved` takes it elsewhere.
    is_shape : bool
        Whether it is a shape in Mitsuba, which is seen and blocks light.
    of_scene : bool
        Whether it stands for lights of the scene that `resolve` has not looked up yet.
    own_name : str or None
        Name of the scene's own lamp that it is.
    lacks_emitter : bool
        Whether it is such a lamp of a scene that is not open, known by its name only.
    """

    kind: ClassVar[str]
    FORM: ClassVar[str] = ""
    is_distant: ClassVar[bool]
    is_environment: ClassVar[bool] = False
    is_movable: ClassVar[bool] = False
    is_shape: ClassVar[bool] = False
    of_scene: ClassVar[bool] = False
    own_name = None
    lacks_emitter = False
    __array_ufunc__ = None  # so that NumPy leaves `array * part` to the part

    @property
    def words(self):
        """What it is, in words for messages."""
        return f"{self.kind} light"

    @classmethod
    def parse(cls, text):
        """A light from the text behind "kind:".

        Raises
        ------
        ValueError
            If the text is not of its form.
        LightError
            If there cannot be a light of these values.
        """
        raise ValueError(f"{cls.__name__} has no text form")

    @abstractmethod
    def to_mitsuba(self):
        """The plugin dict of an emitter, or of a shape that shines, for a Mitsuba scene."""

    @abstractmethod
    def scaled(self, factor):
        """The same light times a factor: one number or RGB, not negative."""

    @abstractmethod
    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`,
        right-handed. Local lights stay as they are.
        """

    def resolved(self, own_lights):
        """The parts (tuple) that it is in a scene, see `own_light.resolve`."""
        return (self,)

    def __mul__(self, factor):
        return self.scaled(factor)

    __rmul__ = __mul__


class DistantPart(LightPart):
    """Light from infinity."""

    is_distant = True

    @abstractmethod
    def radiance(self, directions, samples_per_side):
        """Mean radiance of each cell of a direction lattice.

        Parameters
        ----------
        directions : direction lattice
        samples_per_side : int
            Least number of samples along the side of a cell, where it is sampled.

        Returns
        -------
        (s, 3) float64
            W/(m²·sr).
        """


class LocalPart(LightPart):
    """Light from somewhere in the scene. Movable ones have a `position` (3,) too."""

    is_distant = False

    @abstractmethod
    def emission(self):
        """The places that it shines from, an Emission."""

    def rotated(self, axis, degrees):
        """The same light: only distant light turns."""
        return self

    def moved(self, position):
        """The same light at another position (3,), in m.

        Raises
        ------
        LightError
            If it cannot be moved.
        """
        raise LightError(f"a {self.words} cannot be moved: use a point, spot or area light")
