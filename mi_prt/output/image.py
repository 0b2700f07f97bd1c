"""Relit pictures."""

from ..render.image_file import write_image
from .formats import FORMATS, Format


@FORMATS.register
class Exr(Format):
    """A picture of linear radiance, float32."""

    kind = ".exr"
    is_picture = True

    @classmethod
    def write(cls, path, relit):
        """See `Format.write`."""
        write_image(path, relit.image)


@FORMATS.register
class Png(Format):
    """A picture as a display shows it, 8 bits."""

    kind = ".png"
    is_picture = True

    @classmethod
    def write(cls, path, relit):
        """See `Format.write`."""
        write_image(path, relit.image, relit.exposure)
