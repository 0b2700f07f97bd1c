"""The points at which transport is known, for a whole scene."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from ..errors import SceneError
from ..system.runtime import mitsuba
from ..system.schema import Array
from .hull import ConvexHull
from .lattice import joined_patches
from .layout import Layout
from .resolution import choose_resolution
from .tessellate import tessellate

# between a point's normal and its faces', above which its hemisphere counts as dipping below them
DIPPING_DEGREES = 1.0


@dataclass(frozen=True, eq=False)
class Points:
    """Surface points of a scene.

    Parameters
    ----------
    positions, normals : (n, 3) float32
        World space; the normals are Mitsuba's shading normals, unit, on the side that reflects.
    geometric_normals : (n, 3) float32
        Mean normal of the faces around the point, on the side of `normals`.
    albedo : (n, 3) float32
        Diffuse reflectance, RGB.
    insets : (n, 3) float32
        Along the surface and inward at its rim, 0 elsewhere; see `ray_origins`.
    areas : (n,) float32
        m²; back sides carry their own.
    uv : (n, 2) float32
    surface : (n,) int32
        Index into `surfaces`.
    buried : (n,) bool
        Points inside or against other geometry, which pictures do not show.
    layout : Layout
    surfaces : tuple of dict
        name and kind of each surface of the scene; with patches also signature, flipped,
        first_patch and patches (their number).
    report : dict
        What was irregular: counts of degenerate faces, zero and flipped normals, back sides, and
        points whose smooth normal is more than 1° off the mean of their faces, so that its
        hemisphere dips below them; edge length in metres.
    """

    positions: np.ndarray
    normals: np.ndarray
    geometric_normals: np.ndarray
    albedo: np.ndarray
    insets: np.ndarray
    areas: np.ndarray
    uv: np.ndarray
    surface: np.ndarray
    buried: np.ndarray
    layout: Layout
    surfaces: tuple
    report: dict

    SHAPES: ClassVar[dict] = {
        "positions": Array("f4", ("n", 3), -1e15, 1e15, unit="m"),
        "normals": Array("f4", ("n", 3)),
        "geometric_normals": Array("f4", ("n", 3)),
        "albedo": Array("f4", ("n", 3), unit="1, linear RGB reflectance"),
        "insets": Array("f4", ("n", 3)),
        "areas": Array("f4", ("n",), least=0, unit="m^2"),
        "uv": Array("f4", ("n", 2)),
        "surface": Array("i4", ("n",), least=0, below="surfaces"),
        "buried": Array("?", ("n",)),
    }

    def __len__(self):
        return len(self.positions)

    def at(self, index):
        """Only the points of an index array; `layout` stays that of all points."""
        return replace(self, **{name: getattr(self, name)[index] for name in self.SHAPES})

    def locator(self, scene):
        """What finds the points around hits in a Scene, a Locator."""
        return self.layout.locator(scene, self)

    @cached_property
    def hull(self):
        """The ConvexHull of the points, computed once: 10 to 30 ms for 40,000, 0.3 s if they are
        all on the hull.
        """
        return ConvexHull(self.positions)

    def ray_origins(self, offset):
        """Where rays start (n, 3): `offset` metres off the surface, and as far in from its rim."""
        return self.positions + np.float32(offset) * (self.geometric_normals + self.insets)


def sample_points(scene, edge_length="auto"):
    """Points on all surfaces of a scene.

    Vertices of meshes are points; faces and analytic shapes with longer edges are tessellated down
    to the edge length. Two-sided surfaces that do not enclose a volume get points on both sides.

    Parameters
    ----------
    scene : Scene
    edge_length : 'auto', float or str
        See `choose_resolution`; `auto` is the shortest length for which a scene stays near 40,000
        points.

    Returns
    -------
    Points

    Raises
    ------
    SceneError
        If no shape can be sampled, a mesh is broken, or a material reflects what is not finite.
    SettingsError
        See `choose_resolution`.
    """
    return tessellated(scene, choose_resolution(scene, edge_length))


def tessellated(scene, resolution):
    """Points at a Resolution, see `sample_points`."""
    length, found = resolution.edge_length, resolution.surfaces
    surfaces = []
    counts = {"degenerate_faces": 0, "zero_normals": 0, "flipped_normals": 0, "back_points": 0}
    total = patch_total = 0
    columns = {name: [] for name in Points.SHAPES}
    patches = []
    for index, surface in enumerate(scene.surfaces):
        if index not in found:
            surfaces.append(_describe(surface, patch_total, 0))
            continue
        tree, levels = found[index].tree, found[index].levels(length)
        part = tessellate(surface, tree, levels)
        sides = (1, -1) if surface.material.two_sided and not part.sealed else (1,)
        n = len(part.positions)
        for side in sides:
            columns["positions"].append(part.positions)
            columns["normals"].append(side * part.normals)
            columns["geometric_normals"].append(side * part.geometric_normals)
            columns["albedo"].append(_albedo(surface, part, side))
            columns["insets"].append(part.insets)
            columns["areas"].append(part.areas)
            columns["uv"].append(part.uv)
            columns["surface"].append(np.full(n, index))
            columns["buried"].append(np.zeros(n, bool))
        surfaces.append(_describe(surface, patch_total, tree.roots))
        patches.append((tree, levels, part.nodes + total, n if len(sides) == 2 else 0))
        for key, value in part.counts.items():
            counts[key] += value
        counts["back_points"] += n * (len(sides) - 1)
        total += n * len(sides)
        patch_total += tree.roots
    if not total:
        kinds = sorted({s.kind for s in scene.surfaces})
        raise SceneError(
            f"none of the scene's shapes ({', '.join(kinds)}) can be sampled: use meshes or"
            " spheres, disks, …"
        )
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    broken = np.flatnonzero(~np.isfinite(joined["albedo"]).all(axis=1))
    if len(broken):
        name = surfaces[joined["surface"][broken[0]]]["name"]
        raise SceneError(
            f"the material of '{name}' has reflectances that are NaN or infinite: repair its"
            " texture first"
        )
    off = np.sum(joined["normals"] * joined["geometric_normals"], axis=1) < np.cos(
        np.radians(DIPPING_DEGREES)
    )
    return Points(
        **{name: values.astype(Points.SHAPES[name].dtype) for name, values in joined.items()},
        layout=joined_patches(patches),
        surfaces=tuple(surfaces),
        report={"edge_length": length, **counts, "dipping_hemispheres": int(off.sum())},
    )


def _describe(surface, first_patch, patches):
    return {
        "name": surface.name,
        "kind": surface.kind,
        "signature": surface.signature,
        "flipped": surface.shape.has_flipped_normals(),
        "first_patch": first_patch,
        "patches": patches,
    }


def _albedo(surface, part, side):
    """Diffuse reflectance (n, 3) of a surface's points, looked up in its modelled material."""
    import drjit as dr

    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, len(part.positions))
    si.p = mi.Point3f(part.local_positions.T.astype(np.float32))
    si.n = mi.Normal3f((side * part.geometric_normals).T.astype(np.float32))
    si.sh_frame = mi.Frame3f(mi.Normal3f((side * part.normals).T.astype(np.float32)))
    si.uv = mi.Point2f(part.uv.T)
    si.wi = mi.Vector3f(0, 0, side)
    si.prim_index = mi.UInt32(part.primitives.astype(np.uint32))
    si.shape = mi.ShapePtr(surface.shape)
    reflectance = np.array(mi.Color3f(surface.material.modelled.eval_diffuse_reflectance(si)))
    return np.broadcast_to(reflectance.reshape(3, -1).T, (len(part.positions), 3))
