"""How long edges between points are on each surface, and where."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import SettingsError
from .lattice import node_count
from .quadtree import QuadTree
from .sizes import Objects, growth
from .tessellate import TESSELLATED_SHAPES, analytic_lengths, patch_levels, places_of, world_corners

POINT_BUDGET = 40_000  # points that `auto` edge length aims at, beyond the meshes' own vertices
MAX_POINTS = 4_000_000
WIDE_FACE = 1 / 16  # of the largest object's size; edges of smaller faces are as short as anywhere
MOST_WIDE_FACES = 4096
MOST_PATCHES = 1 << 16  # that wide faces are cut into
UNLIKE = 2.0  # ratio of edge lengths within a patch, above which it is cut
CONTACT = 2.0  # edges along an object that show where it touches others
_STEPS = 40  # of the bisection


@dataclass(frozen=True, eq=False)
class SurfaceResolution:
    """Resolution of one surface.

    Parameters
    ----------
    surface : Surface
    tree : QuadTree
    growth : (l,)
        Of the patches that are not cut: how much longer than elsewhere their edges may be.
    own : float or None
        Edge length that was asked for of this surface, metres.
    """

    surface: Any
    tree: QuadTree
    growth: np.ndarray
    own: float | None = None

    def levels(self, edge_length):
        """Levels (l, 2) of the patches that are not cut."""
        length = edge_length if self.own is None else self.own
        return patch_levels(self.surface, self.tree, length * self.growth)

    def count(self, edge_length):
        """About the number of points: nodes, less those shared by neighbouring patches."""
        surface, levels = self.surface, self.levels(edge_length).astype(np.int64)
        sides = 2 if surface.material.two_sided and surface.kind != "Sphere" else 1
        if surface.kind != "mesh":
            if self.tree.cuts:  # most nodes are shared by four patches
                return sides * int((levels[:, 0] * levels[:, 1]).sum())
            return sides * int(node_count(levels[:, 0], levels[:, 1]).sum())
        # v vertices, k − 1 nodes inside each edge (shared by two faces), the rest inside the faces;
        # a cut makes three vertices, shared by two faces
        k = levels[:, 0]
        made = 1.5 * sum(len(cut) for cut in self.tree.cuts)
        inside = (1.5 * (k - 1) + (k - 1) * (k - 2) // 2).sum()
        return sides * int(surface.shape.vertex_count() + made + inside)

    def area(self):
        """Area in units of the square of the growth, m²."""
        surface, leaves = self.surface, self.tree.leaves
        if surface.kind == "mesh":
            a, b, c = world_corners(surface).transpose(1, 0, 2)
            whole = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        else:
            whole = np.array([np.prod(analytic_lengths(surface))])
        parts = whole[self.tree.root[leaves]] / 4.0 ** self.tree.depth[leaves]
        return float((parts / self.growth**2).sum())

    def cut(self, leaves):
        """With some more leaves (patches) cut, their children's edges half as long."""
        places = np.searchsorted(self.tree.leaves, leaves)
        children = np.repeat(self.growth[places] / 2, 4)
        kept = np.delete(self.growth, places)
        # the children are numbered behind all other patches
        return replace(self, tree=self.tree.cut(leaves), growth=np.concatenate([kept, children]))


@dataclass(frozen=True, eq=False)
class Resolution:
    """Resolution of all surfaces of a scene.

    Parameters
    ----------
    edge_length : float
        Near objects, metres.
    surfaces : dict of SurfaceResolution
        By number; only those that are tessellated.
    sizes : (o,)
        Of the objects of the scene, metres; none where they were not looked at.
    """

    edge_length: float
    surfaces: dict
    sizes: np.ndarray

    def count(self, edge_length=None):
        """About the number of points, at another edge length if one is given."""
        length = self.edge_length if edge_length is None else edge_length
        return sum(x.count(length) for x in self.surfaces.values())

    def cut(self, patches):
        """With some more patches cut, {number of a surface: its leaves}."""
        finer = {i: self.surfaces[i].cut(leaves) for i, leaves in patches.items()}
        return replace(self, surfaces=self.surfaces | finer)

    @property
    def unresolved(self):
        """Which objects are too small for the edge length to show where they touch others, in
        words; '' where it does for most.
        """
        small = self.sizes < CONTACT * self.edge_length
        if small.mean() <= 0.5 if len(small) else True:
            return ""
        wanted = float(np.median(self.sizes)) / CONTACT
        return (
            f"edges of {self.edge_length:.3g} m are too long to show the contact of"
            f" {int(small.sum()):,} of {len(small):,} objects, half of which are smaller than"
            f" {np.median(self.sizes):.3g} m: --edge-length {wanted:.2g} would"
            f" (about {self.count(wanted):,} points)"
        )


def choose_resolution(scene, edge_length="auto"):
    """The resolution of a scene's surfaces.

    Parameters
    ----------
    scene : Scene
    edge_length : 'auto', float, or str
        Metres; `auto` is as short as the budget allows, near objects, and longer on wide faces far
        from them (`sizes.growth`). A number holds everywhere. Shapes may have lengths of their own,
        which hold all over them: "auto,ground=5", "0.1,ground=5", or "ground=5" for auto beside it.

    Returns
    -------
    Resolution

    Raises
    ------
    SettingsError
        If a length is not positive, names no shape, or gives more than 4 million points.
    SceneError
        If a mesh is broken.
    """
    base, named = parse_edge_length(edge_length)
    surfaces = {i: s for i, s in enumerate(scene.surfaces) if s.kind in TESSELLATED_SHAPES}
    own = _own_lengths(surfaces, named)
    found = {}
    for i, surface in surfaces.items():
        roots = surface.shape.face_count() if surface.kind == "mesh" else 1
        found[i] = SurfaceResolution(surface, QuadTree(roots), np.ones(roots), own.get(i))
    if base == "auto":
        objects = Objects([x.surface for x in found.values()])
        _grow(found, objects)
        return Resolution(_fitting(found), found, objects.sizes)
    chosen = Resolution(base, found, np.zeros(0))
    count = chosen.count()
    if count > MAX_POINTS:
        most = max(found.values(), key=lambda x: x.count(base)).surface.name
        raise SettingsError(
            f"edge length {base:g} m gives about {count:,} points, above {MAX_POINTS:,}: use a"
            f" longer one, auto, which is long only far from objects, or one for '{most}' of its"
            f" own (--edge-length {base:g},{most}={max(base * 10, 1):g})"
        )
    return chosen


