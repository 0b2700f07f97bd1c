"""The Mitsuba integrator `prt`: any sensor and film, lit from an asset in one ray per sample."""

import os
import warnings
from functools import cache
from pathlib import Path

import numpy as np

from ..asset.asset import load
from ..asset.provenance import REPAINTED
from ..errors import SettingsError
from ..lighting.environment import LightWarning
from ..scene.scene import Scene, SceneSource
from ..scene.traversal import digest_of
from ..system.passing import pass_errors_through, remembered
from ..system.runtime import VARIANTS, mitsuba
from .direct_light import LocalEmitters
from .repainted import is_repainted
from .shade import reflected_radiance

DIRECT = ("points", "pixels")


def register_integrator():
    """Register the plugin `prt` in the variants of `runtime.VARIANTS`, now and whenever one is
    set.
    """
    try:
        import mitsuba as mi
    except (ImportError, NameError):
        # a broken installation: `mi-prt doctor` must still start, and everything else raises a
        # typed error
        return

    mi.detail.add_variant_callback(lambda old, new: _register(new))
    if mi.variant() is not None:
        _register(mi.variant())


def _register(variant):
    if variant is None:
        return
    import mitsuba as mi

    made = _plugin_class(variant) if variant in VARIANTS else _refused
    mi.register_integrator("prt", made)
    if variant in VARIANTS:
        pass_errors_through(mi)


def _refused(properties):
    """In place of the plugin in other variants, in which it would not be found."""
    return mitsuba()  # raises: it names the variants that can be set


@cache
def _plugin_class(variant):
    """The plugin for a variant, while that is set: its base class is another one in each."""
    import drjit as dr
    import mitsuba as mi

    class PRTIntegrator(mi.SamplingIntegrator):
        """Precomputed radiance transfer (`prt`).

        Shows a scene under its emitters with the transports of an asset. The irradiance at the
        asset's points is interpolated at each hit and multiplied by the albedo there, so textures
        keep their own resolution; emitters and the background are shown as Mitsuba's own
        integrators show them.

        Parameters (plugin)
        -------------------
        filename : str
            The asset; relative paths are resolved as Mitsuba resolves them (next to the XML file).
        hide_emitters : bool, default false
        direct : string, default "points"
            Where direct light of local emitters is computed: at the asset's "points", or with
            shadow rays at the "pixels".

        Raises
        ------
        AssetError
            If the file cannot be read.
        SceneError
            When rendering a scene whose geometry is not that of the asset.
        LightError
            When rendering a scene without such emitters.
        SettingsError
            If `direct` is another.

        Warns
        -----
        LightWarning
            When rendering a scene whose materials are not those of the asset's reflected light.
        """

        def __init__(self, properties, asset=None, irradiance=None, direct=None):
            super().__init__(properties)
            with remembered():
                self.asset = asset or _load(_filename(properties))
                self._direct = check_direct(direct or str(properties.get("direct", "points")))
            self._follows_emitters = irradiance is None
            self._irradiance = None if irradiance is None else mi.Float(irradiance.ravel())
            self._scene = self._light = self._emitters = None

        def render(self, scene, sensor=0, *arguments, **named):
            self._prepare(scene)
            return super().render(scene, sensor, *arguments, **named)

        def _prepare(self, scene):
            """Once for each image: emitters and shapes may have been edited since the last one."""
            opened = Scene(scene, SceneSource("object", content=scene))
            if self._scene is not scene or self._wrapped.hash != opened.hash:
                self._scene = None  # until the new one is known to fit
                self._locator = self.asset.points.locator(opened)
                self._wrapped, self._scene, self._light = opened, scene, None
                self._warn_of_paint(opened)
            elif self._wrapped.appearance != opened.appearance:
                self._wrapped = opened
                self._warn_of_paint(opened)
            light = digest_of(opened.mi_scene.emitters())
            if self._light == light:
                return
            if self._direct == "pixels":
                self._emitters = LocalEmitters(opened)
            if self._follows_emitters:
                self._irradiance = mi.Float(
                    under_emitters(self.asset, opened, self._direct).ravel()
                )
            self._light = light

        def _warn_of_paint(self, opened):
            # Whoever gives the irradiance has opened the scene, and been told.
            if self._follows_emitters and is_repainted(self.asset, opened):
                warnings.warn(REPAINTED, LightWarning, stacklevel=4)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            if self._scene is not scene:
                self._prepare(scene)
            pi, si = self._first_hit(scene, mi.Ray3f(ray), mi.Bool(active))
            hit = active & si.is_valid()

            # --- light that the surface reflects
            irradiance, found = self._locator.interpolated(self._irradiance, pi, si, ray, hit)  # pyright: ignore[reportOptionalMemberAccess]
            if self._emitters is not None:
                irradiance += self._emitters.irradiance(si, ray, sampler, hit)
                found = hit
            radiance = reflected_radiance(irradiance, si, self._wrapped.surfaces, found)

            # --- light that is seen directly
            if self.hide_emitters:
                return radiance, hit, []
            radiance += dr.select(active, si.emitter(scene, active).eval(si, active), 0)
            return radiance, hit if scene.environment() is None else mi.Bool(active), []

        def _first_hit(self, scene, ray, active):
            """The first intersection; with hide_emitters the first that is no area light.

            Mitsuba's own `skip_area_emitters` measures distances from the last light it passed,
            which puts hits on analytic shapes elsewhere.
            """

            def trace(ray, active):
                pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
                si = self._wrapped.interaction(pi, ray, active)  # pyright: ignore[reportOptionalMemberAccess]
                return pi, si, active & si.is_valid() & si.shape.is_emitter()

            pi, si, lamp = trace(ray, active)
            if not self.hide_emitters:
                return pi, si

            def pass_through(ray, pi, si, lamp):
                ray = dr.select(lamp, si.spawn_ray(ray.d), ray)
                behind, surface, another = trace(ray, lamp)
                return ray, dr.select(lamp, behind, pi), dr.select(lamp, surface, si), another

            _, pi, si, _ = dr.while_loop(
                (ray, pi, si, lamp), lambda ray, pi, si, lamp: lamp, pass_through
            )
            return pi, si

        def to_string(self):
            return f"PRTIntegrator[filename={self.asset.path}, points={len(self.asset.points)}]"

    return PRTIntegrator


