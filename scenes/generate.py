#!/usr/bin/env python3
"""Regenerate every generated file of this folder: the PLY meshes, EXR environment maps and PNG
textures.

    python scenes/generate.py [--out DIR]

The output is deterministic: a second run writes the same bytes. Meshes are y-up, in scene units,
with counter-clockwise faces seen from outside. Numbers are rounded before they are stored, so that
the last bit of a sine or a root, which differs between machines, does not reach the files. PNG and
EXR are compressed by zlib and OpenEXR: another version of those may pack the very same pixels into
other bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

HERE = Path(__file__).resolve().parent
PATCH_FILE = HERE / "teapot_patches.txt"

TEAPOT_DIVISIONS = 14  # quads along each edge of each of the 32 patches
ENVMAP_SIZE = (128, 256)  # rows, columns
TEXTURE_SIZE = 512  # pixels, both ways

# Each teapot patch fills a band of the texture's v: (v of the patch's first row, v of its last
# row). Neighbours meet.
TEAPOT_BANDS = {
    "bottom": (0.00, 0.15),
    "body_lower": (0.30, 0.15),
    "body_upper": (0.50, 0.30),
    "rim": (0.55, 0.50),
    "lid_cover": (0.70, 0.60),
    "lid_knob": (0.80, 0.70),
    "handle_upper": (0.80, 0.85),
    "handle_lower": (0.85, 0.90),
    "spout_root": (0.90, 0.95),
    "spout_tip": (0.95, 1.00),
}
# Patches of one part are welded together; the parts are separate surfaces that only touch or
# intersect.
TEAPOT_PARTS = {
    "pot": ("bottom", "body_lower", "body_upper", "rim"),
    "lid": ("lid_cover", "lid_knob"),
    "handle": ("handle_upper", "handle_lower"),
    "spout": ("spout_root", "spout_tip"),
}
PART_OF_PATCH = {patch: part for part, patches in TEAPOT_PARTS.items() for patch in patches}


# ----------------------------------------------------------------------------------- Bezier patches


def read_patches(path: Path = PATCH_FILE) -> list[tuple[str, str, np.ndarray]]:
    """Read the published patches: (name, mirror, control points of shape (4, 4, 3), indexed [v, u,
    xyz], z up).

    mirror is "xy" or "y": the axes that the patch is reflected along to complete the teapot.
    """
    patches: list[tuple[str, str, np.ndarray]] = []
    for block in path.read_text(encoding="ascii").split("\npatch ")[1:]:
        head, *rows = block.strip().split("\n")
        name, mirror = head.split()
        patches.append((name, mirror, np.array(" ".join(rows).split(), float).reshape(4, 4, 3)))
    return patches


def teapot_nets(path: Path = PATCH_FILE) -> list[tuple[str, bool, np.ndarray]]:
    """All 32 patches as (name, reflected in y?, net of shape (4, 4, 3)), z up, each with dP/du x
    dP/dv outwards.
    """
    nets = []
    for name, mirror, net in read_patches(path):
        for flip_x in (False, True) if "x" in mirror else (False,):
            for flip_y in (False, True):
                copy = net * [-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0, 1.0]
                # One reflection turns the surface inside out; running u backwards turns it outside
                # again.
                nets.append((name, flip_y, copy[:, ::-1] if flip_x != flip_y else copy))
    return nets


def bernstein(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The four cubic Bernstein polynomials at t of shape (n,), and their derivatives: two arrays of
    shape (n, 4).
    """
    s = 1.0 - t
    value = np.stack([s * s * s, 3 * s * s * t, 3 * s * t * t, t * t * t], axis=1)
    slope = np.stack([-3 * s * s, 3 * s * s - 6 * s * t, 6 * s * t - 3 * t * t, 3 * t * t], axis=1)
    return value, slope


