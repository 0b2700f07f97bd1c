"""Small scenes and independent integrators that several test files share. Scenes are y-up, lengths in metres."""

import numpy as np

from mi_prt.runtime import mitsuba


def facing(normal, position=(0, 0, 0), size=1.0):
    """`to_world` that takes Mitsuba's unit rectangle or disk (facing +z) to a place, facing `normal`."""
    transform = mitsuba().ScalarTransform4f
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    up = [1, 0, 0] if abs(normal[0]) < 0.9 else [0, 0, 1]
    target = np.asarray(position, float) + normal
    return transform().look_at(origin=list(map(float, position)), target=list(map(float, target)), up=up).scale(float(size))


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
    return {"type": "cube", "to_world": transform().translate(list(map(float, position))).scale(float(size)), **rest}


def scene(**parts):
    return {"type": "scene", **parts}


def uniform_sky(radiance=1.0):
    """The smallest map of one radiance, a number or RGB."""
    return np.broadcast_to(np.asarray(radiance, np.float32), (2, 4, 3)).copy()


def sky_of(function, height=128):
    """Map (h, 2h, 3) of a function of unit directions (k, 3), at Mitsuba's pixel centres; written anew from its manual.

    Mitsuba: u = (column + ½)/w and v = row/(h − 1) look along (sin 2πu sin πv, cos πv, −cos 2πu sin πv).
    """
    v = np.arange(height)[:, None] / (height - 1) * np.pi
    u = (np.arange(2 * height)[None, :] + 0.5) / (2 * height) * 2 * np.pi
    directions = np.stack([np.sin(u) * np.sin(v), np.cos(v) + 0 * u, -np.cos(u) * np.sin(v)], axis=-1)
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
    """One cosine-distributed direction about each normal (k, 3): the normal plus a uniform unit vector (Malley)."""
    vectors = normals + uniform_directions(rng, len(normals))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ray_test(mi_scene, origins, directions):
    """Whether rays (k, 3) hit anything, by Mitsuba."""
    mi = mitsuba()
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
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
    return float(np.linalg.norm(np.subtract(result, reference, dtype=np.float64)) / np.linalg.norm(reference))


def bias(result, reference):
    """Signed, relative."""
    return float(np.sum(result, dtype=np.float64) / np.sum(reference, dtype=np.float64) - 1)
