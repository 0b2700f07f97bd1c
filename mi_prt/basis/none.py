"""No basis at all: transport as it was sampled."""

from dataclasses import dataclass

import numpy as np

from ..errors import SettingsError
from ..system.schema import Array
from .basis import BASES, Basis, compute_anew
from .target import Fit
from .transport_rows import DirectTransport


@BASES.register
@dataclass(frozen=True, eq=False)
class NoBasis(Basis):
    """Coefficients are the sampled `DirectTransport` itself.

    Parameters
    ----------
    weights : (s,) float32
        Solid angles.
    """

    weights: np.ndarray

    kind = "none"
    ARRAYS = ("weights",)
    captured_variance = np.zeros(0)
    why = "no basis: all directions are kept, as bits of visibility"
    holds_reflections = False
    work = (0, 0)

    @classmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=0, keep=compute_anew):
        """The rows as they are: nothing is fitted and nothing lost."""
        return Fit(cls(rows.directions.solid_angles.astype(np.float32)), 0.0, 1.0, 1.0)

    @classmethod
    def check(cls, directions, components):
        """Raise SettingsError where a number of components is asked for: all directions are."""
        if components is not None:
            raise SettingsError(
                f"the basis none keeps all directions, so coefficients {components} mean nothing:"
                " leave them out"
            )

    @classmethod
    def default_components(cls, directions, points):
        """All directions."""
        return len(directions)

    @classmethod
    def coefficient_bytes(cls, points, directions, components, rays_per_direction=1):
        """A bit for each ray of half the directions."""
        return points * -(-directions * rays_per_direction // 16)

    @classmethod
    def light_bytes(cls, directions, components):
        """Light in all directions."""
        return 4 * directions

    @classmethod
    def projection_bytes(cls, directions, components):
        """Solid angles."""
        return 4 * directions

    @classmethod
    def shapes(cls, channels):
        """See `Basis.shapes`."""
        return {"weights": Array("f4", ("s",), least=0, unit="sr")}

    def check_stored(self, directions):
        """See `Basis.check_stored`."""
        if len(self.weights) != len(directions):
            raise ValueError(f"{len(self.weights)} weights on {directions}")

    @classmethod
    def coefficient_shapes(cls, channels):
        """See `Basis.coefficient_shapes`."""
        return {
            "coefficients/visibility": Array("u1", ("n", "bytes")),
            "coefficients/ray_vectors": Array("f4", ("rays", "half", 3)),
        }

    @classmethod
    def pack(cls, coefficients):
        """See `Basis.pack`."""
        return {
            "coefficients/visibility": coefficients.bits,
            "coefficients/ray_vectors": coefficients.vectors,
        }

    @classmethod
    def unpack(cls, arrays, normals, directions):
        """See `Basis.unpack`.

        Raises
        ------
        ValueError
            If there are not as many bits as rays, or not as many directions.
        """
        bits, vectors = arrays["coefficients/visibility"], arrays["coefficients/ray_vectors"]
        rays, half, _ = vectors.shape
        if bits.shape[1] != -(-rays * half // 8) or 2 * half != directions:
            raise ValueError(
                f"visibility of {bits.shape[1]} bytes a point is not of {rays} × {half} rays"
            )
        return DirectTransport(normals, vectors, bits, len(normals) * rays * half)

    def __len__(self):
        """Number of coefficients of a point: the directions s."""
        return len(self.weights)

    def encode(self, rows):
        """The rows (b, s) themselves."""
        return rows

    def encode_all(self, transport, progress=None):
        """The transport itself, in memory."""
        return transport.in_memory()

    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of a `DirectTransport` of b points, or of the rows that
        `encode` gave.
        """
        return np.asarray(coefficients, np.float32)

    def at(self, coefficients, cells):
        """Transport (b, k) float32 of a `DirectTransport` of b points in some cells (b, k) of the
        lattice each.
        """
        return coefficients.entries(cells)

    def project_light(self, radiance):
        """Light (s, 3) float32 that irradiance is the product with, and no mean response (3,)."""
        return (radiance * self.weights[:, None]).astype(np.float32), np.zeros(3, np.float32)
