"""From linear radiance to what a display shows."""

from math import isfinite, log2

import numpy as np

from ..errors import SettingsError

MOST_EV = 100  # of an exposure, either way

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB primaries (Rec. 709)


def exposure(radiance):
    """Factor that takes the log-average luminance of radiance (…, 3) to 0.18, mid grey; 1 where all
    is black.
    """
    luminance = np.asarray(radiance) @ LUMINANCE
    positive = luminance[luminance > 0]
    return float(0.18 / np.exp(np.log(positive).mean())) if positive.size else 1.0


def check_exposure(value):
    """An exposure that was asked for: 'auto', or EV as a float.

    Raises
    ------
    SettingsError
        If it is neither, or not within ±100 EV.
    """
    if value == "auto":
        return value
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = float("nan")
    if isinstance(value, bool) or not (isfinite(found) and abs(found) <= MOST_EV):
        raise SettingsError(
            f"exposure {value!r} must be auto, or a number of EV within ±{MOST_EV}: one more shows"
            " twice the light (--exposure 0 shows radiance 1 as white)"
        )
    return found


def exposure_factor(value, radiance):
    """The factor of an exposure: 2^EV, or `exposure` of radiance (…, 3) where it is 'auto'."""
    return exposure(radiance) if value == "auto" else 2.0**value


def exposure_report(factor):
    """What a result says of its exposure: the EV of a factor."""
    return {"ev": round(log2(factor), 4), "factor": factor}


def display(radiance, factor):
    """Linear radiance as a display shows it: exposed, clipped to 0…1, sRGB encoded; float32."""
    x = np.clip(np.asarray(radiance) * factor, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055).astype(
        np.float32
    )
