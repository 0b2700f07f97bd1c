"""Surface interactions of hits in scenes of many shapes, from one table of all of them.

Mitsuba's own call traces the code of every shape that is alive into each kernel, and that of all
shapes again into each instance: seconds for 300 instances, at every kernel. Here the hits of all
meshes are one gather, and those of spheres, cylinders and disks a closed form each.
"""

# Mitsuba's stubs know nothing of what pointers and register arrays can do.
# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false
# pyright: reportCallIssue=false, reportOperatorIssue=false

import numpy as np

from ..system.arrays import indices, packets
from ..system.runtime import mitsuba
from .mesh import mesh_arrays
from .surface_table import SurfaceTable

FEW_SHAPES = 16  # up to so many, none of them an instance, Mitsuba's own call is as fast
_MESH, _SPHERE, _CYLINDER, _DISK = range(4)
_KINDS = {"mesh": _MESH, "Sphere": _SPHERE, "Cylinder": _CYLINDER, "Disk": _DISK}
_FLOATS = 25  # of a surface: to_world (12), its inverse (12), the sign of the normal
_NUMBERS = 5  # of a surface: kind, first face, first vertex, first normal, first uv
_NONE = 0xFFFFFFFF


def make_interactions(surfaces):
    """What finds surface interactions in a scene: Mitsuba where that is as fast or where a shape is
    of no kind of these, else a table.

    Parameters
    ----------
    surfaces : sequence of Surface

    Returns
    -------
    callable(mi.PreliminaryIntersection3f, mi.Ray3f, mi.Bool) -> mi.SurfaceInteraction3f
    """
    many = len(surfaces) > FEW_SHAPES or any(s.instance is not None for s in surfaces)
    if many and all(s.kind in _KINDS for s in surfaces):
        return _Table(surfaces)
    return lambda pi, ray, active: pi.compute_surface_interaction(
        ray, mitsuba().RayFlags.All, active
    )


class _Table:
    """Geometry of surfaces in flat arrays."""

    def __init__(self, surfaces):
        mi = mitsuba()
        self._surfaces = SurfaceTable(surfaces)
        self._kinds = sorted({_KINDS[s.kind] for s in surfaces})
        meshes = _Meshes()
        numbers = [(_KINDS[s.kind], *meshes.place(s)) for s in surfaces]
        self._numbers = indices(np.array(numbers, np.uint32))
        self._floats = packets(np.array([_placed(s) for s in surfaces], np.float32))
        self._faces = indices(_joined(meshes.faces, np.uint32))
        self._positions, self._normals, self._uv = (
            mi.Float(_joined(x, np.float32)) for x in (meshes.positions, meshes.normals, meshes.uv)
        )

    def __call__(self, pi, ray, active=True):
        import drjit as dr

        mi = mitsuba()
        hit = mi.Bool(active) & pi.is_valid()
        surface, shape = self._surfaces.met(pi, hit)
        hit &= surface != _NONE
        kind, *place = (
            dr.gather(mi.UInt32, self._numbers, surface * _NUMBERS + i, hit)
            for i in range(_NUMBERS)
        )
        rows, inverse, sign = self._transforms(surface, hit)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(pi.t))
        shading = mi.Normal3f(0)
        for number in self._kinds:
            here = hit & (kind == number)
            local = (
                self._on_mesh(pi, here, *place)
                if number == _MESH
                else _CLOSED_FORMS[number](_affine(inverse, ray(pi.t)))
            )
            p, n, smooth, uv = local
            si.p = dr.select(here, _affine(rows, p), si.p)
            si.n = dr.select(here, _turned(inverse, n) * sign, si.n)
            shading = dr.select(here, _turned(inverse, smooth) * sign, shading)
            si.uv = dr.select(here, uv, si.uv)
        si.t = dr.select(hit, pi.t, dr.inf)
        si.time, si.wavelengths = ray.time, ray.wavelengths
        si.sh_frame = mi.Frame3f(shading)
        si.wi = dr.select(hit, si.to_local(-ray.d), -ray.d)
        si.prim_index = dr.select(hit, pi.prim_index, 0)
        si.shape, si.instance = shape, dr.select(hit, pi.instance, dr.zeros(mi.ShapePtr))
        return si

    def _transforms(self, surface, hit):
        """Rows of to_world and of its inverse (each three mi.Vector4f), and the normal's sign."""
        import drjit as dr

        mi = mitsuba()
        values = [
            dr.gather(mi.Float, self._floats, surface * _FLOATS + i, hit) for i in range(_FLOATS)
        ]
        rows = [mi.Vector4f(*values[i : i + 4]) for i in range(0, 24, 4)]
        return rows[:3], rows[3:], values[24]

    def _on_mesh(self, pi, here, first_face, first_vertex, first_normal, first_uv):
        """Position, normal of the face, shading normal and uv, in the frame of the mesh."""
        import drjit as dr

        mi = mitsuba()
        face = dr.gather(mi.Vector3u, self._faces, first_face + pi.prim_index, here)
        b = pi.prim_uv
        weights = (1 - b.x - b.y, b.x, b.y)

        def corners(kind, values, first, there):
            return [dr.gather(kind, values, first + corner, there) for corner in face]

        def mean(values):
            return sum(w * v for w, v in zip(weights, values))

        p = corners(mi.Vector3f, self._positions, first_vertex, here)
        n = dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
        smooth = here & (first_normal != _NONE)
        shading = mean(corners(mi.Vector3f, self._normals, first_normal, smooth))
        mapped = here & (first_uv != _NONE)
        uv = mean(corners(mi.Vector2f, self._uv, first_uv, mapped))
        return (
            mean(p),
            n,
            dr.select(smooth, dr.normalize(shading), n),
            dr.select(mapped, uv, mi.Vector2f(b)),
        )


