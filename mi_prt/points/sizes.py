"""Where light changes fast: how long edges between points may be, from place to place.

Irradiance on a wide surface changes near what stands on it and hardly anywhere else. An object of a
size d takes (d/r)² of the sky from places at a distance r, which changes over r: linear
interpolation between points h apart errs by h² d²/r⁴, so that h may grow with r². A scene's extent,
its largest coordinate, or a vertex that no face uses say nothing about it.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ..scene.mesh import mesh_arrays
from ..scene.traversal import transform_of

REACH = 2.0  # sizes of an object within which edges are shortest
MOST_BOXES = 512  # that stand for the objects of a scene
_WIDE = 1 / 4  # of the largest object's size, from which a mesh is not one object
_CLUSTERS = 16  # along the size of such a mesh
_FLAT = 1e-4  # of its size, by which what rises above a plane less lies in it
_BLOCK = 1 << 22  # distances at a time


@dataclass(frozen=True, eq=False)
class Boxes:
    """Bounding boxes of what stands in a scene.

    Parameters
    ----------
    low, high : (b, 3)
        Corners, metres.
    owner : (b,) int
        The part of a surface that a box bounds whole, as `Objects.parts` numbers them; −1 of boxes
        that bound some small faces of a part, or several.
    """

    low: np.ndarray
    high: np.ndarray
    owner: np.ndarray

    def __len__(self):
        return len(self.low)

    @property
    def sizes(self):
        """Diagonals (b,)."""
        return np.linalg.norm(self.high - self.low, axis=1)


class Objects:
    """The objects of a scene: connected parts of meshes, and analytic shapes.

    Parameters
    ----------
    surfaces : sequence of Surface

    Attributes
    ----------
    parts : list of (f,) int
        For each surface, the part that its faces belong to.
    sizes : (o,)
        Diagonals of the boxes around the parts, metres.
    boxes : Boxes
        Around them, or around several of them.
    """

    def __init__(self, surfaces):
        known, self.parts, total = {}, [], 0
        low, high, faces = [], [], []
        for surface in surfaces:
            labels, corners = _parts(surface, known)
            world = _moved(corners, surface)
            self.parts.append(labels + total)
            count = labels.max(initial=-1) + 1
            for part in _extremes(labels, world, count):
                low.append(part[0])
                high.append(part[1])
            faces.append(world)
            total += count
        low, high = np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3)
        whole = Boxes(low, high, np.arange(total))
        self.sizes = whole.sizes
        self.largest = self.sizes.max(initial=0.0)
        self.boxes = _few(_joined([whole, *self._details(whole, faces)]))

    def _details(self, whole, faces):
        """Boxes of the small faces of wide parts: a house that is of one mesh with its ground."""
        for labels, corners in zip(self.parts, faces):
            if corners.shape[1] != 3:  # the box of an analytic shape
                continue
            size = whole.sizes[labels]
            edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
            small = (size > _WIDE * self.largest) & (edges < size / (_CLUSTERS / 2))
            if small.any():
                yield _clustered(corners[small], size[small] / _CLUSTERS)


def _parts(surface, known):
    """Part (f,) of each face of a surface, and the faces' corners (f, 3, 3) in the shape's frame;
    of an analytic shape the corners (1, 8, 3) of its box.
    """
    key = surface.shape.id() if surface.instance is not None else None
    if key is not None and key in known:
        return known[key]
    if surface.kind == "mesh":
        positions, faces, _, _ = mesh_arrays(surface.shape)
        found = _components(positions, faces), positions.astype(np.float64)[faces]
    else:
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        if surface.kind == "Disk":
            signs = signs * [1, 1, 0]
        elif surface.kind == "Cylinder":
            signs = (signs + [0, 0, 1]) / [1, 1, 2]
        place = transform_of(surface.shape)
        found = np.zeros(1, np.int64), (signs @ place[:3, :3].T + place[:3, 3])[None]
    if key is not None:
        known[key] = found
    return found


def _moved(corners, surface):
    with np.errstate(invalid="ignore"):  # positions are checked where points are made
        return corners @ surface.to_world[:3, :3].T + surface.to_world[:3, 3]


def _components(positions, faces):
    """Connected part (f,) of each face; corners at one place are connected."""
    if not len(faces):
        return np.zeros(0, np.int64)
    places = np.ascontiguousarray(positions + np.float32(0)).view(np.dtype((np.void, 12))).ravel()
    _, welded = np.unique(places, return_inverse=True)
    corners = welded.ravel()[faces]
    ones = np.ones(2 * len(faces), bool)
    edges = np.concatenate([corners[:, :2], corners[:, 1:]])
    count = len(positions)
    graph = scipy.sparse.coo_matrix((ones, edges.T), (count, count))
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.unique(labels[corners[:, 0]], return_inverse=True)[1].ravel()


def _extremes(labels, corners, count):
    """Low and high corner of each part."""
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(count))
    low = np.minimum.reduceat(corners.min(axis=1)[order], starts) if count else []
    high = np.maximum.reduceat(corners.max(axis=1)[order], starts) if count else []
    return zip(low, high)


def _clustered(corners, sizes):
    """Boxes around faces (f, 3, 3) that lie in one cell of a grid of some sizes (f,)."""
    cells = np.floor(corners.mean(axis=1) / sizes[:, None]).astype(np.int64)
    _, labels = np.unique(np.column_stack([cells, sizes]), axis=0, return_inverse=True)
    labels = labels.ravel()
    boxes = list(_extremes(labels, corners, labels.max() + 1))
    low, high = (np.array([box[i] for box in boxes]) for i in (0, 1))
    return Boxes(low, high, np.full(len(low), -1))


def _joined(boxes):
    return Boxes(
        *(np.concatenate([getattr(b, x) for b in boxes]) for x in ("low", "high", "owner"))
    )


def _few(boxes):
    """At most `MOST_BOXES`: the smallest join their neighbours in ever larger cells of a grid."""
    size = boxes.sizes.max(initial=0.0) / 256
    while len(boxes) > MOST_BOXES:
        small = boxes.sizes <= 2 * size
        if small.any():
            low, high = boxes.low[small], boxes.high[small]
            cells = np.floor((low + high) / 2 / max(size, 1e-300)).astype(np.int64)
            _, labels = np.unique(cells, axis=0, return_inverse=True)
            corners = np.stack([low, high], axis=1)
            found = list(_extremes(labels.ravel(), corners, labels.max() + 1))
            joined = Boxes(
                np.array([x[0] for x in found]),
                np.array([x[1] for x in found]),
                np.full(len(found), -1),
            )
            kept = Boxes(boxes.low[~small], boxes.high[~small], boxes.owner[~small])
            boxes = _joined([kept, joined])
        size *= 2
    return boxes


def growth(places, radius, normals, part, boxes, both_sides):
    """By how much edges may be longer at places than beside objects.

    Parameters
    ----------
    places : (k, 3)
    radius : (k,)
        Around each place, within which the factor is wanted.
    normals : (k, 3) or None
        Of the plane in which a place lies, with what lies in it or behind it no object; None on
        curved surfaces.
    part : (k,) int
        That a place belongs to, which is no object to it.
    boxes : Boxes
    both_sides : bool
        Whether what lies behind the plane is an object too.

    Returns
    -------
    least, most : (k,)
        At least 1; 1 where there is no object at all.
    """
    least, most = np.ones(len(places)), np.ones(len(places))
    step = max(1, _BLOCK // max(len(boxes), 1))
    for first in range(0, len(places), step):
        block = slice(first, first + step)
        size = _rise(places[block], None if normals is None else normals[block], boxes, both_sides)
        size[part[block][:, None] == boxes.owner] = 0
        outside = np.maximum(
            boxes.low - places[block][:, None], places[block][:, None] - boxes.high
        )
        distance = np.linalg.norm(np.maximum(outside, 0), axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(size > 0, 1 / (REACH * size), np.inf)
            for found, shift in ((least, -1), (most, 1)):
                away = np.maximum(distance + shift * radius[block][:, None], 0)
                grown = np.where(size > 0, away * factor, np.inf).min(axis=1, initial=np.inf)
                found[block] = np.where(np.isfinite(grown), np.maximum(grown, 1) ** 2, 1)
    return least, most


def _rise(places, normals, boxes, both_sides):
    """Size (k, b) of boxes as objects on planes: root of their diagonal times their height above
    the plane; 0 of those that do not rise above it.
    """
    diagonal = np.broadcast_to(boxes.sizes, (len(places), len(boxes)))
    if normals is None:
        return diagonal.copy()
    centre, half = (boxes.low + boxes.high) / 2, (boxes.high - boxes.low) / 2
    middle = normals @ centre.T - np.sum(normals * places, axis=1)[:, None]
    reach = np.abs(normals) @ half.T
    height = middle + reach
    if both_sides:
        height = np.maximum(height, reach - middle)
    height = np.minimum(height, diagonal)
    return np.where(height > _FLAT * diagonal, np.sqrt(np.maximum(height, 0) * diagonal), 0)
