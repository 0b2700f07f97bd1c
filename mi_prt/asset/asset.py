"""The asset: points, and transports of light to them."""

import warnings
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from ..errors import LightError, SettingsError
from ..lighting.environment import LightWarning
from ..lighting.light import Light
from ..lighting.own_light import SceneLight, resolve
from ..points.points import Points
from ..system.registry import Registry
from ..transport.ledger import Entry
from ..transport.transport import COMPONENTS, TRANSPORTS, Question
from . import file
from .batch import batch_irradiance
from .describe import summary_line, summary_table
from .provenance import open_scene_of, scene_is_open

DRAWINGS = Registry("drawing", "mi_prt.render")  # what draws an asset; it lies above this layer


@dataclass(frozen=True, eq=False, repr=False)
class Asset:
    """A scene's precomputed transport: everything that relighting needs.

    Parameters
    ----------
    points : Points
    transports : dict
        By kind: 'distant', 'own', 'local', those that there are.
    emitters : tuple of dict
        name, kind and `distant` (bool) of each emitter of the scene.
    scene : dict
        kind, path, parameters, hash, appearance and left_out (what of the scene is not modelled).
    settings : dict
        What the run used.
    versions : dict
    report : dict
        What was counted and measured, beside the reports of the transports.
    path : Path or None
        The file it was loaded from or saved to.
    """

    points: Points
    transports: dict
    emitters: tuple
    scene: dict
    settings: dict
    versions: dict
    report: dict
    path: Path | None = field(default=None, compare=False)

    def __repr__(self):
        return summary_line(self)

    def _repr_html_(self):
        """A table for notebooks."""
        return summary_table(self)

    # --- light --------------------------------------------------------------------------------

    @property
    def own_lights(self):
        """The scene's own lights by name, each a part of light that can be dimmed:
        `asset.own_lights["lamp_2"] * 0.3`.
        """
        return {emitter["name"]: SceneLight(emitter["name"]) for emitter in self.emitters}

    def resolved(self, light=None, rotate=None, scene=None):
        """Light with the scene's own in the place of 'scene'.

        Parameters
        ----------
        light : what `as_light` accepts, 'scene', or a list of these, optional
            By default the scene's own light, all of it.
        rotate : (axis, degrees), optional
            Turns the distant light.
        scene : Scene, path, dict or mi.Scene, optional
            Needed where the light contains distant light of the scene, or lamps whose light is not
            baked, and only then opened; by default where it was.

        Returns
        -------
        Light

        Raises
        ------
        LightError
            If the scene has no light of a name, or none at all.
        SceneError
            If the scene is needed and not to be had.
        SettingsError
            If there is no distant light to turn.
        """
        return self._resolved(light, rotate, scene, cache(lambda: open_scene_of(self, scene)))

    def _resolved(self, light, rotate, scene, opened):
        """See `resolved`; `opened` gives the Scene."""
        if light is None:
            light = self._own_light()
        names = {emitter["name"]: emitter["distant"] for emitter in self.emitters}
        if scene_is_open(scene):
            light = resolve(light, scene)
        else:
            light = resolve(light, opened, names)
            if any(map(self._needs_scene, light.parts)):
                light = resolve(light, opened())
        if rotate is None:
            return light
        if light.distant.is_empty:
            raise SettingsError(
                "a rotation turns distant light, and there is none in this light: leave it out"
                " (--rotate)"
            )
        return light.rotated(*rotate)

    def resolved_all(self, lights):
        """Each of several lights resolved, a list of `Light`; the scene is opened once at most."""
        opened = cache(lambda: open_scene_of(self))
        return [self._resolved(light, None, None, opened) for light in lights]

    def _own_light(self):
        """The scene's own light, as far as the asset holds it."""
        emitters = self.emitters
        names = [emitter["name"] for emitter in emitters if self._holds(emitter["distant"])]
        if emitters and not names:
            raise self._holds_none(self.own_lights)
        return [SceneLight(name) for name in names] or SceneLight()

    def _needs_scene(self, part):
        """Whether a part is a lamp that is known by its name only, and whose light is not baked."""
        return part.lacks_emitter and not any(t.takes(part) for t in self.transports.values())

    def _holds(self, is_distant):
        """Whether distant, or local, light of the scene is in the asset: not where transport of
        distant light only stands in for it.
        """
        kinds = ("distant",) if is_distant else ("own", "local")
        return any(kind in self.transports for kind in kinds)

    def _holds_none(self, names):
        return LightError(
            f"of the scene's own lights ({', '.join(names)}) this asset, with transports"
            f" {','.join(self.transports)}, holds none: pass a light, such as --envmap sky.exr or"
            f" --light scene:{next(iter(names))}, or precompute it with --transports"
            f" {','.join([*self.transports, *self._lacking()])}"
        )

    def _lacking(self):
        """Kinds of transport that the scene's own lights ask for, and that are not there."""
        kinds = {"distant" if emitter["distant"] else "own" for emitter in self.emitters}
        return sorted(kinds - set(self.transports))

    def as_baked(self, scene):
        """Light of the emitters of a scene as they are now, as far as the asset holds it.

        Parameters
        ----------
        scene : Scene
            Of the asset's geometry. Lamps may have been dimmed, and the sky replaced.

        Returns
        -------
        Light
            Resolved.

        Raises
        ------
        LightError
            If the scene has no light, or the asset holds none of it, or if a lamp whose light is
            baked was changed otherwise than by dimming it.
        """
        own = self.transports.get("own")
        parts = [p for p in resolve(SceneLight(), scene).parts if self._holds(p.is_distant)]
        if not parts:
            raise self._holds_none([light.name for light in scene.own_lights])
        return Light(
            own.as_baked(part) if own is not None and own.takes(part) else part for part in parts
        )

    def prepare_light(self, light=None, scene=None):
        """The same light in a form that turns in milliseconds.

        >>> sky = asset.prepare_light("sky.exr")
        >>> for degrees in range(360):
        ...     asset.relight(sky.rotated("y", degrees))

        Parameters
        ----------
        light, scene :
            As of `resolved`.

        Returns
        -------
        Light
        """
        light = self.resolved(light, scene=scene)
        for transport in self.transports.values():
            light = transport.prepare(light)
        return light

    def shared_out(self, light):
        """Which transport answers for which part of light.

        Parameters
        ----------
        light : Light
            Resolved.

        Returns
        -------
        dict
            Light by the kind of transport.

        Raises
        ------
        LightError
            If no transport takes a part.
        """
        found = {}
        for part in light.parts:
            transports = [t for t in self.transports.values() if t.takes(part)]
            transports += [t for t in self.transports.values() if t.stands_in_for(part)]
            if not transports:
                held = "; ".join(f"{k} ({t.takes_words})" for k, t in self.transports.items())
                wanted = [k for k, t in TRANSPORTS.items() if t.is_for(part)]
                raise LightError(
                    f"this asset holds no transport for this light ({part.words}); it holds"
                    f" {held}: precompute the scene again with transports"
                    f" {','.join([*self.transports, *wanted])} (--transports)"
                )
            found.setdefault(transports[0].kind, []).append(part)
        return {kind: Light(parts) for kind, parts in found.items()}

    @property
    def components(self):
        """Components of light that all transports tell apart."""
        return [c for c in COMPONENTS if all(c in t.components for t in self.transports.values())]

    # --- relighting ---------------------------------------------------------------------------

    def irradiance(self, light=None, component="total", nearest=None, *, batch=False):
        """Irradiance at the points.

        >>> asset.irradiance([sky, sun])  # their sum, (n, 3)
        >>> asset.irradiance(maps, batch=True)  # each alone, (m, n, 3): one matrix product

        Parameters
        ----------
        light : what `as_light` accepts, 'scene', or a list of these, optional
            Any number of environment maps, directional and local lights and lights of the scene;
            their irradiances add up. By default the scene's own light.
        component : 'total', 'direct' or 'indirect'
        nearest : int, optional
            Directions that stand for a local light where transport is for distant light only
            (Eigentransport, section 4.2.1); by default the three around its own, in shares that
            keep its direction.
        batch : bool
            Whether `light` is a list of m lights (or of lists, their sums), each asked for alone.

        Returns
        -------
        (n, 3) float32, or (m, n, 3) of a batch
            W/m².

        Raises
        ------
        LightError
            If no transport takes a light, or a batch is no list or an empty one.
        SettingsError
            If the component is another, or not there for distant light (see `keep_direct`).

        Warns
        -----
        LightWarning
            If a local light stands in the convex hull of the scene and only transport of distant
            light is there to answer for it: that holds visibility to infinity.
        """
        if batch:
            return batch_irradiance(self, light, component, nearest)
        shares = self.shared_out(self.resolved(light))
        for warning in self.warnings(shares):
            warnings.warn(warning, LightWarning, stacklevel=2)
        return self.answered(shares, component, nearest)

    def warnings(self, shares):
        """What there is to say of light shared out: a list of texts."""
        found = (self.transports[kind].check(self.points, light) for kind, light in shares.items())
        return [warning for warning in found if warning]

    def answered(self, shares, component="total", nearest=None):
        """Irradiance (n, 3) float32 under light shared out, without warnings; see `irradiance`."""
        Question(Light(()), component, nearest)
        total = np.zeros((len(self.points), 3), np.float32)
        for kind, light in shares.items():
            question = Question(light, component, nearest)
            total += self.transports[kind].respond(self.points, question)
        return total

    def relight(self, light=None, component="total", nearest=None, *, batch=False):
        """Outgoing radiance B = ρ/π · E at the points, (n, 3) float32 in W/(m²·sr), or (m, n, 3) of
        a batch; see `irradiance`.
        """
        return self.outgoing_radiance(self.irradiance(light, component, nearest, batch=batch))

    def outgoing_radiance(self, irradiance):
        """Outgoing radiance B = ρ/π · E (n, 3) of irradiance (n, 3) at the points."""
        return irradiance * self._reflection

    @cached_property
    def _reflection(self):
        return self.points.albedo * np.float32(1 / np.pi)

    def render(
        self,
        light=None,
        *,
        sensor=0,
        camera=None,
        size=None,
        spp=64,
        scene=None,
        rotate=None,
        component="total",
        direct="points",
        renderer="mitsuba",
    ):
        """The scene as a camera sees it under some light.

        >>> asset.render("sky.exr", camera=mi_prt.Camera((0, 2, 6), (0, 0, 0)), size=(640, 480))

        Parameters
        ----------
        light : what `as_light` accepts, 'scene', or a list of these, optional
            By default the scene's own light.
        sensor : int
            Index of the scene's sensor.
        camera : Camera, optional
            In its place.
        size : (width, height), optional
            Of the image; by default the sensor's, or 640 × 480 of a camera.
        spp : int
            Samples per pixel of the integrator.
        scene : path, dict or mi.Scene, optional
            The asset's scene, where it was given in memory or is somewhere else by now.
        rotate : (axis, degrees), optional
            Turns the distant light.
        component, direct, renderer :
            As of `relight_to_file`.

        Returns
        -------
        (h, w, 3) float32
            Linear radiance, W/(m²·sr).

        Raises
        ------
        LightError, SceneError, SettingsError
            As of `relight_to_file`.
        """
        return DRAWINGS["image"](
            self,
            light,
            sensor=sensor,
            camera=camera,
            size=size,
            spp=spp,
            scene=scene,
            rotate=rotate,
            component=component,
            direct=direct,
            renderer=renderer,
        )

    def truncated(self, components):
        """The asset with the first so many components of distant transport: a smaller file, faster
        and less exact.

        >>> for d in (16, 32, 64):
        ...     mi_prt.compare(asset.truncated(d), f"report-{d}")

        Parameters
        ----------
        components : int
            1…d, for spherical harmonics a square. All other transport stays as it is.

        Returns
        -------
        Asset
            Whose `captured_variance` and `relative_error` are those of what is left, summed from
            the stored coefficients, and whose report says `truncated_from`.

        Raises
        ------
        SettingsError
            If there is no distant transport, the number is out of range, or the points do not share
            components (the bases haar and none).
        """
        if "distant" not in self.transports:
            raise SettingsError(
                f"this asset, with transports {','.join(self.transports)}, has no components to cut"
                " to: only distant transport has (--transports distant)"
            )
        cut = {k: t.truncated(components, self.points) for k, t in self.transports.items()}
        settings = self.settings | {"coefficients": int(components)}
        return replace(self, transports=cut, settings=settings, path=None)

    # --- what it holds ------------------------------------------------------------------------

    @property
    def buried(self):
        """Points inside or against other geometry, (n,) bool; rendering takes their neighbours'
        light instead.
        """
        return self.points.buried

    @property
    def reflects(self):
        """Whether any transport holds reflected light."""
        return any(t.reflects for t in self.transports.values())

    @property
    def reference_bounces(self):
        """Reflections that the truth has: as many as were asked for; None is any number."""
        bounces = self.settings["bounces"]
        if bounces is None:  # the default: as many as it takes, of what holds reflections
            return None if self.reflects or "distant" not in self.transports else 0
        return None if bounces == "auto" else bounces

    def ledger(self):
        """What is known of the asset's errors, a list of `Entry`."""
        known = [entry for t in self.transports.values() for entry in t.ledger()]
        coverage = self.points.report.get("coverage")
        if isinstance(coverage, float):
            what = "surface with no sample within a spacing, where light may be lost"
            known.append(
                Entry("points", what, 1 - coverage, "reachable surface", "measured", "count")
            )
        return known

    # --- file ---------------------------------------------------------------------------------

    def save(self, path, folder=None, force=False):
        """Write the asset to one file, all or nothing.

        Parameters
        ----------
        path : path
        folder : path, optional
            Where the file is until it is whole: on the same file system, by default in the folder
            of `path`.
        force : bool
            Whether to replace a file that is no asset.

        Raises
        ------
        SettingsError
            If the path cannot be written.
        """
        file.write(self, path, folder, force)
        object.__setattr__(self, "path", Path(path).absolute())


def load(path):
    """Open an asset.

    Parameters
    ----------
    path : path

    Returns
    -------
    Asset

    Raises
    ------
    AssetError
        If the file is missing, damaged, no asset, or of a format version that this program does
        not know.
    """
    return Asset(**file.read(path))
