"""Light that turns fast: an environment kept on a fine direction lattice instead of its pixels.

Eigentransport (section 5) rotates light by bilinear interpolation on the sampling lattice itself.
That loses energy and blurs a small source anew at each turn. Here the light is averaged once over a
lattice a few times finer than the asset's; a rotation turns the fine cells and averages them over
the coarse ones by the same rule as pixels (`average`), which keeps energy and first moment. The
cost does not depend on the map's resolution.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..system.parallel import one_blas_thread
from .average import average, sample_spacing, split
from .light import Light, as_light
from .part import DistantPart
from .quadrature import Quadrature
from .rotation import rotation_matrix
from .summed import summed_maps
from .values import rgb_factor

REFINEMENT = 4  # fine cells along the side of a cell of the asset
SAMPLES_PER_FINE_SIDE = 4


@dataclass(frozen=True, eq=False)
class LatticeMap(DistantPart):
    """An environment as light in the cells of a lattice, with a rotation.

    Parameters
    ----------
    directions : direction lattice
    cell_means : (s, 3) float32
        Radiance of the cells.
    moments : (s, 3, 3) float32
        ∫ L ω dω of the cells: channels, then x, y, z.
    rotation : (3, 3) float64
    """

    directions: Any
    cell_means: np.ndarray
    moments: np.ndarray
    rotation: np.ndarray

    kind = "environment on a lattice"
    is_environment = True
    pixels = None  # none of an equirectangular map

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`,
        right-handed.
        """
        return replace(self, rotation=rotation_matrix(axis, degrees) @ self.rotation)

    def scaled(self, factor):
        """See `LightPart.scaled`."""
        factors = rgb_factor(factor).astype(np.float32)
        means, moments = self.cell_means * factors, self.moments * factors[:, None]
        return replace(self, cell_means=means, moments=moments)

    def to_mitsuba(self):
        """An environment map that shows the cells; see `LightPart.to_mitsuba`."""
        return summed_maps([self]).to_mitsuba()

    def radiance(self, directions, samples_per_side):
        """See `DistantPart.radiance`."""
        spacing = sample_spacing(directions, samples_per_side)
        return average(self.quadrature(spacing), directions, self.at)

    @property
    def size(self):
        """Rows and columns of an equirectangular map whose pixels are about as large as the
        cells.
        """
        height = max(2, round(np.sqrt(np.pi / 4 * len(self.directions))))
        return height, 2 * height

    def at(self, vectors):
        """Radiance (k, 3) that arrives from unit directions (k, 3) in world space: that of their
        cells.
        """
        return self.cell_means[self.directions.cells(vectors @ self.rotation)]

    def quadrature(self, spacing):
        """The cells as samples, see `EnvironmentMap.quadrature`."""
        solid_angles = self.directions.solid_angles.astype(np.float32)
        turn = self.rotation.T.astype(np.float32)
        with one_blas_thread():
            vectors, moments = self.directions.vectors @ turn, self.moments @ turn
        energy = self.cell_means * solid_angles[:, None]
        return Quadrature(vectors, solid_angles, energy, moments)


def on_lattice(light, directions, refinement=REFINEMENT):
    """Light prepared for turning in front of an asset.

    Parameters
    ----------
    light : what `as_light` accepts
    directions : direction lattice
        That of the asset.
    refinement : int
        Fine cells along the side of a cell; more cost more and place light more exactly.

    Returns
    -------
    Light
        Whose `rotated` and projection take a few milliseconds. All other lights are as they were.
    """
    light = as_light(light)
    maps = tuple(part for part in light.parts if part.is_environment)
    if not maps:
        return light
    fine = directions.refined(refinement)
    spacing = sample_spacing(fine, SAMPLES_PER_FINE_SIDE)
    energy, moments = np.zeros((len(fine), 3)), np.zeros((len(fine), 3, 3))
    for part in maps:
        base, beyond, offset = split(part.quadrature(spacing), fine, part.at)
        energy += base + beyond
        moments += base[:, :, None] * fine.vectors[:, None] + offset
    means = (energy / fine.solid_angles[:, None]).astype(np.float32)
    others = tuple(part for part in light.parts if not part.is_environment)
    return Light((LatticeMap(fine, means, moments.astype(np.float32), np.eye(3)), *others))
