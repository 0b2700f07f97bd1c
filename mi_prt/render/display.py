"""From linear radiance to what a display shows."""

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB primaries (Rec. 709)


def exposure(radiance):
    """Factor that takes the log-average luminance of radiance (…, 3) to 0.18, mid grey; 1 where all
    is black.
    """
    luminance = np.asarray(radiance) @ LUMINANCE
    positive = luminance[luminance > 0]
    return float(0.18 / np.exp(np.log(positive).mean())) if positive.size else 1.0


def display(radiance, factor):
    """Linear radiance as a display shows it: exposed, clipped to 0…1, sRGB encoded; float32."""
    x = np.clip(np.asarray(radiance) * factor, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055).astype(
        np.float32
    )
