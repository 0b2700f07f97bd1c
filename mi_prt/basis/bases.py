"""All bases by their names."""

from math import inf

from ..errors import SettingsError
from . import haar, harmonics, pca
from .haar import HaarBasis, SharedHaarBasis, check_haar, fit_haar, fit_haar_shared
from .harmonics import HarmonicBasis, check_harmonics, fit_harmonics, most_harmonics
from .none import NoBasis
from .pca import PCA, compute_anew, fit_pca

BASES = {basis.kind: basis for basis in (PCA, HarmonicBasis, HaarBasis, SharedHaarBasis, NoBasis)}
DEFAULT_COEFFICIENTS = 48
DEFAULT_HARMONICS = 49  # 7 bands
_CHECKS = {"sh": check_harmonics, "haar": check_haar, "haar-shared": check_haar}
_FITS = {"sh": fit_harmonics, "haar": fit_haar, "haar-shared": fit_haar_shared}


def check_basis(kind):
    """Raise SettingsError unless there is a basis of this name."""
    if kind not in BASES:
        raise SettingsError(f"basis '{kind}' is not known: use {', '.join(BASES)}")


def fit_basis(
    kind, rows, target, seed=0, progress=lambda done, total: None, max_bytes=inf, keep=compute_anew
):
    """Fit a basis that has components to choose (all but `none`) to rows of transport.

    Parameters
    ----------
    kind : str
    rows : Rows
    target : Target
    seed : int
    progress : callable(done, total)
    max_bytes : float
        Memory that the fit may take.
    keep : callable(name, compute)
        See `fit_pca`, the one fit that takes more than a pass or two.

    Returns
    -------
    Fit

    Raises
    ------
    SettingsError
        If the basis cannot be had in that number, on that lattice, or in that memory.
    """
    if kind == "pca":
        return fit_pca(rows, target, seed, progress, max_bytes, keep)
    return _FITS[kind](rows, target, seed, progress, max_bytes)


def check_components(kind, directions, components):
    """Raise SettingsError where a basis cannot be had on a lattice, or not in that number, before
    any work is done.

    Parameters
    ----------
    kind : str
    directions : DirectionLattice
    components : int or None
        None where a number is yet to be chosen.
    """
    if kind in _CHECKS:
        _CHECKS[kind](directions, components)


def default_components(kind, directions, points):
    """How many components are taken where no number is asked for: what relights in about a
    millisecond, or as many as there are.
    """
    if kind == "sh":
        return most_harmonics(directions, DEFAULT_HARMONICS)
    return min(DEFAULT_COEFFICIENTS, most_components(kind, directions, points))


def most_components(kind, directions, points):
    """The largest number of components that there can be."""
    return min(points - 1, len(directions)) if kind == "pca" else len(directions)


def fit_bytes(kind, points, directions, components):
    """Memory that fitting a basis of so many components takes, its functions included."""
    if kind == "pca":
        return pca.fit_bytes(points, directions, components)
    return (
        {"sh": harmonics.FIT_BYTES, "haar-shared": haar.FIT_BYTES}.get(kind, 0)
        * components
        * directions
    )


def coefficient_bytes(kind, points, directions, components, rays_per_direction=1):
    """Bytes of the coefficients of all points, as they are stored."""
    if kind == "none":
        return points * -(-directions * rays_per_direction // 16)
    index = (2 if directions <= 1 << 16 else 4) if kind == "haar" else 0
    return points * components * (4 + index)
