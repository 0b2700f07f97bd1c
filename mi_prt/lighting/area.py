"""Area light: a parallelogram that shines to one side."""

from dataclasses import dataclass, field, replace
from math import isqrt

import numpy as np

from ..errors import LightError
from ..system.runtime import mitsuba
from ..system.whole import check_whole
from .emission import flat_emission
from .part import LIGHTS, LocalPart
from .values import fields_from_text, is_finite, rgb, rgb_factor, rgb_spectrum, vector

# sine of the least angle between the edges of an area light: with less, float32 does not tell its
# normal
FLATTEST = 1e-6
MAX_SAMPLES = 100**2  # of one lamp


@LIGHTS.register
@dataclass(frozen=True, eq=False)
class AreaLight(LocalPart):
    """A parallelogram of one radiance in all directions on one of its sides (Mitsuba's `area` on a
    `rectangle`).

    It shines to the side of edge_u × edge_v; the other is dark. It casts no shadow.

    Parameters
    ----------
    centre : (3,) array
        World space, m.
    edge_u, edge_v : (3,) array
        Edges in m: its corners are centre ± edge_u/2 ± edge_v/2.
    radiance : (3,) array or float
        RGB in W/(m² sr); one number is grey.
    samples : int, default 25
        Places that stand for it, a square number of 10,000 at most: the centres of
        √samples × √samples equal parts. A surface nearer than about the size of a part tells them
        apart.

    Raises
    ------
    LightError
        If a value is not finite, the area zero, the radiance negative, or the number of samples not
        square.
    """

    centre: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    radiance: np.ndarray
    samples: int = 25
    area: float = field(init=False, repr=False)
    normal: np.ndarray = field(init=False, repr=False)

    kind = "area"
    FORM = "area:x,y,z:ux,uy,uz:vx,vy,vz:r,g,b[:samples] (centre, edges, radiance in W/(m² sr))"
    is_movable = True
    is_shape = True

    def __post_init__(self):
        for name in ("centre", "edge_u", "edge_v"):
            object.__setattr__(self, name, vector(name, getattr(self, name)))
        object.__setattr__(self, "radiance", rgb("radiance", self.radiance))
        across = np.cross(self.edge_u, self.edge_v)
        area = np.linalg.norm(across)
        if not area > FLATTEST * np.linalg.norm(self.edge_u) * np.linalg.norm(self.edge_v):
            raise LightError(
                f"an area light's edges must span an area, got edges {self.edge_u} and"
                f" {self.edge_v}"
            )
        if not is_finite(area * self.radiance):
            raise LightError(
                "an area light's radiance times its area must be a finite float32 number, got"
                f" {area:g} m²"
            )
        remedy = "each is a light of its own, and 25 or 100 resolve most lamps"
        count = check_whole(
            "an area light's samples", self.samples, 1, MAX_SAMPLES, remedy, LightError
        )
        if isqrt(count) ** 2 != count:
            raise LightError(
                "an area light's samples must be a square number such as 1, 4, 9, 16 or 25, got"
                f" {count}"
            )
        object.__setattr__(self, "samples", count)
        object.__setattr__(self, "area", float(area))
        object.__setattr__(self, "normal", across / area)

    @classmethod
    def parse(cls, text):
        """See `LightPart.parse`."""
        return cls(*fields_from_text(text, vectors=3, options=(int,)))

    @property
    def position(self):
        """Its centre (3,)."""
        return self.centre

    def emission(self):
        """See `LocalPart.emission`."""
        side = round(self.samples**0.5)
        u, v = (np.indices((side, side)).reshape(2, -1, 1) + 0.5) / side - 0.5
        positions = self.centre + u * self.edge_u + v * self.edge_v
        normals, intensity = (
            np.tile(x, (self.samples, 1))
            for x in (self.normal, self.radiance * self.area / self.samples)
        )
        return flat_emission(positions, normals, intensity)

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        return replace(self, radiance=self.radiance * rgb_factor(factor))

    def moved(self, position):
        """See `LocalPart.moved`."""
        return replace(self, centre=position)

    def to_mitsuba(self):
        """A rectangle that reflects nothing; see `LightPart.to_mitsuba`."""
        to_world = np.eye(4)
        to_world[:3] = np.stack(
            [self.edge_u / 2, self.edge_v / 2, self.normal, self.centre], axis=-1
        )
        return {
            "type": "rectangle",
            "to_world": mitsuba().ScalarTransform4f(to_world),
            "emitter": {"type": "area", "radiance": rgb_spectrum(self.radiance)},
            "bsdf": {"type": "diffuse", "reflectance": rgb_spectrum([0, 0, 0])},
        }
