"""Errors between a result and a reference, on linear radiance first, as seen second."""

import numpy as np


def relative_rmse(result, reference):
    """‖result − reference‖ / ‖reference‖ over all entries; 0 where both are zero."""
    return _ratio(
        np.linalg.norm(np.subtract(result, reference, dtype=np.float64)), np.linalg.norm(reference)
    )


def relative_bias(result, reference):
    """Signed bias (Σ result − Σ reference) / Σ reference; 0 where both are zero."""
    total = np.sum(reference, dtype=np.float64)
    return _ratio(np.sum(result, dtype=np.float64) - total, total)


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
