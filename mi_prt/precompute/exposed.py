"""Vertices where faces are seen: faces whose corners stand in other geometry get points between."""

import warnings
from dataclasses import replace

import numpy as np

from ..points.lattice import leaf_triangles
from ..points.points import tessellated
from ..points.resolution import MAX_POINTS, choose_resolution
from ..transport.bits import find_buried

ROUNDS = 5  # each halves the distance between points where it is called for
PLACES = 16  # of each small triangle of buried points, at which it may be seen
LANES = 1 << 18  # rays of a wavefront, some 30 MB: this runs before memory is shared out
LEAST_SEEN = 0.1  # of the edge length's square, or of a smaller face: less is a sliver, and left


class PointsWarning(UserWarning):
    """Points that cannot show what a scene holds."""


def exposed_points(scene, edge_length="auto"):
    """Points as `sample_points` takes them, finer where all points around what is seen are buried.

    Kit-built models have walls whose corners stand in posts, beams and the ground. A small triangle
    of three buried points is seen where places inside it are not buried; if that is more than a
    sliver, the patch that it is of is cut, until what is seen has points of its own.

    Parameters
    ----------
    scene : Scene
    edge_length : see `choose_resolution`

    Returns
    -------
    Points

    Raises
    ------
    SceneError, SettingsError
        See `sample_points`.

    Warns
    -----
    PointsWarning
        If edges are too long to show the contact of most objects.
    """
    resolution = choose_resolution(scene, edge_length)
    if resolution.unresolved:
        warnings.warn(resolution.unresolved, PointsWarning, stacklevel=2)
    points = tessellated(scene, resolution)
    for _ in range(ROUNDS):
        cuts = _cuts(scene, points, resolution.surfaces, resolution.edge_length)
        finer = resolution.cut(cuts)
        if not cuts or finer.count() > MAX_POINTS:
            break
        resolution = finer
        points = tessellated(scene, resolution)
    return points


def _cuts(scene, points, found, length):
    """Patches to cut, by number of surface: those with triangles of buried points that are seen."""
    buried = find_buried(scene, points, lanes=LANES)
    layout = points.layout
    leaves = np.flatnonzero(layout.children == 0)
    triangles, leaf = leaf_triangles(layout.levels[leaves], layout.nodes)
    patch = leaves[leaf]
    back = layout.back[patch][:, None]
    sides = np.concatenate([triangles, (triangles + back)[back[:, 0] > 0]])
    patch = np.concatenate([patch, patch[back[:, 0] > 0]])
    hidden = buried[sides].all(axis=1)
    a, b, c = points.positions[sides].transpose(1, 0, 2).astype(np.float64)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    least = LEAST_SEEN * np.minimum(length**2, areas * _triangles_of_root(points, found)[patch])
    hidden &= areas > least
    sides, patch, areas, least = (x[hidden] for x in (sides, patch, areas, least))
    if not len(sides):
        return {}
    seen = _share_seen(scene, points, sides) * areas > least
    return _by_surface(np.unique(patch[seen]), points, found)


def _triangles_of_root(points, found):
    """How many triangles, as small as those of each patch (p,), its root would have."""
    u, v = points.layout.levels.astype(np.float64).T
    depths = [resolution.tree.depth for resolution in found.values()]
    roots = [depth[: r.tree.roots] for depth, r in zip(depths, found.values())]
    children = [depth[r.tree.roots :] for depth, r in zip(depths, found.values())]
    return np.where(v > 0, 2 * u * v, u**2) * 4.0 ** np.concatenate([*roots, *children])


def _share_seen(scene, points, triangles):
    """Share (m,) of places inside of triangles (m, 3) of points that are not buried."""
    # evenly over a triangle: the places of a lattice of R2 folded into it (Roberts 2018)
    turn = np.arange(1, PLACES + 1)[:, None] * [0.7548776662466927, 0.5698402909980532] % 1
    u, v = np.where(turn.sum(axis=1) > 1, 1 - turn.T, turn.T)
    weights = np.stack([1 - u - v, u, v], axis=1).astype(np.float32)
    corner = np.repeat(triangles[:, 0], PLACES)
    positions = np.einsum("kc,mcx->mkx", weights, points.positions[triangles]).reshape(-1, 3)
    places = replace(points.at(corner), positions=positions, insets=np.zeros_like(positions))
    return 1 - find_buried(scene, places, lanes=LANES).reshape(-1, PLACES).mean(axis=1)


def _by_surface(patches, points, found):
    """Patches of all surfaces as patches of each, {surface: patches}."""
    result, roots = {}, sum(s["patches"] for s in points.surfaces)
    behind = roots
    for i, resolution in found.items():
        first, tree = points.surfaces[i]["first_patch"], resolution.tree
        more = len(tree) - tree.roots
        own = patches[(patches >= first) & (patches < first + tree.roots)] - first
        cut = patches[(patches >= behind) & (patches < behind + more)] - behind + tree.roots
        behind += more
        if len(own) + len(cut):
            result[i] = np.concatenate([own, cut])
    return result
