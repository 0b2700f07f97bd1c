"""A scene lit by an asset, ready to be drawn by any renderer."""

from contextlib import contextmanager

from ..lighting.to_mitsuba import lit_scene
from ..scene.scene import Scene
from ..system.registry import Registry
from .display import check_exposure, exposure_factor
from .image import pick_sensor, render_image, resized
from .integrator import check_direct

RENDERERS = Registry("renderer", "mi_prt.render")


class Picture:
    """A scene under light of any kind, with the light that an asset gives it.

    Parameters
    ----------
    asset : Asset
    scene : Scene
        The asset's.
    light : Light
        Resolved.
    component : 'total', 'direct' or 'indirect'
    direct : 'points' or 'pixels'
        Whether direct light of local lights is computed at the points or at each pixel.
    nearest : int, optional
        See `Asset.irradiance`.
    exposure : 'auto' or float
        Of displayed pictures: EV, or what takes their log-average luminance to mid grey.
    """

    def __init__(
        self,
        asset,
        scene,
        light,
        component="total",
        direct="points",
        nearest=None,
        exposure: float | str = "auto",
    ):
        self._exposure = check_exposure(exposure)
        self.asset, self._opened = asset, scene
        self._component, self._nearest = component, nearest
        self._at_pixels = check_direct(direct) == "pixels" and component != "indirect"
        self.move(light)

    def move(self, light):
        """Take other light."""
        self.light = light
        self._distant = self.asset.shared_out(light.distant)
        self._local = self.asset.shared_out(light.local)

    @property
    def direct(self):
        """Where direct light of local lights is computed."""
        return "pixels" if self._at_pixels and not self.light.local.is_empty else "points"

    def at_points(self):
        """Irradiance (n, 3) of the component at the points."""
        return self.component_at_points(self._component)

    def component_at_points(self, component):
        """Irradiance (n, 3) of another component at the points."""
        return self._answered(self._distant, component) + self._answered(self._local, component)

    def holds(self, component):
        """Whether all transports that answer tell a component apart."""
        kinds = {*self._distant, *self._local}
        return all(component in self.asset.transports[kind].components for kind in kinds)

    def irradiance(self):
        """Irradiance (n, 3) that is interpolated between the points: what pixels do not compute."""
        if self.direct == "points":
            return self.at_points()
        irradiance = self._answered(self._distant, self._component)
        if self._component == "total":
            irradiance += self._answered(self._local, "indirect")
        return irradiance

    def _answered(self, shares, component):
        return self.asset.answered(shares, component, self._nearest)

    def exposure(self):
        """Factor for displaying pictures, from the radiance at the points."""
        shown = ~self.asset.buried
        return exposure_factor(
            self._exposure, self.asset.outgoing_radiance(self.at_points())[shown]
        )

    def lit(self):
        """The Scene as it is seen: under its light."""
        return Scene(lit_scene(self._opened, self.light), self._opened.source)

    @contextmanager
    def drawn(self, sensor=0, size=None, renderer="mitsuba", spp=64, samples=2):
        """A context in which a function takes irradiance (n, 3) to an image (h, w, 3).

        Parameters
        ----------
        sensor : int
        size : (width, height), optional
        renderer : str
            One of `RENDERERS`.
        spp : int
            Samples per pixel of the integrator.
        samples : int
            Of a raster image, along each side of a pixel.

        Raises
        ------
        SettingsError
            If there is no renderer of that name, or it cannot draw this.
        """
        draw = RENDERERS[renderer]
        lit = self.lit()
        with (
            resized(pick_sensor(lit.mi_scene, sensor), size) as camera,
            draw(self, lit, camera, spp, samples) as image,
        ):
            yield image


@RENDERERS.add("mitsuba")
@contextmanager
def _by_integrator(picture, lit, camera, spp, samples):
    """The integrator `prt`."""
    yield lambda irradiance: render_image(
        picture.asset, lit.mi_scene, camera, spp, irradiance=irradiance, direct=picture.direct
    )
