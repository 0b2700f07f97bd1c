"""Errors between a result and a reference, on linear radiance first, as seen second."""

import numpy as np

BRIGHTEST = 0.01  # share of the weight that counts as the brightest
FLOOR = 1e-3  # share of the mean size, below which a row of a reference counts as this size


def relative_rmse(result, reference, weights=None):
    """‖result − reference‖ / ‖reference‖; 0 where both are zero.

    Parameters
    ----------
    result, reference : (n, …)
    weights : (n,), optional
        Of the squares in each row, ≥ 0; their scale does not matter. An area for each point makes
        the norm an integral over the surface. By default all are equal.
    """
    if weights is None:
        return _ratio(
            np.linalg.norm(np.subtract(result, reference, dtype=np.float64)),
            np.linalg.norm(reference),
        )
    difference = np.subtract(result, reference, dtype=np.float64)
    return _ratio(_norm(difference, weights), _norm(reference, weights))


def relative_bias(result, reference, weights=None):
    """Signed bias (Σ result − Σ reference) / Σ reference; 0 where both are zero.

    Parameters
    ----------
    result, reference : (n, …)
    weights : (n,), optional
        Of each row, see `relative_rmse`.
    """
    if weights is not None:
        weights = np.asarray(weights, np.float64)
        result, reference = weights @ _rows(result), weights @ _rows(reference)
    total = np.sum(reference, dtype=np.float64)
    return _ratio(np.sum(result, dtype=np.float64) - total, total)


def relative_noise(reference, weights=None):
    """Relative RMSE that a `ground_truth.Reference` has by itself: ‖standard error‖ / ‖mean‖, 0
    where the mean is zero.

    Parameters
    ----------
    reference : Reference
        mean and standard_error (n, …).
    weights : (n,), optional
        See `relative_rmse`.
    """
    if weights is None:
        return reference.noise
    norm = _norm(reference.mean, weights)
    return float(_norm(reference.standard_error, weights) / norm) if norm > 0 else 0.0


def brightest_share(values, share=BRIGHTEST, weights=None):
    """Share of the squared norm that the brightest rows hold: `share` where all are equal, and
    nearly 1 where the norm sees nothing but them.

    Parameters
    ----------
    values : (n, …)
    share : float
        Share of the weight that the brightest rows have. The last of them counts in part.
    weights : (n,), optional
        See `relative_rmse`.

    Returns
    -------
    float
        0 where all values are zero.
    """
    squares = np.sum(_rows(values) ** 2, axis=1)
    weights = np.ones(len(squares)) if weights is None else np.asarray(weights, np.float64)
    order = np.argsort(-squares, kind="stable")
    weight, held = np.cumsum(weights[order]), np.cumsum((weights * squares)[order])
    if not len(held) or held[-1] == 0:
        return 0.0
    at = np.interp(share * weight[-1], np.r_[0.0, weight], np.r_[0.0, held])
    return float(at / held[-1])


def median_relative_error(difference, reference, weights=None):
    """Median over rows of ‖difference‖ / ‖reference‖: an error relative to what is there, so that
    a dim room counts as much as a bright one.

    Parameters
    ----------
    difference : (n, …)
        Result − reference, or the reference's standard error, whose median is the part of the error
        that is noise.
    reference : (n, …)
        A row of less than 1e-3 of the mean size counts as this size.
    weights : (n,), optional
        Of the rows, see `relative_rmse`.

    Returns
    -------
    float
        0 where both are zero everywhere.
    """
    errors, sizes = (np.linalg.norm(_rows(x), axis=1) for x in (difference, reference))
    floor = FLOOR * np.average(sizes, weights=weights)
    if floor == 0:
        return _ratio(float(np.any(errors)), 0)
    ratios = errors / np.maximum(sizes, floor)
    return float(np.quantile(ratios, 0.5, weights=weights, method="inverted_cdf"))


def _rows(values):
    values = np.asarray(values, np.float64)
    return values.reshape(len(values), -1)


def _norm(values, weights):
    """√(Σ weight · square)"""
    return np.sqrt(np.asarray(weights, np.float64) @ np.sum(_rows(values) ** 2, axis=1))


def _ratio(error, size):
    if size == 0:
        return 0.0 if error == 0 else float("inf")
    return float(error / size)


def psnr(result, reference, mask=None):
    """Peak signal-to-noise ratio in dB of two displayed images (values 0…1) over the pixels of
    `mask`.
    """
    difference = np.subtract(result, reference, dtype=np.float64)
    squares = difference**2 if mask is None else difference[mask] ** 2
    mean = squares.mean() if squares.size else 0.0
    return float(-10 * np.log10(mean)) if mean > 0 else float("inf")


def flip(result, reference):
    """Mean FLIP (Andersson et al. 2020) of two displayed images (h, w, 3), and its map (h, w)."""
    import flip_evaluator

    error_map, mean, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference, dtype=np.float32),
        np.ascontiguousarray(result, dtype=np.float32),
        "LDR",
        inputsRGB=True,
        applyMagma=False,
    )
    return float(mean), np.asarray(error_map).reshape(reference.shape[:2])
