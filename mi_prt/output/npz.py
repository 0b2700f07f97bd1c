"""Relit points as plain arrays."""

from zipfile import ZipFile

import numpy as np

from ..system.files import MARK, replacing
from .formats import FORMATS, Format


@FORMATS.register
class Npz(Format):
    """Points as arrays, see `write_npz`."""

    kind = ".npz"

    @classmethod
    def write(cls, path, relit):
        """See `Format.write`."""
        write_npz(path, relit.asset, relit.radiance, relit.irradiance)


def write_npz(path, asset, radiance, irradiance):
    """Write the points as plain arrays: positions, normals, albedo, areas, buried, triangles,
    irradiance and radiance.

    Parameters
    ----------
    path : path
    asset : Asset
    radiance : (n, 3)
        W/(m²·sr) at the asset's points.
    irradiance : (n, 3)
        W/m² at the asset's points.

    Raises
    ------
    SettingsError
        If the path cannot be written.
    """
    points = asset.points
    with replacing(path) as temporary, open(temporary, "w+b") as file:
        np.savez(
            file,
            positions=points.positions,
            normals=points.normals,
            albedo=points.albedo,
            areas=points.areas,
            buried=points.buried,
            triangles=points.layout.triangles(),
            irradiance=irradiance,
            radiance=radiance,
        )
        with ZipFile(file, "a") as archive:
            archive.comment = MARK.encode()
