"""Colours of what a film holds after rendering, whatever its channels are."""

import numpy as np

from ..errors import SettingsError
from .rendered import rendered

# Linear sRGB of X, Y and Z (IEC 61966-2-1), as Mitsuba takes it.
_FROM_XYZ = np.array(
    [
        [3.240479, -1.537150, -0.498535],
        [-0.969256, 1.875991, 0.041556],
        [0.055648, -0.204043, 1.057311],
    ]
)


def developed(mi_scene, sensor, integrator, spp, seed=0):
    """An image of linear RGB, as the film of the sensor sees it: grey where it holds luminance.

    Parameters
    ----------
    mi_scene : mi.Scene
    sensor : mi.Sensor
        Its film may hold luminance, RGB or XYZ, each with alpha, and channels of the integrator.
    integrator : mi.Integrator
    spp : int
    seed : int

    Returns
    -------
    (h, w, 3) float32

    Raises
    ------
    SettingsError
        If the film holds none of these; see also `rendered`.
    SceneError, PrtError
        See `rendered`.
    """
    image = rendered(mi_scene, sensor, integrator, spp, seed)
    return colours(image, channels(sensor.film()))


def channels(film):
    """Names of the channels that a film holds, after rendering."""
    return [field.name for field in film.bitmap().struct_()]


def colours(image, names):
    """Linear RGB (h, w, 3) float32 of an image (h, w, c) whose channels have names (c,).

    Raises
    ------
    SettingsError
        If they are neither R, G and B, nor X, Y and Z, nor Y.
    """
    found = {name: image[..., i] for i, name in reversed(list(enumerate(names)))}
    if set("RGB") <= set(found):
        return np.stack([found[name] for name in "RGB"], axis=-1)
    if set("XYZ") <= set(found):
        xyz = np.stack([found[name] for name in "XYZ"], axis=-1)
        return (xyz @ _FROM_XYZ.T).astype(np.float32)
    if "Y" in found:
        return np.repeat(found["Y"][..., None], 3, axis=-1)
    raise SettingsError(
        f"the sensor's film holds the channels {', '.join(names) or 'none'}, of which no picture"
        " can be made: use an hdrfilm with a pixel_format of rgb, xyz or luminance"
    )


def as_seen(image, sensor):
    """Linear RGB (h, w, 3) drawn without Mitsuba, as the film of a sensor would hold it."""
    film = sensor.film()
    film.prepare([])
    if not {"Y"} <= set(channels(film)) <= {"Y", "A"}:
        return image
    luminance = image @ np.linalg.inv(_FROM_XYZ)[1]
    return np.repeat(luminance[..., None], 3, axis=-1).astype(image.dtype)
