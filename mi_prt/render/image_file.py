"""Pictures as files, each written all or nothing."""

from pathlib import Path

import numpy as np

from ..errors import SettingsError
from ..system.files import MARK, replacing
from ..system.runtime import mitsuba
from ..system.workers import a_worker_at_least
from .display import display


def write_image(path, radiance, factor=1.0):
    """Write an image of linear radiance (h, w, 3): as it is to .exr (float32), displayed to .png (8
    bits).

    Parameters
    ----------
    path : path
    radiance : (h, w, 3)
    factor : float
        Exposure of .png, see `display`.

    Raises
    ------
    SettingsError
        If the path has another extension or cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        write_displayed(path, display(radiance, factor))
    elif suffix == ".exr":
        mi = mitsuba()
        bitmap = mi.Bitmap(np.ascontiguousarray(radiance, dtype=np.float32))
        bitmap.metadata()["comments"] = MARK
        with replacing(path) as temporary, a_worker_at_least():
            bitmap.write(temporary, mi.Bitmap.FileFormat.OpenEXR)
    else:
        raise SettingsError(f"image '{path}' must end in .exr or .png")


def write_displayed(path, displayed):
    """Write a displayed image (h, w, 3), 0…1, as PNG of 8 bits.

    Raises
    ------
    SettingsError
        If the path does not end in .png or cannot be written.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    if Path(path).suffix.lower() != ".png":
        raise SettingsError(f"displayed image '{path}' must end in .png")
    mark = PngInfo()
    mark.add_text("Software", MARK)
    with replacing(path) as temporary:
        Image.fromarray(to_8bit(displayed)).save(temporary, format="PNG", pnginfo=mark)


def to_8bit(displayed):
    """Displayed values 0…1 as uint8, rounded."""
    return np.rint(np.asarray(displayed) * 255).astype(np.uint8)
