"""Small scenes and independent integrators that several test files share.

Scenes are y-up, lengths in metres.
"""

import gc
import os
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats
from mutants import Parts
from threadpoolctl import threadpool_limits

from mi_prt.directions import parse_directions
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene
from mi_prt.system.runtime import VARIANTS, mitsuba, set_variant
from mi_prt.transport.bits import find_buried, sample_direct
from mi_prt.transport.hops import NOTHING, Hops, HopSampler, blocked_share
from mi_prt.transport.interreflection import solve, split_by_bounces
from mi_prt.transport.paths import PathSampler


def pytest_addoption(parser):
    parser.addoption(
        "--variant",
        default=os.environ.get("MI_PRT_TEST_VARIANT", VARIANTS[0]),
        choices=VARIANTS,
        help="Mitsuba's variant that the tests run in, also of MI_PRT_TEST_VARIANT",
    )


def pytest_configure(config):
    """Before any test file is imported: several make scenes while they are."""
    set_variant(config.getoption("--variant"))


def pytest_collection_finish():
    """What is there before the first test stays, and the collector need not look at it again.
    Tests run in as many processes as there are cores: BLAS's own threads would wait in loops for
    each other's cores, a fifth of all time.
    """
    gc.collect()
    gc.freeze()
    threadpool_limits(1, "blas")


def facing(normal, position=(0, 0, 0), size=1.0):
    """`to_world` that takes Mitsuba's unit rectangle or disk (facing +z) to a place, facing
    `normal`.
    """
    transform = mitsuba().ScalarTransform4f
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    up = [1, 0, 0] if abs(normal[0]) < 0.9 else [0, 0, 1]
    target = np.asarray(position, float) + normal
    return (
        transform()
        .look_at(origin=list(map(float, position)), target=list(map(float, target)), up=up)
        .scale(float(size))
    )


def diffuse(reflectance=0.5):
    """A diffuse material of one grey or RGB reflectance."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}


def rectangle(normal=(0, 1, 0), position=(0, 0, 0), size=1.0, **rest):
    """A square of half side `size`."""
    return {"type": "rectangle", "to_world": facing(normal, position, size), **rest}


def disk(normal=(0, 1, 0), position=(0, 0, 0), size=1.0, **rest):
    """A disk of radius `size`."""
    return {"type": "disk", "to_world": facing(normal, position, size), **rest}


def sphere(position=(0, 0, 0), radius=1.0, **rest):
    return {"type": "sphere", "center": list(map(float, position)), "radius": float(radius), **rest}


def cube(position=(0, 0, 0), size=1.0, **rest):
    """An axis-aligned cube of half side `size`."""
    transform = mitsuba().ScalarTransform4f
    return {
        "type": "cube",
        "to_world": transform().translate(list(map(float, position))).scale(float(size)),
        **rest,
    }


def scene(**parts):
    return {"type": "scene", **parts}


def uniform_sky(radiance=1.0):
    """The smallest map of one radiance, a number or RGB."""
    return np.broadcast_to(np.asarray(radiance, np.float32), (2, 4, 3)).copy()


def sky_of(function, height=128):
    """Map (h, 2h, 3) of a function of unit directions (k, 3), at Mitsuba's pixel centres; written
    anew from its manual.

    Mitsuba: u = (column + ½)/w and v = row/(h − 1) look along (sin 2πu sin πv, cos πv, −cos 2πu sin
    πv).
    """
    v = np.arange(height)[:, None] / (height - 1) * np.pi
    u = (np.arange(2 * height)[None, :] + 0.5) / (2 * height) * 2 * np.pi
    directions = np.stack(
        [np.sin(u) * np.sin(v), np.cos(v) + 0 * u, -np.cos(u) * np.sin(v)], axis=-1
    )
    values = np.asarray(function(directions.reshape(-1, 3)), np.float32)
    return np.broadcast_to(values.reshape(height, 2 * height, -1), (height, 2 * height, 3)).copy()


def random_rotation(rng):
    """Uniformly distributed rotation matrix (3, 3), from a random unit quaternion."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_transform(rotation):
    """A (3, 3) matrix as Mitsuba's `to_world`."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return mitsuba().ScalarTransform4f(matrix)


def uniform_directions(rng, count):
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def cosine_directions(rng, normals):
    """One cosine-distributed direction about each normal (k, 3): the normal plus a uniform unit
    vector (Malley).
    """
    vectors = normals + uniform_directions(rng, len(normals))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ray_test(mi_scene, origins, directions):
    """Whether rays (k, 3) hit anything, by Mitsuba."""
    mi = mitsuba()
    ray = mi.Ray3f(
        mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32))
    )
    return np.array(mi_scene.ray_test(ray))


def emitted(emitter, directions):
    """Radiance (k, 3) that Mitsuba's distant emitter sends from directions (k, 3)."""
    import drjit as dr

    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(-directions.T.astype(np.float32))
    value = np.array(mi.Color3f(emitter.eval(si))).reshape(3, -1).T
    return np.broadcast_to(value, directions.shape).astype(np.float64)


def relative_l2(result, reference):
    return float(
        np.linalg.norm(np.subtract(result, reference, dtype=np.float64)) / np.linalg.norm(reference)
    )


