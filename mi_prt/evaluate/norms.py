"""Errors of an asset at its points and in its image, by norms that see more than the lamps."""

import numpy as np

from ..errors import SettingsError
from ..render.display import display, exposure
from . import metrics
from .ground_truth import Reference


def errors_at_points(result, reference, areas, visible, near):
    """Errors of irradiance at points, relative to that of the reference.

    Squares are weighted by area: a densely tessellated lamp does not count more than a wall of the
    same area. Points beside an emitter receive up to a thousand times the light of others, so that
    a norm over all would see only them; they have figures of their own.

    Parameters
    ----------
    result : (n, 3)
        W/m².
    reference : Reference
        mean and standard_error (n, 3) in W/m².
    areas : (n,)
        Weight of each point in the area: m², times the weight of a drawn point (see
        `views.compared_points`).
    visible : (n,) or None
        Weight of each point in what a sensor sees (see `views.visible_weights`), times the same;
        None without a sensor.
    near : (n,) bool
        Points beside an emitter, see `near_emitters.near_emitters`.

    Returns
    -------
    dict
        relative_rmse, bias, reference_noise, relative_rmse_beyond_noise, brightest_share,
        median_relative_error and median_reference_noise, weighted by area, over points that are
        not near; visible{the same} by what is seen of these (None without a sensor);
        near_emitters{count, the same} by area, of the others. Values are None where no point has a
        weight.
    """
    far = ~np.asarray(near, bool)

    def over(chosen, weights):
        chosen = chosen & (np.asarray(weights) > 0)
        part = Reference(reference.mean[chosen], reference.standard_error[chosen])
        return _errors(np.asarray(result)[chosen], part, np.asarray(weights)[chosen])

    return over(far, areas) | {
        "visible": None if visible is None else over(far, visible),
        "near_emitters": {"count": int((~far).sum())} | over(~far, areas),
    }


def image_errors(result, expected, covered, emits):
    """Errors of an image: the linear ones over pixels that geometry covers wholly and that show no
    emitter; PSNR over those that geometry covers, FLIP over the whole image.

    Parameters
    ----------
    result : (h, w, 3)
        Linear radiance.
    expected : Reference
        mean and standard_error (h, w, 3).
    covered, emits : (h, w) bool
        See `views.first_hits`.

    Returns
    -------
    dict
        relative_rmse, bias, reference_noise, relative_rmse_beyond_noise, brightest_share,
        median_relative_error, median_reference_noise, psnr, flip, exposure (factor of the displayed
        images), covered and emitting (shares of the pixels), emitting_norm_share (of the squared
        norm over covered pixels, how much the emitting ones hold), size.

    Raises
    ------
    SettingsError
        If no pixel is covered, or all that are show an emitter.
    """
    if not covered.any():
        raise SettingsError("the sensor sees no surface: nothing to compare in the image")
    counted = covered & ~emits
    if not counted.any():
        raise SettingsError(
            f"all {int(covered.sum()):,} pixels that a surface covers show an emitter: nothing to"
            " compare in the image; choose another sensor or a larger size"
        )
    factor = exposure(expected.mean[covered])
    shown, truth = display(result, factor), display(expected.mean, factor)
    mean_flip, _ = metrics.flip(shown, truth)
    part = Reference(expected.mean[counted], expected.standard_error[counted])
    squares = np.sum(np.square(expected.mean, dtype=np.float64), axis=-1) * covered
    return _errors(result[counted], part) | {
        "psnr": metrics.psnr(shown, truth, covered),
        "flip": mean_flip,
        "exposure": factor,
        "covered": float(covered.mean()),
        "emitting": float(emits.mean()),
        "emitting_norm_share": float(squares[emits].sum() / max(squares.sum(), 1e-300)),
        "size": [result.shape[1], result.shape[0]],
    }


def _errors(result, reference, weights=None):
    if not len(result):
        return dict.fromkeys(_KEYS)
    rmse = metrics.relative_rmse(result, reference.mean, weights)
    noise = metrics.relative_noise(reference, weights)
    values = (
        rmse,
        metrics.relative_bias(result, reference.mean, weights),
        noise,
        float(np.sqrt(max(rmse**2 - noise**2, 0.0))),
        metrics.brightest_share(reference.mean, weights=weights),
        metrics.median_relative_error(result - reference.mean, reference.mean, weights),
        metrics.median_relative_error(reference.standard_error, reference.mean, weights),
    )
    return dict(zip(_KEYS, values, strict=True))


_KEYS = (
    "relative_rmse",
    "bias",
    "reference_noise",
    "relative_rmse_beyond_noise",
    "brightest_share",
    "median_relative_error",
    "median_reference_noise",
)
