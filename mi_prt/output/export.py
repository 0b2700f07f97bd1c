"""Relit points and images as files.

Each is written all or nothing: until it is whole, a file of that name stays.
"""

from pathlib import Path

import numpy as np

from ..errors import SettingsError
from ..render.display import display, exposure
from ..system.files import replacing
from ..system.runtime import mitsuba

PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path, asset, radiance):
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

    Raises
    ------
    SettingsError
        If the path cannot be written.
    """
    points, radiance = asset.points, np.asarray(radiance)
    shown = to_8bit(display(radiance, exposure(radiance[~asset.buried])))
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
    triangles = points.patches.triangles()
    faces = np.rec.fromarrays(
        [np.full(len(triangles), 3), triangles], [("count", "u1"), ("vertices", "<i4", 3)]
    )
    properties = [f"property {PLY_TYPES[vertices.dtype[name].str]} {name}" for name in columns]
    header = [
        "ply",
        "format binary_little_endian 1.0",
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


def write_npz(path, asset, radiance, irradiance):
    """Write the points as plain arrays: positions, normals, albedo, areas, triangles, irradiance
    and radiance.

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
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            positions=points.positions,
            normals=points.normals,
            albedo=points.albedo,
            areas=points.areas,
            triangles=points.patches.triangles(),
            irradiance=irradiance,
            radiance=radiance,
        )


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
        with replacing(path) as temporary:
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

    if Path(path).suffix.lower() != ".png":
        raise SettingsError(f"displayed image '{path}' must end in .png")
    with replacing(path) as temporary:
        Image.fromarray(to_8bit(displayed)).save(temporary, format="PNG")


def to_8bit(displayed):
    """Displayed values 0…1 as uint8, rounded."""
    return np.rint(np.asarray(displayed) * 255).astype(np.uint8)
