"""What all bases offer, and all bases by their names."""

from abc import ABC, abstractmethod
from math import inf
from typing import Any, ClassVar

import numpy as np

from ..errors import SettingsError
from ..lighting.cells import cell_radiance
from ..lighting.lattice import on_lattice
from ..system.parallel import one_blas_thread
from ..system.registry import Registry
from ..system.schema import Array
from .rows import encoded

BASES = Registry("basis", "mi_prt.basis")
DEFAULT_COEFFICIENTS = 96  # so many relight 40,000 points in two milliseconds


def compute_anew(name, compute):
    """The `keep` of a fit that keeps nothing."""
    return compute()


class Basis(ABC):
    """A basis of transport: made from its `ARRAYS`, with as many components as its length says.

    Coefficients are whatever `coefficients @ light` and `coefficients[index]` work with: an array,
    a sparse array, or the sampled transport. Irradiance is `coefficients @ ℓ + m` with what
    `project_light` returns.

    Attributes
    ----------
    kind : str
        Its name.
    why : str
        Why one would take it, for `info`.
    ARRAYS : tuple of str
        Names of the arrays that make it.
    holds_reflections : bool
        Whether reflected light can be encoded; else coefficients are picked from, or are, rows of
        direct transport.
    joins_channels : bool
        Whether one set of coefficients holds the three colour channels of reflected light.
    work : (float, float)
        How often a fit with its encoding expands all rows, and multiplies them with as many
        vectors as there are components.
    copies : float
        Of the stored coefficients in memory while blocks are put together.
    """

    kind: ClassVar[str]
    why: ClassVar[str] = "as asked"
    ARRAYS: ClassVar[tuple]
    holds_reflections: ClassVar[bool] = True
    joins_channels: ClassVar[bool] = False
    work: ClassVar[tuple] = (1, 1)
    sqrt_weights: Any
    copies: ClassVar[float] = 2.0

    # --- from light to irradiance -------------------------------------------------------------

    @abstractmethod
    def __len__(self):
        """Number of components d."""

    @abstractmethod
    def encode(self, rows):
        """Coefficients (b, d) of transport rows (b, s) float32."""

    def encode_all(self, transport, progress=None):
        """Coefficients of all rows of a `DirectTransport`, see `rows.encoded`."""
        return encoded(self.encode, transport, progress)

    @abstractmethod
    def reconstruct(self, coefficients):
        """Transport rows (b, s) float32 of coefficients (b, d)."""

    @abstractmethod
    def at(self, coefficients, cells):
        """Transport (b, k) float32 in some cells (b, k) of the lattice each of points with
        coefficients (b, d).
        """

    @abstractmethod
    def project_light(self, radiance) -> tuple[np.ndarray, np.ndarray]:
        """Light (d, 3) float32 in the basis, and the response of the mean (3,), from the radiance
        of cells (s, 3).
        """

    def project(self, light, directions):
        """The same from a `Light` without local lights."""
        with one_blas_thread():
            return self.project_light(cell_radiance(light, directions))

    def project_all(self, lights, directions):
        """Light (m, d, 3) and the mean's response (m, 3) of m `Light`s without local lights."""
        projected = [self.project(light, directions) for light in lights]
        return np.stack([light for light, _ in projected]), np.stack(
            [mean for _, mean in projected]
        )

    def prepare(self, light, directions):
        """A `Light` in a form that turns, and is projected, in milliseconds."""
        return on_lattice(light, directions)

    def truncated(self, components):
        """The basis of the first so many components, 1…d, by which coefficients stay what they are.

        Raises
        ------
        SettingsError
            If its components are not nested, or not in that number.
        """
        raise SettingsError(
            f"the basis {self.kind} has no first {components:,} components that all points share:"
            f" precompute the scene again with coefficients {components} (--coefficients)"
        )

    # --- before there is one ------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def fit(cls, rows, target, seed=0, progress=None, max_bytes=inf, keep=compute_anew):
        """Fit to rows of transport.

        Parameters
        ----------
        rows : Rows
        target : Target
        seed : int
        progress : callable(done, total), optional
        max_bytes : float
            Memory that the fit may take.
        keep : callable(name, compute)
            Stores and restores what a pass over the rows gives.

        Returns
        -------
        Fit

        Raises
        ------
        SettingsError
            If the basis cannot be had in that number, on that lattice, or in that memory.
        """

    @classmethod
    def check(cls, directions, components):
        """Raise SettingsError where the basis cannot be had on a lattice, or not in that number.

        Parameters
        ----------
        directions : DirectionLattice
        components : int, 'auto' or None
            None for the default; 'auto' where the share of the variance decides.
        """

    @classmethod
    def most_components(cls, directions, points):
        """The largest number of components that there can be."""
        return len(directions)

    @classmethod
    def default_components(cls, directions, points):
        """How many components are taken where no number is asked for."""
        return min(DEFAULT_COEFFICIENTS, cls.most_components(directions, points))

    @classmethod
    def fit_bytes(cls, points, directions, components):
        """Memory that fitting so many components takes, its functions included."""
        return 0

    @classmethod
    def coefficient_bytes(cls, points, directions, components, rays_per_direction=1):
        """Bytes of the coefficients of all points, one channel, as they are stored."""
        return 4 * points * components

    @classmethod
    def light_bytes(cls, directions, components):
        """Bytes of light in the basis, one channel (Eigentransport, section 7.1)."""
        return 4 * components

    @classmethod
    def projection_bytes(cls, directions, components):
        """Bytes of the matrix that projects light (Eigentransport, section 7.1)."""
        return 4 * components * directions

    # --- in files -----------------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def shapes(cls, channels):
        """What its arrays must be, {name: Array}, with d components and s directions.

        Parameters
        ----------
        channels : 1 or 3
            Colour channels of the transport.
        """

    def check_stored(self, directions):
        """Raise ValueError unless its arrays, of a file, are those of a basis on a lattice."""
        weights = self.sqrt_weights
        if len(weights) != len(directions):
            raise ValueError(f"a basis of {len(weights)} directions on {directions}")

    @classmethod
    def coefficient_shapes(cls, channels):
        """What the arrays of `pack` must be, {name: Array}, for n points."""
        joint = channels == 1 or cls.joins_channels
        shape = ("n", "d") if joint else ("n", channels, "d")
        return {"coefficients": Array("f4", shape, unit="sr^(1/2)")}

    @classmethod
    def pack(cls, coefficients):
        """Coefficients as arrays by name."""
        return {"coefficients": coefficients}

    @classmethod
    def unpack(cls, arrays, normals, directions):
        """Coefficients from the arrays of `pack`; checked already, for n normals and s
        directions.
        """
        return arrays["coefficients"]
