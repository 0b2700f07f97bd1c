"""Direction lattices: unit vectors that partition the sphere into cells of known solid angle."""

from .cubemap import Cubemap
from .halton import Halton
from .latlong import LatLong
from .lattice import MAX_CUBEMAP_RESOLUTION, DirectionLattice
from .parse import parse_directions

__all__ = [
    "MAX_CUBEMAP_RESOLUTION",
    "Cubemap",
    "DirectionLattice",
    "Halton",
    "LatLong",
    "parse_directions",
]
