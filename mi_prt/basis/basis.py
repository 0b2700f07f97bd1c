"""What all bases offer."""

from abc import ABC, abstractmethod

from ..lighting.cells import cell_radiance
from ..lighting.lattice import on_lattice
from ..system.parallel import one_blas_thread


class Basis(ABC):
    """A basis of transport: made from its `ARRAYS`, with as many components as its length says.

    Coefficients are whatever `coefficients @ light` and `coefficients[index]` work with: an array,
    a sparse array, or the sampled transport. Irradiance is `coefficients @ ℓ + m` with what
    `project_light` returns.
    """

    kind: str
    ARRAYS: tuple

    @abstractmethod
    def __len__(self):
        """Number of components d."""

    @abstractmethod
    def encode(self, rows):
        """Coefficients (b, d) of transport rows (b, s) float32."""

    @abstractmethod
    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of coefficients (b, d)."""

    @abstractmethod
    def at(self, coefficients, cells):
        """Transport (b, k) float32 of points with coefficients (b, d) in some cells (b, k) of the
        lattice each.
        """

    @abstractmethod
    def project_light(self, radiance):
        """Light (d, 3) float32 in the basis, and the response of the mean (3,), from the radiance
        of cells (s, 3).
        """

    def project(self, light, directions):
        """The same from a `Light` without local lights."""
        with one_blas_thread():
            return self.project_light(cell_radiance(light, directions))

    def prepare(self, light, directions):
        """A `Light` in a form that turns, and is projected, in milliseconds."""
        return on_lattice(light, directions)