def under_emitters(asset, scene, direct="points"):
    """Irradiance at an asset's points under the emitters of a scene, as they are now.

    Parameters
    ----------
    asset : Asset
    scene : Scene
        Of the asset's geometry, whose lamps may have been dimmed, and its sky replaced.
    direct : str
        'pixels' leaves direct light of local emitters out.

    Returns
    -------
    (n, 3) float32
        W/m².

    Raises
    ------
    LightError
        If the asset holds no transport for any of the emitters, or a lamp whose light is baked was
        changed otherwise than by dimming it.
    """
    light = asset.as_baked(scene)
    if direct == "points" or light.local.is_empty:
        return asset.irradiance(light)
    irradiance = asset.irradiance(light.local, "indirect")
    return irradiance if light.distant.is_empty else irradiance + asset.irradiance(light.distant)


def check_direct(direct):
    """Where direct light is computed, checked: 'points' or 'pixels'."""
    if direct not in DIRECT:
        raise SettingsError(f"direct '{direct}' is not known: use {' or '.join(DIRECT)}")
    return direct


def integrator_for(asset, irradiance=None, direct="points"):
    """The integrator for an asset in memory.

    Parameters
    ----------
    asset : Asset
    irradiance : (n, 3), optional
        W/m² at the asset's points; by default that under the emitters of the scene it renders.
    direct : 'points' or 'pixels'
        Whether direct light of the local emitters of the scene it renders is computed at each hit,
        beside that irradiance.

    Returns
    -------
    mi.Integrator

    Raises
    ------
    SettingsError
        If the irradiance is of another shape.
    """
    mi = mitsuba()
    if irradiance is not None:
        irradiance = np.asarray(irradiance, dtype=np.float32)
        if irradiance.shape != (len(asset.points), 3):
            raise SettingsError(
                f"irradiance must be of shape ({len(asset.points)}, 3), got {irradiance.shape}"
            )
    return _plugin_class(mi.variant())(mi.Properties("prt"), asset, irradiance, direct)  # pyright: ignore[reportCallIssue]


def _filename(properties):
    if "filename" not in properties:
        raise SettingsError(
            "the integrator prt needs a filename: that of an asset (mi-prt precompute)"
        )
    return str(properties["filename"])


def _load(filename):
    import mitsuba as mi

    found = Path(str(mi.file_resolver().resolve(filename)))  # pyright: ignore[reportCallIssue]
    return load(found if os.path.exists(found) else filename)
