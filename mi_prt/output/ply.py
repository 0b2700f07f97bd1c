"""Relit points as a PLY mesh."""

import numpy as np

from ..render.display import display
from ..render.image_file import to_8bit
from ..system.files import MARK, replacing
from .formats import FORMATS, Format

PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


@FORMATS.register
class Ply(Format):
    """Points with their radiance, see `write_ply`."""

    kind = ".ply"

    @classmethod
    def write(cls, path, relit):
        """See `Format.write`."""
        write_ply(path, relit.asset, relit.radiance, relit.exposure)


def write_ply(path, asset, radiance, factor):
    """Write the points with their radiance as a binary PLY mesh.

    Each vertex has x y z, nx ny nz, linear radiance as `radiance_r radiance_g radiance_b` (float),
    and for viewers `red green blue` (uchar): the same exposed and sRGB encoded. The faces are those
    of the fronts; points on backs are vertices without faces. Mitsuba reads the radiance as mesh
    attribute `vertex_radiance_color`, MeshLab and Blender show red, green and blue. (Mitsuba reads
    these as well, as `vertex_color` in 0…255, with a warning about that.)

    Parameters
    ----------
    path : path
    asset : Asset
    radiance : (n, 3)
        W/(m²·sr) at the asset's points.
    factor : float
        Exposure of red, green and blue, see `display`.

    Raises
    ------
    SettingsError
        If the path cannot be written.
    """
    points, radiance = asset.points, np.asarray(radiance)
    shown = to_8bit(display(radiance, factor))
    columns = {}
    for names, values in {
        ("x", "y", "z"): points.positions,
        ("nx", "ny", "nz"): points.normals,
        ("radiance_r", "radiance_g", "radiance_b"): radiance.astype(np.float32),
        ("red", "green", "blue"): shown,
    }.items():
        columns |= dict(zip(names, values.T))
    vertices = np.rec.fromarrays(
        columns.values(),
        [(name, "<f4" if values.dtype == np.float32 else "u1") for name, values in columns.items()],
    )
    triangles = points.layout.triangles()
    faces = np.rec.fromarrays(
        [np.full(len(triangles), 3), triangles], [("count", "u1"), ("vertices", "<i4", 3)]
    )
    properties = [f"property {PLY_TYPES[vertices.dtype[name].str]} {name}" for name in columns]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {MARK}",
        "comment radiance in W/(m^2 sr), linear sRGB primaries; red, green, blue for display",
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode() + b"\n")
        vertices.tofile(file)
        faces.tofile(file)
