"""Pixels of environment maps from files, bitmaps and arrays."""

from pathlib import Path

import numpy as np

from ..errors import LightError
from ..system.runtime import mitsuba

# what OpenEXR and Mitsuba read
ENDINGS = (".exr", ".hdr", ".rgbe", ".pfm", ".ppm", ".png", ".jpg", ".jpeg", ".tga", ".bmp")


def read_pixels(source):
    """Pixels of a path, a mi.Bitmap or whatever NumPy takes, not checked; see `EnvironmentMap`."""
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.is_file():
            raise LightError(f"environment map '{path}' does not exist")
        return _read_exr(path) if path.suffix.lower() == ".exr" else _read_by_mitsuba(path)
    if type(source).__module__.startswith("mitsuba"):
        return _from_bitmap(source)
    try:
        return np.asarray(source)
    except ValueError:
        raise LightError(
            "an environment map is a path, an array (h, w, 3) or a mi.Bitmap, got"
            f" {type(source).__name__}"
        ) from None


def _read_exr(path):
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # OpenEXR raises bare RuntimeErrors
        raise LightError(
            f"environment map '{path}' cannot be read as OpenEXR: {_one_line(error)}"
        ) from None
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise LightError(
            f"environment map '{path}' has the channels {', '.join(sorted(channels)) or 'none'} and"
            f" lacks {', '.join(missing)}: write it with R, G and B"
        )
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def _read_by_mitsuba(path):
    mi = mitsuba()
    try:
        return _from_bitmap(mi.Bitmap(str(path)))
    except RuntimeError as error:
        raise LightError(f"environment map '{path}' cannot be read: {_one_line(error)}") from None


def _from_bitmap(bitmap):
    mi = mitsuba()
    if not isinstance(bitmap, mi.Bitmap):
        raise LightError(
            "an environment map is a path, an array (h, w, 3) or a mi.Bitmap, got"
            f" {type(bitmap).__name__}"
        )
    return np.array(
        bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    )


def _one_line(error):
    return " ".join(str(error).split())