def bias(result, reference):
    """Signed, relative."""
    return float(np.sum(result, dtype=np.float64) / np.sum(reference, dtype=np.float64) - 1)


# --- statistics -----------------------------------------------------------------------------------

# of a statistical test; seeds are fixed, so this is how likely it was to write one that fails
FALSE_POSITIVES = 0.01


def largest_z(count):
    """What the largest |z| of `count` standard normal numbers exceeds in 1 % of all cases
    (Šidák).
    """
    return scipy.stats.norm.isf((1 - (1 - FALSE_POSITIVES) ** (1 / count)) / 2)


# --- transport without a basis --------------------------------------------------------------------


def mesh(vertices, faces, normals=None, bsdf=None):
    """A mesh of vertices (v, 3) and faces (f, 3); smooth where it has normals (v, 3)."""
    mi = mitsuba()
    properties = mi.Properties()
    if bsdf:
        properties["bsdf"] = mi.load_dict(bsdf)
    result = mi.Mesh(
        "mesh", len(vertices), len(faces), has_vertex_normals=normals is not None, props=properties
    )
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if normals is not None:
        parameters["vertex_normals"] = np.ravel(normals).astype(np.float32)
    parameters.update()
    return result


def white(vectors):
    """The sky (k, 1) of radiance 1."""
    return np.ones((len(vectors), 1))


@dataclass(frozen=True, eq=False)
class SampledScene:
    """What a precomputation knows of a scene before it fits a basis; irradiance itself then stands
    for coefficients.

    `kept` (n,) are the points that are not buried.
    """

    scene: object
    points: object
    directions: object
    transport: object
    blocked: np.ndarray

    @property
    def buried(self):
        return self.points.buried

    @property
    def kept(self):
        return ~self.buried

    @property
    def shares(self):
        """Shares (n,) of kept points in the area."""
        areas = np.where(self.kept, self.points.areas, 0).astype(float)
        return areas / areas.sum()

    def direct(self, sky=white):
        """Direct irradiance (n, k) under a sky, a function of unit directions (s, 3) that gives
        radiance (s, k).
        """
        return self.transport.irradiance(
            sky(self.directions.vectors.astype(float)), self.directions.solid_angles
        )

    def hops(self, rays, seed=0, **rest):
        sampler = HopSampler(
            self.scene, self.points, self.transport, self.directions, rays, seed, **rest
        )
        return Hops(np.concatenate(list(sampler.blocks())), self.blocked)

    def paths(self, count, bounces=None, channels=1, seed=0, encode=None, **rest):
        return PathSampler(
            self.scene, self.points, self.directions, count, bounces, channels, encode, seed, **rest
        )

    def reflections(self, hops, direct, channels, bounces):
        """Irradiance (c, n, k) after one reflection and more of direct irradiance (n, k), as a
        precomputation finds it.
        """
        if bounces is None:
            return solve(hops, direct, channels, None)
        split = split_by_bounces(hops, 1 - self.blocked, self.shares, channels, bounces)
        return (
            solve(hops, direct, channels, split)
            if split.bounces
            else np.zeros((channels, *direct.shape), np.float32)
        )

    def reflected(self, rays, bounces, sky=white, seed=0):
        """The same (n, k) under a sky; three radiances are RGB, and any other number is grey."""
        direct = self.direct(sky)
        if direct.shape[1] != 3:
            return self.reflections(self.hops(rays, seed), direct, 1, bounces)[0]
        coloured = self.reflections(self.hops(rays, seed), direct, 3, bounces)
        return np.stack([coloured[channel, :, channel] for channel in range(3)], axis=-1)

    def samples_of_paths(self, count, bounces, index, sky=white, seed=0):
        """Irradiance (b, count, 3) that each path from some points gives alone, so that its noise
        is known too.
        """
        cell, throughput, _ = self.paths(count, bounces, 3, seed).escapes(index)
        radiance = sky(self.directions.vectors.astype(float))[np.where(cell == NOTHING, 0, cell)]
        return np.pi * np.where((cell != NOTHING)[..., None], throughput * radiance, 0)


def sampled(parts, edge_length, directions="cubemap:16", rays_per_direction=1):
    """A SampledScene of a scene dict."""
    opened = open_scene(parts)
    points, lattice = sample_points(opened, edge_length), parse_directions(directions)
    transport = sample_direct(opened, points, lattice, rays_per_direction)
    points = replace(points, buried=find_buried(opened, points, transport.dark()))
    return SampledScene(
        opened, points, lattice, transport, blocked_share(transport, lattice.solid_angles)
    )


def distant(asset):
    """An asset's transport of light from afar."""
    return asset.transports["distant"]


# --- files ----------------------------------------------------------------------------------------


def arrays_of(path):
    """Arrays of an asset's file by name, read without mi_prt."""
    parts = Parts.of(path.read_bytes())
    return {name: array for name, (_, array) in parts.arrays().items()}


def rewritten(source, path, change):
    """The file `source` with what `change(header, arrays)` makes of the asset's header and of its
    arrays by name, at `path`; places and shapes in the file are right.
    """
    parts = Parts.of(source.read_bytes())
    codes = {name: code for name, (code, _) in parts.arrays().items()}
    arrays = arrays_of(source)
    change(parts.own, arrays)
    path.write_bytes(parts.with_arrays({name: (codes[name], a) for name, a in arrays.items()}))
    return path
