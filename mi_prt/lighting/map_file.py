"""Pixels of environment maps from files, bitmaps and arrays."""

from pathlib import Path

import numpy as np

from ..errors import LightError
from ..system.files import why_no_file
from ..system.runtime import mitsuba
from ..system.workers import a_worker_at_least

_COLOURS = "RGB", "XYZ", "Y"  # names of channels of which Mitsuba makes colours

# what OpenEXR and Mitsuba read
ENDINGS = (".exr", ".hdr", ".rgbe", ".pfm", ".ppm", ".png", ".jpg", ".jpeg", ".tga", ".bmp")


def read_pixels(source):
    """Pixels of a path, a mi.Bitmap or whatever NumPy takes, not checked; see `EnvironmentMap`."""
    if isinstance(source, str | Path):
        path = Path(source)
        if reason := why_no_file(path):
            raise LightError(f"environment map '{path}' {reason}: give an image (.exr, .hdr)")
        return _read(path)
    if type(source).__module__.startswith("mitsuba"):
        return _from_bitmap(source)
    try:
        return np.asarray(source)
    except ValueError:
        raise LightError(
            "an environment map is a path, an array (h, w, 3) or a mi.Bitmap, got"
            f" {type(source).__name__}"
        ) from None


def _read(path):
    """Pixels of a file, by the reader that an envmap of a scene goes through: Mitsuba's, which
    takes primaries from the header of an EXR, and a grey map as grey light.
    """
    mi = mitsuba()
    try:
        with a_worker_at_least():
            bitmap = mi.Bitmap(str(path))
            if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
                _check_primaries(path)
            return _from_bitmap(bitmap, f"environment map '{path}'")
    except RuntimeError as error:
        raise LightError(
            f"environment map '{path}' cannot be read: {' '.join(str(error).split())}"
        ) from None


def _check_primaries(path):
    """Raise LightError where colours beside other channels are of primaries of their own: Mitsuba
    takes these from files of colours alone.
    """
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        if "chromaticities" in file.header():
            raise LightError(
                f"environment map '{path}' has colours of primaries of its own (chromaticities)"
                " beside other channels: write it with R, G and B alone"
            )


def _from_bitmap(bitmap, what="the bitmap"):
    mi = mitsuba()
    if not isinstance(bitmap, mi.Bitmap):
        raise LightError(
            "an environment map is a path, an array (h, w, 3) or a mi.Bitmap, got"
            f" {type(bitmap).__name__}"
        )
    kinds = mi.Bitmap.PixelFormat
    names = [field.name for field in bitmap.struct_()]
    many = bitmap.pixel_format() == kinds.MultiChannel  # colours beside others, such as depth
    if not any(set(colours) <= set(names) for colours in (_COLOURS[:1] if many else _COLOURS)):
        missing = [name for name in "RGB" if name not in names]
        raise LightError(
            f"{what} has the channels {', '.join(sorted(names)) or 'none'} and lacks"
            f" {', '.join(missing)}: write it with R, G and B"
        )
    if many:
        pixels = np.array(bitmap).astype(np.float32)
        return np.stack([pixels[..., names.index(name)] for name in "RGB"], axis=-1)
    return np.array(bitmap.convert(kinds.RGB, mi.Struct.Type.Float32, srgb_gamma=False))
