"""True albedo of coated materials, whose parameter is another: measured by Mitsuba's own sampling.

Light enters the coat, is reflected below it, partly thrown back from inside, and leaves again. Of a
reflectance ρ of the base S + kρ/(1 − qρ) is reflected: S is what the coat itself reflects, and
q > 0 where the base is met more than once (`nonlinear`). The three are measured, for directions
up to 45° off the normal: near grazing a coat is a mirror, and a picture sees little at such angles.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ..system.runtime import mitsuba

PLACES = 8  # on a texture, at which ρ and what is reflected are compared
_ANGLES, _SIDE = 16, 32  # of incidence, and samples along each side of a square for each
_LEAST_COSINE = 0.5**0.5  # of incidence
_WHOLE = 0.03  # of all light that is lost in a coat at most, where the base is met once
_MOST_RETURNED = 0.95  # q of any coat
_DIGITS = 5  # kept: what rounding changes must not look like another material


@dataclass(frozen=True)
class Coat:
    """What a coat makes of the reflectance below it.

    Parameters
    ----------
    reflected : float
        S, of the coat itself.
    passed : float
        k, into the coat and out again.
    returned : float
        q, thrown back onto the base.
    """

    reflected: float
    passed: float
    returned: float

    @property
    def keeps_parameter(self):
        """Whether the albedo is ρ but for what the coat reflects: S + (1 − S)ρ."""
        return self.returned < _WHOLE and abs(self.reflected + self.passed - 1) < _WHOLE

    def albedo(self, rho: Any) -> Any:
        """Albedo of the whole, S + kρ/(1 − qρ), of ρ as a Dr.Jit array; no more than 1."""
        import drjit as dr

        whole = self.reflected + self.passed * rho / (1 - self.returned * rho)
        return dr.minimum(whole, 1)


def measure_coat(bsdf):
    """The Coat of a plastic.

    Parameters
    ----------
    bsdf : mi.BSDF
        With one diffuse lobe, whose reflectance it tells (`eval_diffuse_reflectance`).
    """
    flags = mitsuba().BSDFFlags
    places = PLACES if mitsuba().has_flag(bsdf.flags(), flags.SpatiallyVarying) else 1
    steps = (np.arange(places)[:, None] * [0.7548776662466927, 0.5698402909980532] + 0.5) % 1
    base = _scattered(bsdf, steps, int(flags.Diffuse))
    coat = float(_scattered(bsdf, steps, int(flags.All) & ~int(flags.Diffuse)).mean())
    rho = _reflectance(bsdf, steps)
    used = (rho > 1e-3) & (base > 0)
    if not used.any():  # black, or known on a shape alone: what a base met once reflects
        return Coat(round(coat, _DIGITS), round(1 - coat, _DIGITS), 0.0)
    # 1/base = (1/k)/ρ − q/k is a line in 1/ρ; q does not matter where all ρ are the same.
    x, y = 1 / rho[used], 1 / base[used]
    spread = np.var(x)
    slope = np.mean((x - x.mean()) * (y - y.mean())) / spread if spread > 1e-6 else y.mean()
    slope = slope if spread > 1e-6 else y.mean() / x.mean()
    returned = float(np.clip(1 - (y.mean() - slope * (x.mean() - 1)) / slope, 0, _MOST_RETURNED))
    passed = float(np.mean(base[used] * (1 - returned * rho[used]) / rho[used]))
    return Coat(*(round(value, _DIGITS) for value in (coat, passed, returned)))


def albedo_texture(texture, coat):
    """A texture of the albedo of a coated base, from that of the base's reflectance.

    Parameters
    ----------
    texture : mi.Texture
        It is kept, and may be edited.
    coat : Coat

    Returns
    -------
    mi.Texture
    """
    mi = mitsuba()
    return _texture_class(mi.variant())(mi.Properties(), texture, coat)


@cache
def _texture_class(variant):
    """The texture for a variant, while that is set."""
    import mitsuba as mi

    class CoatedAlbedo(mi.Texture):
        def __init__(self, properties, texture, coat):
            super().__init__(properties)
            self.texture, self.coat = texture, coat

        def eval(self, si, active=True):
            return self.coat.albedo(self.texture.eval(si, active))

        def eval_3(self, si, active=True):
            return self.coat.albedo(self.texture.eval_3(si, active))

        def eval_1(self, si, active=True):
            return self.coat.albedo(self.texture.eval_1(si, active))

        def is_spatially_varying(self):
            return self.texture.is_spatially_varying()

        def traverse(self, callback):
            coat = self.coat
            numbers = mi.Float([coat.reflected, coat.passed, coat.returned])
            callback.put("base", self.texture, mi.ParamFlags.NonDifferentiable)
            callback.put("coat", numbers, mi.ParamFlags.NonDifferentiable)

        def to_string(self):
            return f"CoatedAlbedo[{self.coat}]"

    return CoatedAlbedo


def _scattered(bsdf, uv, lobes):
    """Light (3 × places,) that some lobes scatter at places uv (places, 2), of all that comes from
    all sides: channel by channel.
    """
    mi = mitsuba()
    grid = (np.indices((_SIDE, _SIDE)).reshape(2, -1) + 0.5) / _SIDE
    # Gauss's nodes in the cosine, which is the weight of each as well.
    nodes, shares = np.polynomial.legendre.leggauss(_ANGLES)
    cosine = _LEAST_COSINE + (1 - _LEAST_COSINE) * (nodes + 1) / 2
    shares = shares * cosine / (shares @ cosine)
    shape = len(uv), _ANGLES, _SIDE**2
    place, angle, sample = (x.ravel() for x in np.indices(shape))
    si = _interactions(uv[place], cosine[angle])
    context = mi.BSDFContext()
    context.type_mask = lobes
    second = mi.Point2f(np.ascontiguousarray(grid[:, sample], np.float32))
    _, weight = bsdf.sample(context, si, mi.Float(0.5), second)
    weight = np.array(mi.Color3f(weight)).reshape(3, -1)
    weight = np.where(np.isfinite(weight), weight, 0)
    weight = np.broadcast_to(weight, (3, place.size)).reshape(3, *shape).mean(axis=-1)
    return (weight @ shares).ravel()


def _reflectance(bsdf, uv):
    """Reflectance (3 × places,) that a material tells at places."""
    mi = mitsuba()
    found = mi.Color3f(bsdf.eval_diffuse_reflectance(_interactions(uv, np.ones(len(uv)))))
    return np.broadcast_to(np.array(found).reshape(3, -1), (3, len(uv))).ravel()


def _interactions(uv, cosine):
    """Interactions at places uv (n, 2) of a plane, seen at a cosine (n,) to its normal."""
    import drjit as dr

    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.t = 1.0
    si.n = si.sh_frame.n = mi.Normal3f(0, 0, 1)
    si.sh_frame.s, si.sh_frame.t = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv = mi.Point2f(np.ascontiguousarray(uv.T, np.float32))
    sine = np.sqrt(1 - cosine**2)
    si.wi = mi.Vector3f(np.stack([sine, 0 * sine, cosine]).astype(np.float32))
    return si
