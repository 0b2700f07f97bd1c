"""Light that turns fast: an environment kept on a fine direction lattice instead of its pixels.

Eigentransport (section 5) rotates light by bilinear interpolation on the sampling lattice itself.
That loses energy and blurs a small source anew at each turn. Here the light is averaged once over a
lattice a few times finer than the asset's; a rotation turns the fine cells and averages them over
the coarse ones with the same energy-exact rule as pixels (`cells.average`). The cost does not
depend on the map's resolution.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..system.parallel import one_blas_thread
from .cells import cell_radiance
from .environment import rotation_matrix
from .light import Light, as_light

REFINEMENT = 4  # fine cells along the side of a cell of the asset
SAMPLES_PER_FINE_SIDE = 4


@dataclass(frozen=True, eq=False)
class LatticeMap:
    """An environment as mean radiance over the cells of a lattice, with a rotation.

    Parameters
    ----------
    directions : direction lattice
    radiance : (s, 3) float32
    rotation : (3, 3) float64
    """

    directions: object
    radiance: np.ndarray
    rotation: np.ndarray

    def rotated(self, axis, degrees):
        """The same light turned about `axis` (x, y, z or a vector of 3) by `degrees`,
        right-handed.
        """
        return replace(self, rotation=rotation_matrix(axis, degrees) @ self.rotation)

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
        return self.radiance[self.directions.cells(vectors @ self.rotation)]

    def quadrature(self, spacing):
        """The cells as samples that cover the sphere, in one band; see
        `EnvironmentMap.quadrature`.
        """
        with one_blas_thread():
            vectors = self.directions.vectors @ self.rotation.T.astype(np.float32)
        yield vectors, self.directions.solid_angles.astype(np.float32), self.radiance


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
        Whose `rotated` and projection take a few milliseconds. Directional and local lights are as
        they were.
    """
    light = as_light(light)
    if not light.maps:
        return light
    fine = directions.refined(refinement)
    radiance = cell_radiance(Light(light.maps), fine, SAMPLES_PER_FINE_SIDE)
    return replace(light, maps=(LatticeMap(fine, radiance, np.eye(3)),))
