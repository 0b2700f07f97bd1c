"""Transport with fewer components than it was compressed with."""

import numpy as np

from ..errors import SettingsError
from ..system.parallel import map_chunks
from .compressed import Compressed

_CHUNK = 1 << 12  # points that are summed over at a time
_ROUNDING = 1e-3  # relative error below which the transport's variance is not told from it


def truncated(compressed, components, kept, report):
    """Transport of the first components, and how well it represents what was sampled.

    What is dropped is summed from the stored coefficients, point by point. It is orthogonal to what
    was lost before, as coefficients are least squares, and both add up.

    Parameters
    ----------
    compressed : Compressed
    components : int
        1…d.
    kept : (n,) bool
        Points that the basis was fitted to.
    report : dict
        captured_variance and relative_error of the transport as it is.

    Returns
    -------
    Compressed
    dict
        captured_variance and relative_error of the result.

    Raises
    ------
    SettingsError
        If the number is out of range, or see `Basis.truncated`.
    """
    most = len(compressed.basis)
    is_count = isinstance(components, int | np.integer) and not isinstance(components, bool)
    if not is_count or not 1 <= components <= most:
        raise SettingsError(
            f"an asset of {most:,} components can be cut to 1…{most:,} of them, got {components!r}"
        )
    basis = compressed.basis.truncated(int(components))
    coefficients = compressed.coefficients[..., :components].copy()
    return Compressed(basis, coefficients), _quality(compressed, components, kept, report)


def _quality(compressed, components, kept, report):
    held, centred, dropped = _energies(compressed, components, kept)
    before = report["relative_error"] ** 2
    energy = held / max(1 - before, 1e-12)  # of the transport as it was sampled
    if not energy:
        return {name: report[name] for name in ("captured_variance", "relative_error")}
    left = 1 - report["captured_variance"]
    # The variance over the energy: what was lost is known as a share of both.
    told = before > _ROUNDING**2 and left > _ROUNDING**2
    spread = before / left if told else centred / energy
    share = dropped / energy
    captured = report["captured_variance"] - (share / spread if spread > 0 else 0.0)
    return {
        "captured_variance": float(captured),
        "relative_error": float(np.sqrt(before + share)),
    }


def _energies(compressed, components, kept):
    """Squared norms over the sphere, of kept points and channels: of the transport that is held, of
    its difference from its mean, and of what all components but the first give.
    """
    basis = compressed.basis
    functions = basis.vectors.reshape(len(basis), -1).astype(np.float64)
    mean = (basis.mean * basis.sqrt_weights).ravel().astype(np.float64)
    gram, cross = functions @ functions.T, functions @ mean

    def sums(first):
        block = slice(first, first + _CHUNK)
        rows = compressed.coefficients[block][kept[block]].reshape(-1, len(basis))
        rows = rows.astype(np.float64)
        return len(rows), rows.sum(axis=0), rows.T @ rows

    counts, totals, products = zip(*map_chunks(sums, range(0, len(compressed), _CHUNK)))
    count, total, product = sum(counts), np.sum(totals, axis=0), np.sum(products, axis=0)
    around = float(np.sum(product * gram))  # of the rows without the mean
    held = around + 2 * float(total @ cross) + count * float(mean @ mean)
    centred = around - float(total @ gram @ total) / max(count, 1)
    tail = slice(components, None)
    dropped = float(np.sum(product[tail, tail] * gram[tail, tail]))
    return held, max(centred, 0.0), max(dropped, 0.0)
