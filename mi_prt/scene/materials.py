"""What of a material the transport models: its diffuse reflection.

The rest is named, not dropped in silence.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..system.runtime import mitsuba
from .models import MATERIALS, black
from .traversal import children


@dataclass(frozen=True, eq=False)
class Material:
    """A BSDF and its diffuse model.

    Parameters
    ----------
    bsdf : mi.BSDF
        As written.
    modelled : mi.BSDF
        Diffuse parts only; the same object where nothing is left out.
    two_sided : bool
        Whether the back of the surface reflects too.
    textured : bool
        Whether the reflectance varies over the surface.
    left_out : tuple of str
        What is not modelled, for example "conductor: all of its reflection".
    """

    bsdf: Any
    modelled: Any
    two_sided: bool
    textured: bool
    left_out: tuple

    def left_out_albedo(self, samples=4096, seed=0):
        """Share of light at 45° that the material scatters beyond its model, averaged over uv;
        below 0 where the model scatters more, −1…1.
        """
        if not self.left_out:
            return 0.0
        import drjit as dr

        mi = mitsuba()
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, samples)
        si = dr.zeros(mi.SurfaceInteraction3f, samples)
        si.t = 1.0
        si.n = si.sh_frame.n = mi.Normal3f(0, 0, 1)
        si.sh_frame.s, si.sh_frame.t = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
        si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
        si.uv = sampler.next_2d()
        si.wi = mi.Vector3f(0.5**0.5, 0, 0.5**0.5)
        _, weight = self.bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
        scattered = float(np.mean(np.array(weight)))
        diffuse = float(np.mean(np.array(self.modelled.eval_diffuse_reflectance(si))))
        return float(np.clip(scattered - diffuse, -1.0, 1.0))


def model_material(bsdf):
    """Diffuse model of a BSDF, see Material."""
    mi = mitsuba()
    modelled, left_out = _model(bsdf)
    two_sided = mi.has_flag(modelled.flags(), mi.BSDFFlags.BackSide)
    textured = any(
        key.endswith((".data", "color0.value")) or "vertex_" in key
        for key in mi.traverse(modelled).keys()
    )
    textured = textured or mi.has_flag(modelled.flags(), mi.BSDFFlags.SpatiallyVarying)
    return Material(bsdf, modelled, two_sided, textured, tuple(dict.fromkeys(left_out)))


def reflectance_at(si, surfaces, active=True):
    """Diffuse reflectance (mi.Color3f) at hits, from the modelled material of each surface; 0 where
    a texture holds NaN or infinity.

    Parameters
    ----------
    si : mi.SurfaceInteraction3f
    surfaces : sequence of Surface
        Those of the scene that was hit.
    active : mi.Bool
    """
    import drjit as dr

    reflectance = mitsuba().Color3f(
        modelled_bsdf(si, surfaces).eval_diffuse_reflectance(si, active)
    )
    return dr.select(dr.isfinite(reflectance), reflectance, 0)


def modelled_bsdf(si, surfaces):
    """The modelled material (mi.BSDFPtr) at hits; parameters as of `reflectance_at`."""
    import drjit as dr

    mi = mitsuba()
    bsdf = si.bsdf()
    for material in dict.fromkeys(s.material for s in surfaces if s.material.left_out):
        bsdf = dr.select(bsdf == mi.BSDFPtr(material.bsdf), mi.BSDFPtr(material.modelled), bsdf)
    return bsdf


@dataclass
class Facing:
    """Unit normals of hits on the side that a ray comes from.

    Parameters
    ----------
    geometric, shading : mi.Normal3f
    """

    geometric: Any
    shading: Any


def facing(si, ray, surfaces):
    """The side of surfaces that rays meet, told by the faces and not by smooth normals.

    A smooth normal can turn away from a ray that comes from the outer side of the face. Mitsuba's
    own materials are black there, which loses energy; here such a hit reflects.

    Parameters
    ----------
    si : mi.SurfaceInteraction3f
    ray : mi.Ray3f
    surfaces : sequence of Surface

    Returns
    -------
    normals : Facing
    wi : mi.Vector3f
        Toward the ray's origin as a local direction, the side that is met being all that counts.
    reflects : mi.Bool
        Whether that side does.
    """
    import drjit as dr

    mi = mitsuba()
    # Meshes can hold vertex normals that are zero or NaN; no comparison with these is true.
    shading = dr.select(dr.squared_norm(si.sh_frame.n) > 0.25, si.sh_frame.n, si.n)
    outer = dr.mulsign(si.n, dr.dot(si.n, shading))
    side = dr.select(dr.dot(outer, ray.d) < 0, mi.Float(1), -1)
    bsdf = modelled_bsdf(si, surfaces)
    reflects = (side > 0) | mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide)
    return Facing(outer * side, shading * side), mi.Vector3f(0, 0, side), reflects


def _model(bsdf):
    """The modelled BSDF, and texts of what is left out; see `scene.models`."""
    kind = bsdf.class_name()
    if kind not in MATERIALS:
        return black(), (f"{kind}: all of its scattering (treated as black)",)
    return MATERIALS[kind](bsdf, children(bsdf), _model)