def evaluate_patch(net: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and exact unit normals of a bicubic patch on the grid v x u: two arrays of shape
    (len(v), len(u), 3).

    Where a row of the net collapses to a point (the tip of the lid, the centre of the bottom),
    dP/du vanishes. Near that row dP/du = v * d2P/dudv + ..., so the mixed derivative gives the
    limit of its direction, hence the normal.
    """

    def combine(along_v: np.ndarray, along_u: np.ndarray) -> np.ndarray:
        # Plain sums in a fixed order: the same bits everywhere, which a matrix product does not
        # promise.
        return sum(
            along_v[:, None, i, None] * along_u[None, :, j, None] * net[i, j]
            for i in range(4)
            for j in range(4)
        )

    bu, du = bernstein(u)
    bv, dv = bernstein(v)
    tangent_u = combine(bv, du)
    collapsed = np.linalg.norm(tangent_u, axis=-1, keepdims=True) < 1e-9
    normal = np.cross(np.where(collapsed, combine(dv, du), tangent_u), combine(dv, bu))
    return combine(bv, bu), normal / np.linalg.norm(normal, axis=-1, keepdims=True)


# ------------------------------------------------------------------------------------------- meshes


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Quads of a grid of rows x columns vertices, corners in the order (v, u), (v, u+), (v+, u+),
    (v+, u).
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    return np.stack(
        [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1
    ).reshape(-1, 4)


def split_quads(quads: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Triangles (m, 3) of quads (n, 4), cut along the shorter diagonal, without those that
    collapsed to a line.
    """
    a, b, c, d = quads.T
    ac = np.sum((position[c] - position[a]) ** 2, axis=1)
    bd = np.sum((position[d] - position[b]) ** 2, axis=1)
    first = np.where((ac <= bd + 1e-9)[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where((ac <= bd + 1e-9)[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    faces = np.stack([first, second], axis=1).reshape(-1, 3)
    distinct = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    return faces[distinct]


def teapot(divisions: int = TEAPOT_DIVISIONS) -> tuple[np.ndarray, np.ndarray]:
    """The Utah teapot: vertices (n, 8) = x y z nx ny nz u v, and faces (m, 3). y up, standing on y
    = 0, spout to +x.

    Source: Martin Newell's 32 bicubic patches, at their published size (height 3.15, radius 2, 6.5
    from handle to spout). Closed below; open where the original is: at the rim (the lid lies
    loose), inside the spout's mouth, and at the roots of spout and handle, hidden in the body.
    Vertices are shared across patches of a part wherever position and normal agree. For that the
    texture repeats mirrored on the two sides of the handle-spout plane.
    """
    t = np.arange(divisions + 1) / divisions
    cell = grid_faces(divisions + 1, divisions + 1)
    shared: dict[tuple, int] = {}
    vertices, quads = [], []
    for name, flip_y, net in teapot_nets():
        p, n = (a.reshape(-1, 3) for a in evaluate_patch(net, t, t))
        v, u = (a.ravel() for a in np.meshgrid(t, t, indexing="ij"))
        # surfaces round the z axis: u is the angle from the spout
        if PART_OF_PATCH[name] in ("pot", "lid"):
            on_axis = np.hypot(p[:, 0], p[:, 1]) < 1e-9
            u = np.where(on_axis, 0.5, np.arctan2(np.abs(p[:, 1]), p[:, 0]) / np.pi)
        elif flip_y:  # tubes: u runs round the half cross-section
            u = 1.0 - u
        v = TEAPOT_BANDS[name][0] * (1.0 - v) + TEAPOT_BANDS[name][1] * v
        y_up = np.column_stack([p[:, [0, 2]], -p[:, 1], n[:, [0, 2]], -n[:, 1], u, v])
        y_up = np.round(y_up, 7) + 0.0  # + 0.0: no negative zeros
        ids = []
        for row, key in zip(y_up, np.round(y_up[:, :6] * 1e5).astype(int)):
            ids.append(shared.setdefault((PART_OF_PATCH[name], *key), len(vertices)))
            if ids[-1] == len(vertices):
                vertices.append(row)
        quads.append(np.array(ids)[cell])
    vertex = np.array(vertices)
    return vertex, split_quads(np.concatenate(quads), vertex[:, :3])


def torus(
    major: float = 1.0, minor: float = 0.38, around: int = 56, across: int = 28
) -> tuple[np.ndarray, np.ndarray]:
    """A torus lying in the xz plane round the y axis: vertices (n, 8) = x y z nx ny nz u v, and
    faces (m, 3).

    Radii in scene units. As in most textured meshes, u and v run from 0 to 1 once round, so the
    vertices on the two texture seams exist twice, with equal positions and normals.
    """
    grid = np.meshgrid(
        np.arange(across + 1) / across, np.arange(around + 1) / around, indexing="ij"
    )
    v, u = (a.ravel() for a in grid)
    ring, tube = 2 * np.pi * (u % 1.0), 2 * np.pi * (v % 1.0)
    normal = np.column_stack(
        [np.cos(tube) * np.cos(ring), np.sin(tube), np.cos(tube) * np.sin(ring)]
    )
    centre = major * np.column_stack([np.cos(ring), np.zeros_like(ring), np.sin(ring)])
    vertex = np.round(np.column_stack([centre + minor * normal, normal, u, v]), 7) + 0.0
    return vertex, split_quads(grid_faces(across + 1, around + 1)[:, ::-1], vertex[:, :3])


def lampshade(
    narrow: float = 0.7, around: int = 48, along: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """An open conical frustum round the y axis, from radius 1 at y = 0 to radius `narrow` at y = 1:
    vertices (n, 8) = x y z nx ny nz u v, and faces (m, 3), facing outwards.

    Vertices on the one seam of the texture exist twice, as in the torus.
    """
    grid = np.meshgrid(np.arange(along + 1) / along, np.arange(around + 1) / around, indexing="ij")
    v, u = (a.ravel() for a in grid)
    ring, radius = 2 * np.pi * (u % 1.0), 1.0 - (1.0 - narrow) * v
    slope = np.full_like(ring, 1.0 - narrow)
    normal = np.column_stack([np.cos(ring), slope, np.sin(ring)]) / np.hypot(1.0, 1.0 - narrow)
    position = np.column_stack([radius * np.cos(ring), v, radius * np.sin(ring)])
    vertex = np.round(np.column_stack([position, normal, u, v]), 7) + 0.0
    return vertex, split_quads(grid_faces(along + 1, around + 1)[:, ::-1], vertex[:, :3])


def write_ply(path: Path, vertex: np.ndarray, face: np.ndarray, comment: str) -> None:
    """Write a binary little-endian PLY: float32 x y z nx ny nz u v, and triangles as uchar + 3
    int32.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {comment}",
        f"element vertex {len(vertex)}",
    ]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v")]
    header += [
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    packed = np.zeros(len(face), dtype=[("count", "u1"), ("index", "<i4", 3)])
    packed["count"], packed["index"] = 3, face
    path.write_bytes(
        "\n".join(header).encode("ascii") + vertex.astype("<f4").tobytes() + packed.tobytes()
    )


# --------------------------------------------------------------------------------- environment maps


def latlong_directions(rows: int, columns: int) -> np.ndarray:
    """World direction of each pixel, shape (rows, columns, 3), in the layout of Mitsuba's envmap
    emitter, y up.

    Columns are cells: from -z at the left edge over +x, +z (the middle) and -x back to -z. Rows are
    nodes: Mitsuba puts the first row exactly on the +y pole and the last on the -y pole.
    """
    phi = 2 * np.pi * (np.arange(columns) + 0.5)[None, :] / columns
    theta = np.pi * np.arange(rows)[:, None] / (rows - 1)
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)
    return np.stack([x, y, z], axis=-1)


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below low, 1 above high, a smooth cubic between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def sky(
    elevation: float,
    zenith: tuple[float, float, float],
    horizon: tuple[float, float, float],
    ground: tuple[float, float, float],
    glow: tuple[float, float, float],
    sun: tuple[float, float, float],
    sun_width: float,
) -> np.ndarray:
    """A clear sky over a plain ground with a small soft sun towards +x: linear RGB, shape (rows,
    columns, 3).

    Colours are radiances (unitless, as Mitsuba's RGB mode has them). elevation: of the sun,
    degrees. sun is the radiance at its centre and sun_width the standard deviation of its Gaussian
    disc, in degrees; its irradiance at normal incidence is about sun * 2 pi * radians(sun_width)^2.
    glow is the brightening of the sky around the sun.
    """
    direction = latlong_directions(*ENVMAP_SIZE)
    height = direction[..., 1:2]
    angle = np.radians(elevation)
    toward_sun = direction[..., :1] * np.cos(angle) + height * np.sin(angle)
    haze = (1.0 - np.clip(height, 0.0, 1.0)) ** 3
    radiance = np.array(zenith) * (1.0 - haze) + np.array(horizon) * haze
    radiance = radiance + np.array(glow) * np.clip(toward_sun, 0.0, 1.0) ** 6
    above = smoothstep(-0.04, 0.04, height)
    radiance = np.array(ground) * (1.0 - above) + radiance * above
    radiance = radiance + np.array(sun) * np.exp((toward_sun - 1.0) / np.radians(sun_width) ** 2)
    return np.round(np.maximum(radiance, 0.0), 7)


def sky_noon() -> np.ndarray:
    """A blue sky with a white sun 60 degrees up."""
    return sky(
        elevation=60.0,
        zenith=(0.14, 0.27, 0.58),
        horizon=(0.50, 0.62, 0.78),
        ground=(0.20, 0.18, 0.15),
        glow=(0.30, 0.26, 0.18),
        sun=(130.0, 118.0, 96.0),
        sun_width=3.0,
    )


def sky_evening() -> np.ndarray:
    """A dim violet sky, orange at the horizon, with a warm sun 33 degrees up."""
    return sky(
        elevation=33.0,
        zenith=(0.10, 0.14, 0.32),
        horizon=(0.58, 0.36, 0.28),
        ground=(0.09, 0.07, 0.06),
        glow=(0.46, 0.28, 0.13),
        sun=(170.0, 118.0, 70.0),
        sun_width=2.6,
    )


def sky_morning() -> np.ndarray:
    """A bright hazy sky with a warm sun 36 degrees up, for a room to light through a window."""
    return sky(
        elevation=36.0,
        zenith=(1.5, 2.2, 3.6),
        horizon=(4.2, 4.6, 5.0),
        ground=(1.3, 1.25, 1.0),
        glow=(2.6, 2.2, 1.5),
        sun=(212.5, 180, 132.5),
        sun_width=6.0,
    )


def write_exr(path: Path, image: np.ndarray) -> None:
    """Write linear RGB of shape (rows, columns, 3) as a half-float OpenEXR file with ZIP
    compression.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(image.astype(np.float16))}) as file:
        file.write(str(path))


# ----------------------------------------------------------------------------------------- textures


def value_noise(
    random: np.random.RandomState, rows: int, columns: int, size: int = TEXTURE_SIZE
) -> np.ndarray:
    """Tileable smooth noise in 0..1, shape (size, size), from a lattice of rows x columns random
    values.
    """
    lattice = random.uniform(size=(rows, columns))

    def axis(cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = (np.arange(size) + 0.5) * cells / size
        low = np.floor(at).astype(int)
        return low % cells, (low + 1) % cells, smoothstep(0.0, 1.0, at - low)

    y0, y1, ty = axis(rows)
    x0, x1, tx = axis(columns)
    top = lattice[np.ix_(y0, x0)] * (1 - tx) + lattice[np.ix_(y0, x1)] * tx
    bottom = lattice[np.ix_(y1, x0)] * (1 - tx) + lattice[np.ix_(y1, x1)] * tx
    return top * (1 - ty[:, None]) + bottom * ty[:, None]


def planks(boards: int = 8, seed: int = 1975) -> np.ndarray:
    """A tileable floor of wooden boards along x: linear albedo in 0.1..0.8, shape (512, 512, 3)."""
    # this generator's stream is frozen by NumPy's compatibility policy
    random = np.random.RandomState(seed)
    grain = (
        0.5 * value_noise(random, 128, 6)
        + 0.3 * value_noise(random, 64, 4)
        + 0.2 * value_noise(random, 256, 24)
    )
    y, x = np.meshgrid(np.arange(TEXTURE_SIZE), np.arange(TEXTURE_SIZE), indexing="ij")
    width, length = TEXTURE_SIZE // boards, TEXTURE_SIZE // 2
    row = y // width
    offset = random.randint(0, length, size=boards)
    along = (x + offset[row]) % TEXTURE_SIZE
    tone = random.uniform(-1.0, 1.0, size=(boards, 2))[row, along // length]  # two boards per row
    warm = random.uniform(-1.0, 1.0, size=(boards, 2))[row, along // length]
    # Dark joints: the distance in pixels to the nearest board edge.
    across = np.minimum(y % width, width - 1 - y % width)
    end = np.minimum(along % length, length - 1 - along % length)
    joint = 1.0 - 0.65 * (1.0 - smoothstep(0.0, 2.5, np.minimum(across, end)))
    shade = (1.0 + 0.25 * tone + 0.8 * (grain - 0.5)) * joint
    colour = np.stack([0.44 + 0.03 * warm, 0.27 + 0 * warm, 0.15 - 0.02 * warm], axis=-1)
    return np.clip(colour * shade[..., None], 0.1, 0.8)


def write_png(path: Path, albedo: np.ndarray) -> None:
    """Write linear RGB in 0..1 of shape (rows, columns, 3) as an 8-bit sRGB PNG."""
    curve = np.where(albedo <= 0.0031308, 12.92 * albedo, 1.055 * albedo ** (1 / 2.4) - 0.055)
    Image.fromarray(np.round(np.round(curve, 9) * 255).astype(np.uint8)).save(
        path, compress_level=9
    )


def generate(out: Path = HERE) -> list[Path]:
    """Write every generated file under out, creating its folders; returns their paths."""
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    (out / "textures").mkdir(exist_ok=True)
    write_ply(
        out / "meshes/teapot.ply",
        *teapot(),
        "Utah teapot, tessellated from the Bezier patches of M. Newell",
    )
    write_ply(out / "meshes/torus.ply", *torus(), "torus")
    write_ply(out / "meshes/lampshade.ply", *lampshade(), "lampshade")
    write_exr(out / "textures/sky_morning.exr", sky_morning())
    write_exr(out / "textures/sky_noon.exr", sky_noon())
    write_exr(out / "textures/sky_evening.exr", sky_evening())
    write_png(out / "textures/planks.png", planks())
    return sorted([*(out / "meshes").iterdir(), *(out / "textures").iterdir()])


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Regenerate the meshes, environment maps and textures of the scenes."
    )
    parser.add_argument(
        "--out", type=Path, default=HERE, help="folder to write to (default: beside this script)"
    )
    for path in generate(parser.parse_args().out):
        print(f"{path.stat().st_size:>8} bytes  {path}")


if __name__ == "__main__":
    main()
