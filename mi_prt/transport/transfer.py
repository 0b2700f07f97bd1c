"""Direct-to-indirect transfer between clusters (Meshless PRT, section 4.3), solved in the
coefficients of direct light.

Light on a cluster s is taken as ℓ_s = P_s E_s, d coefficients of its irradiance, and stands for the
pattern Q_s ℓ_s of which P_s is the left inverse. One hop from there to the points of a cluster r is
Z_rs = A_rs Q_s, gathered by the rays of the receivers: signs of Q do not matter there (erratum 7).
What arrives is light on r in turn, B_rs = P_r Z_rs, so that all reflections are the solution of a
small dense system, ℓ + Bℓ + B²ℓ + … = (1 − B)⁻¹ ℓ, and indirect irradiance is E_r = Σ_s Z_rs [(1 −
B)⁻¹ ℓ]_s: the series S − 1 of erratum 6. No matrix of points × points is formed.

The basis is not centred: response is linear in light, and of intensity zero or a million alike
(erratum 5).
"""

from dataclasses import dataclass

import numpy as np

from ..basis.clustered import leading_components
from ..errors import SceneError
from ..system.parallel import map_chunks
from .interreflection import LARGEST_GROWTH

MOST_REFLECTIONS = 0.9999  # spectral radius of one hop from which on reflections do not end
_POWER_STEPS = 200


@dataclass(frozen=True, eq=False)
class SenderBasis:
    """Patterns of direct light, d on each cluster.

    Parameters
    ----------
    encoder, decoder : (n, d) float32
        P and Q; coefficients of a cluster are P ᵀE, E ≈ Qℓ.
    coefficients : (c, d, e) float32
        Those of the examples, each example scaled to a reflected flux of 1.
    captured : float
        Share of the squared response to the examples that the patterns capture.
    """

    encoder: np.ndarray
    decoder: np.ndarray
    coefficients: np.ndarray
    captured: float


def fit_senders(examples, importance, clusters, count, seed=0):
    """The patterns of example light on each cluster that matter most for what it causes.

    Of all ranks d, P and Q leave the least squared error of importance · (E − Q P E) over the
    examples: they are the singular vectors of importance · E, P = Uᵀ·importance and Q = E·V/σ. With
    the identity for importance that is the paper's PCA of direct light.

    Parameters
    ----------
    examples : (n, e) float32
        Irradiance of each point under each example.
    importance : (k, n) float32
        Functionals of irradiance that should come out right: what receivers get of it.
    clusters : sequence of slice
    count : int
        d.
    seed : int

    Returns
    -------
    SenderBasis
    """
    n, e = examples.shape
    encoder, decoder = np.zeros((n, count), np.float32), np.zeros((n, count), np.float32)
    coefficients = np.zeros((len(clusters), count, e), np.float32)

    def fit(number):
        cluster = clusters[number]
        response = importance[:, cluster] @ examples[cluster]
        total = float(np.einsum("ij,ij->", response, response, dtype=np.float64))
        if total == 0:
            return 0.0, 0.0
        left, values, right = leading_components(response, count, seed)
        k = len(values)
        # Scaled so that coefficients are about as large as the response itself.
        encoder[cluster, :k] = importance[:, cluster].T @ left
        decoder[cluster, :k] = examples[cluster] @ (right / values[:, None].astype(np.float32)).T
        coefficients[number, :k] = values[:, None].astype(np.float32) * right
        return float((values**2).sum()), total

    captured, total = np.sum(list(map_chunks(fit, range(len(clusters)))), axis=0)
    return SenderBasis(encoder, decoder, coefficients, float(captured / total) if total else 1.0)


def all_reflections(hop, bounces=None):
    """The operator that takes coefficients of direct light to those of light after any number of
    reflections, direct light included.

    Parameters
    ----------
    hop : (k, k, channels) float64
        B.
    bounces : int or None
        Most reflections until light arrives at a receiver, the last one included: 1 is light
        reflected once. None for all.

    Returns
    -------
    (k, k, channels) float64

    Raises
    ------
    SceneError
        If reflections do not end because nothing is lost in them, or light grows by more than
        `LARGEST_GROWTH` within that number.
    """
    result = np.empty_like(hop)
    for channel in range(hop.shape[2]):
        one = hop[..., channel]
        result[..., channel] = _endless(one) if bounces is None else _summed(one, bounces)
    return result


def _endless(one):
    """1 + B + B² + …, all of them."""
    if _spectral_radius(one) >= MOST_REFLECTIONS:
        raise SceneError(
            "light that is reflected grows without bound: lower the albedo, or ask for a number of"
            " bounces (--bounces)"
        )
    return np.linalg.inv(np.eye(len(one)) - one)


def _summed(one, count):
    """1 + B + … of so many terms, by doubling their number: S₂ₙ = Sₙ + BⁿSₙ."""
    total, power = np.eye(len(one)), one  # of one term
    with np.errstate(over="ignore", invalid="ignore"):
        for bit in bin(count)[3:]:
            total, power = total + power @ total, power @ power
            if bit == "1":
                total, power = np.eye(len(one)) + one @ total, one @ power
        largest = np.abs(total).max()
    if not largest <= LARGEST_GROWTH:
        raise SceneError(
            f"light grows without bound within {count:,} reflections: each returns"
            f" {_spectral_radius(one):.4g} times the light that arrives; lower the albedo, or use"
            " fewer bounces (--bounces)"
        )
    return total


def _spectral_radius(matrix):
    """About the largest modulus of the eigenvalues, by powers: ‖Bᵏv‖^(1/k) ends there."""
    # any that no symmetry of the matrix can take to zero
    vector = np.random.default_rng(0).standard_normal(len(matrix))
    growth = []
    for _ in range(_POWER_STEPS):
        vector = matrix @ vector
        size = np.linalg.norm(vector)
        if size == 0:
            return 0.0
        growth.append(np.log(size))
        vector /= size
    return float(np.exp(np.mean(growth[_POWER_STEPS // 2 :])))
