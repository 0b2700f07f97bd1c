"""The renderer `raster`: triangles between points where there are some, else splats."""

from contextlib import contextmanager

import numpy as np

from ..errors import SettingsError
from .picture import RENDERERS

SPLAT_RADII = 3.0  # spacings of points that a splat reaches; a dozen of them overlap


@RENDERERS.add("raster")
@contextmanager
def by_raster(picture, lit, camera, spp, samples):
    """See `Picture.drawn`."""
    if picture.direct == "pixels":
        raise SettingsError(
            "direct light at pixels needs the renderer mitsuba: raster shows light of the points"
        )
    points = picture.asset.points
    # These open OpenGL: only where they are asked for.
    if len(points.layout.triangles()):
        from .raster import RasterScene

        raster = RasterScene(picture.asset, lit, camera, samples)
    else:
        from .splats import SplatScene

        radii = np.broadcast_to(
            np.float32(SPLAT_RADII) * np.float32(points.layout.spacing(points)), len(points)
        )
        raster = SplatScene(points.positions, points.normals, radii, lit, camera, samples)
    with raster:
        yield raster.radiance
