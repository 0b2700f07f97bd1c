"""Mitsuba's rendering of an image: of any number of samples, with typed errors."""

from functools import reduce

import numpy as np

from ..errors import SceneError, SettingsError
from ..scene.camera import Camera
from ..system.passing import one_line
from ..system.runtime import mitsuba
from ..system.whole import check_whole

MAX_PIXELS = 1 << 26
MAX_SPP = 1 << 20
MAX_SENSORS = 1 << 16
MAX_SEED = (1 << 31) - 1  # of a user; an image may take several
PASS_LANES = (
    1 << 26
)  # samples of all pixels in one pass, no fewer than pixels; 2^32 end the process
_STEP = 0x9E3779B1  # between the seeds of passes: odd, so that no two are the same


def rendered(mi_scene, sensor, integrator, spp, seed=0):
    """An image by an integrator: the mean of as many passes as the number of samples takes.

    Parameters
    ----------
    mi_scene : mi.Scene
    sensor : mi.Sensor
    integrator : mi.Integrator
    spp : int
        Samples per pixel.
    seed : int

    Returns
    -------
    (h, w, c) float32

    Raises
    ------
    SettingsError
        If the film, `spp` or `seed` is out of range.
    SceneError
        If Mitsuba cannot render the scene.
    PrtError
        Whatever a plugin of this package raises.
    """
    check_samples(spp)
    check_whole("seed", seed, 0, (1 << 32) - 1)
    width, height = check_film(sensor)
    passes = -(-spp * width * height // PASS_LANES)
    shares = [spp // passes + (number < spp % passes) for number in range(passes)]
    images = (
        _one_pass(mi_scene, sensor, integrator, share, (seed + number * _STEP) % (1 << 32))
        * np.float32(share / spp)
        for number, share in enumerate(shares)
    )
    return reduce(np.add, images)


def _one_pass(mi_scene, sensor, integrator, spp, seed):
    mi = mitsuba()
    try:
        return np.array(
            mi.render(mi_scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
        )
    except RuntimeError as error:
        raise SceneError(f"Mitsuba cannot render the scene: {one_line(error)}") from None


def check_picture(size=None, sensor=0, spp=1, seed=0):
    """Check what a picture is asked for before anything is opened or computed.

    Parameters
    ----------
    size : (width, height) or None
    sensor : int or Camera
    spp, seed : int

    Raises
    ------
    SettingsError
        If one of them is out of range for any scene.
    """
    check_samples(spp)
    if not isinstance(sensor, Camera):
        check_whole("sensor", sensor, 0, MAX_SENSORS)
    check_whole("seed", seed, 0, MAX_SEED)
    if size is not None:
        if not isinstance(size, tuple | list) or len(size) != 2:
            raise SettingsError(f"size must be (width, height), got {size!r}")
        check_size(*size)


def check_samples(spp):
    """Raise SettingsError unless an image can have so many samples in each pixel."""
    check_whole("spp", spp, 1, MAX_SPP, "the noise of an image falls with the root of its number")


def check_size(width, height, remedy="give another one (--size)"):
    """Raise SettingsError unless an image can be of so many pixels."""
    whole = all(isinstance(x, int | np.integer) for x in (width, height))
    if not whole or min(width, height) < 1 or int(width) * int(height) > MAX_PIXELS:
        raise SettingsError(
            f"image size {width}x{height} must be at least 1x1 and at most {MAX_PIXELS:,} pixels:"
            f" {remedy}"
        )


def check_film(sensor):
    """Width and height of a sensor's image; SettingsError if it has none or too many pixels."""
    width, height = (int(side) for side in sensor.film().crop_size())
    check_size(width, height, "give another one (--size), or the film another size")
    return width, height