def parse_edge_length(value):
    """The length, 'auto' or metres, and those of shapes by name, from "auto", 0.1 or
    "0.1,ground=5".

    Raises
    ------
    SettingsError
        If it is neither, or a length is not a positive number.
    """
    base, named = "auto", {}
    for part in str(value).split(","):
        name, equals, length = part.strip().rpartition("=")
        if equals and name:
            named[name] = _length(length, value)
        elif part.strip() != "auto":
            base = _length(part, value)
    return base, named


def _length(text, value):
    try:
        length = float(text)
    except ValueError:
        raise SettingsError(
            f"edge length '{value}' is neither 'auto' nor a number of metres, nor these of shapes"
            " by name (0.1,ground=5)"
        ) from None
    if not (np.isfinite(length) and length > 0):
        raise SettingsError(f"edge length {value} must be a positive number of metres")
    return length


def _own_lengths(surfaces, named):
    """Lengths that were asked for, by number of surface."""
    names = {i: surface.name for i, surface in surfaces.items()}
    found = {}
    for name, length in named.items():
        # an instance's name is that of all shapes in it
        hits = [i for i, n in names.items() if n == name or n.startswith(f"{name}/")]
        if not hits:
            known = ", ".join(sorted(set(names.values()))[:8])
            raise SettingsError(
                f"edge length of '{name}': the scene has no shape of that name that carries points;"
                f" it has {known}"
            )
        found |= dict.fromkeys(hits, length)
    return found


def _grow(found, objects):
    """Cut wide faces where the growth of edge lengths calls for it."""
    for (i, resolution), parts in zip(list(found.items()), objects.parts):
        if resolution.own is None:
            found[i] = _grown(resolution, parts, objects)


def _grown(resolution, parts, objects):
    surface, tree = resolution.surface, resolution.tree
    corners = _corners(surface, tree)
    radius = _radius(corners)
    wide = np.flatnonzero(2 * radius > WIDE_FACE * objects.largest)
    if not 0 < len(wide) <= MOST_WIDE_FACES:
        return resolution
    normals = _normals(surface, corners)
    owner = parts if surface.kind == "mesh" else np.zeros(1, np.int64) + parts[0]
    both_sides = surface.material.two_sided
    factors, open_ = np.ones(tree.roots), wide
    while len(open_):
        root = tree.root[open_]
        least, most = growth(
            corners[open_].mean(axis=1),
            _radius(corners[open_]),
            None if normals is None else normals[root],
            owner[root],
            objects.boxes,
            both_sides,
        )
        factors[open_] = least
        unlike = open_[most > UNLIKE * least]
        if len(tree) + 4 * len(unlike) > MOST_PATCHES:
            break
        tree, first = tree.cut(unlike), len(tree)
        open_ = np.arange(first, len(tree))
        factors = np.concatenate([factors, np.ones(len(open_))])
        corners = _corners(surface, tree)
    return replace(resolution, tree=tree, growth=factors[tree.leaves])


def _corners(surface, tree):
    """Corners (p, 3, 3) of the patches of a mesh, or (p, 9, 3) places of those of an analytic
    shape.
    """
    if surface.kind == "mesh":
        roots = world_corners(surface)[tree.root]
        return np.einsum("pij,pjx->pix", tree.barycentrics(), roots)
    low, high = tree.rectangles()[:, None, :2], tree.rectangles()[:, None, 2:]
    grid = np.array([(u, v) for u in (0, 0.5, 1) for v in (0, 0.5, 1)])
    uv = low + (high - low) * grid
    return places_of(surface, uv.reshape(-1, 2)).reshape(len(tree), 9, 3)


def _radius(corners):
    return np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)


def _normals(surface, corners):
    """Normals (f, 3) of flat roots on the side that reflects; None of curved shapes."""
    if surface.kind == "mesh":
        a, b, c = corners.transpose(1, 0, 2)
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        flipped = -1.0 if surface.shape.has_flipped_normals() else 1.0
        mirrored = np.sign(np.linalg.det(surface.to_world[:3, :3]))
        return flipped * mirrored * np.divide(cross, length, out=0 * cross, where=length > 0)
    return None


def _fitting(found):
    """The shortest edge length for which the points stay near the budget."""
    area = sum(x.area() for x in found.values())
    scale = np.sqrt(area)
    if not scale > 0:
        return 1.0

    def count(length):
        return sum(x.count(length) for x in found.values())

    budget = max(POINT_BUDGET, count(np.inf) + POINT_BUDGET // 4)
    coarsest, finest = scale, scale / 400
    if count(finest) <= budget:
        return float(finest)
    for _ in range(_STEPS):
        middle = np.sqrt(coarsest * finest)
        if count(middle) > budget:
            finest = middle
        else:
            coarsest = middle
        if coarsest / finest < 1.001:
            break
    return float(coarsest)