class _Meshes:
    """Arrays of distinct meshes, one behind the other."""

    def __init__(self):
        self.faces, self.positions, self.normals, self.uv = [], [], [], []
        self._counts, self._known = [0, 0, 0, 0], {}

    def place(self, surface):
        """First face, vertex, normal and uv of a surface's mesh; NONE where it has none."""
        if surface.kind != "mesh":
            return (_NONE,) * 4
        if surface.shape not in self._known:
            self._known[surface.shape] = self._added(surface.shape)
        return self._known[surface.shape]

    def _added(self, shape):
        positions, faces, normals, uv = mesh_arrays(shape)
        if normals is not None and shape.has_flipped_normals():
            normals = -normals  # as they are stored: the sign of the surface turns them
        first = []
        for i, (values, into) in enumerate(
            zip(
                (faces, positions, normals, uv),
                (self.faces, self.positions, self.normals, self.uv),
            )
        ):
            first.append(_NONE if values is None else self._counts[i])
            if values is not None:
                into.append(values)
                self._counts[i] += len(values)
        return tuple(first)


def _joined(arrays, dtype):
    """One flat array; a few zeros where there are none, which Dr.Jit can gather from."""
    return np.concatenate([x.ravel() for x in arrays] or [np.zeros(6)]).astype(dtype)


def _placed(surface):
    """The `_FLOATS` of a surface."""
    to_world, sign = surface.to_world, -1.0 if surface.shape.has_flipped_normals() else 1.0
    if surface.kind != "mesh":
        own = surface.shape_to_world
        to_world = to_world @ own
        # The normal of a cylinder is the product of tangents: a mirroring transform turns it in.
        if surface.kind == "Cylinder" and np.linalg.det(own[:3, :3]) < 0:
            sign = -sign
    return np.concatenate([to_world[:3].ravel(), np.linalg.inv(to_world)[:3].ravel(), [sign]])


def _affine(rows, p):
    """A point through the rows of a matrix."""
    return mitsuba().Point3f(*(r.x * p.x + r.y * p.y + r.z * p.z + r.w for r in rows))


def _turned(inverse, n):
    """A unit normal through the inverse transpose of a matrix, whose inverse has these rows."""
    import drjit as dr

    a, b, c = inverse
    return dr.normalize(
        mitsuba().Normal3f(
            a.x * n.x + b.x * n.y + c.x * n.z,
            a.y * n.x + b.y * n.y + c.y * n.z,
            a.z * n.x + b.z * n.y + c.z * n.z,
        )
    )


def _round(p):
    """How far round the z axis a place is, 0…1."""
    import drjit as dr

    turn = dr.atan2(p.y, p.x) / (2 * dr.pi)
    return dr.select(turn < 0, turn + 1, turn)


def _sphere(p):
    import drjit as dr

    mi = mitsuba()
    n = dr.normalize(mi.Vector3f(p))
    return n, n, n, mi.Point2f(_round(n), dr.safe_acos(n.z) / dr.pi)


def _cylinder(p):
    import drjit as dr

    mi = mitsuba()
    n = dr.normalize(mi.Vector3f(p.x, p.y, 0))
    return mi.Point3f(n.x, n.y, p.z), n, n, mi.Point2f(_round(n), p.z)


def _disk(p):
    import drjit as dr

    mi = mitsuba()
    n = mi.Vector3f(0, 0, 1)
    radius = dr.sqrt(p.x * p.x + p.y * p.y)
    return mi.Point3f(p.x, p.y, 0), n, n, mi.Point2f(radius, _round(p))


# Of unit shapes at a place on them: place, normals and uv.
_CLOSED_FORMS = {_SPHERE: _sphere, _CYLINDER: _cylinder, _DISK: _disk}
