"""HDR images of an asset by Mitsuba, through the integrator `prt`."""

from contextlib import contextmanager

from ..errors import SettingsError
from ..scene.camera import Camera
from ..system.runtime import mitsuba
from .developed import developed
from .integrator import integrator_for
from .rendered import check_film, check_size, rendered


def render_image(asset, mi_scene, sensor, spp=64, seed=0, irradiance=None, direct="points"):
    """Image of a scene lit from an asset.

    Parameters
    ----------
    asset : Asset
    mi_scene : mi.Scene
    sensor : mi.Sensor
    spp : int
        Samples per pixel; they antialias, there is no other noise.
    seed : int
    irradiance : (n, 3), optional
        W/m² at the asset's points; by default that under the scene's emitters.
    direct : 'points' or 'pixels'
        Whether direct light of the scene's local emitters is computed at each hit, beside that
        irradiance.

    Returns
    -------
    (h, w, 3) float32
        Linear radiance.

    Raises
    ------
    SettingsError, SceneError
        See `rendered`.
    """
    integrator = integrator_for(asset, irradiance, direct)
    return developed(mi_scene, sensor, integrator, spp, seed)


def pick_sensor(mi_scene, index):
    """Sensor of a scene by its index, or that of a `Camera`.

    Raises
    ------
    SettingsError
        If there is none of that index.
    """
    if isinstance(index, Camera):
        return mitsuba().load_dict(index.to_mitsuba())
    sensors = mi_scene.sensors()
    if not sensors:
        raise SettingsError(
            "the scene has no sensor: give a camera (--camera 0,2,6:0,0,0), add a sensor to the"
            " scene, or ask for .ply or .npz output, which needs none"
        )
    if not 0 <= index < len(sensors):
        raise SettingsError(
            f"sensor {index} does not exist: the scene has sensors 0…{len(sensors) - 1}"
        )
    return sensors[index]


@contextmanager
def resized(sensor, size):
    """Within the block the sensor's film has another size (width, height); None leaves it as it is.

    Raises
    ------
    SettingsError
        If a side is below 1, here or of the film, or the image would have more than 67 million
        pixels.
    """
    if size is None:
        check_film(sensor)
        yield sensor
        return
    width, height = size
    check_size(width, height)
    parameters = mitsuba().traverse(sensor)
    before = {
        key: list(parameters[key]) for key in ("film.size", "film.crop_size", "film.crop_offset")
    }
    parameters["film.size"] = parameters["film.crop_size"] = [width, height]
    parameters["film.crop_offset"] = [0, 0]
    parameters.update()
    try:
        yield sensor
    finally:
        for key, value in before.items():
            parameters[key] = value
        parameters.update()


def coverage(mi_scene, sensor, spp, seed=0):
    """Share of each pixel that geometry covers, (h, w) float32: 1 inside silhouettes, 0 on the
    background.
    """
    mi = mitsuba()

    class Coverage(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active).is_valid()
            return mi.Color3f(0), active, [mi.Float(hit)]

        def aov_names(self):
            return ["hit"]  # beside the colour, which the film may convert

    return rendered(mi_scene, sensor, Coverage(mi.Properties()), spp, seed)[..., -1]
