"""Any distant emitter as an environment map: analytic skies with their suns."""

import numpy as np

from ..system.runtime import mitsuba
from .environment import EnvironmentMap
from .summed import column_factors, directions_of, pixel_directions, row_factors

BAKED_HEIGHT = 512  # rows of the map that an analytic sky is baked to
SKY_SAMPLES = 8  # samples of every pixel
SUN_SAMPLES = 1 << 24  # samples shared by the pixels in which a sun was found
MOST_SUN_SAMPLES = 1 << 16  # samples of one of them
SUN_SEARCH = 1 << 16  # emitter samples that look for a sun


def baked(emitter):
    """Any other emitter, averaged over the pixels of a map; pixels that hold a sun are sampled
    densely.

    Samples that Mitsuba itself would take of the emitter tell where a sun is: those brighter than
    the map has them mark pixels to refine, and so does contrast within a pixel.
    """
    from scipy.ndimage import maximum_filter  # slow to import

    height, width = BAKED_HEIGHT, 2 * BAKED_HEIGHT
    every = np.indices((height, width)).reshape(2, -1).T
    pixels, contrast = (
        x.reshape(height, width, -1) for x in _pixel_means(emitter, every, height, SKY_SAMPLES)
    )
    mi = mitsuba()
    side = int(SUN_SEARCH**0.5)
    grid = (np.indices((side, side)).reshape(2, -1) + 0.5) / side
    sample, weight = emitter.sample_direction(origin(side * side), mi.Point2f(grid))
    direction = np.array(sample.d).T
    row, column = _pixel_of(direction, height)
    brighter = (rgb_of(weight) * np.array(sample.pdf)[:, None]).max(axis=1) > 1.5 * pixels[
        row, column
    ].max(axis=1) + 1e-6
    marked = contrast[..., 0] > 1.5
    marked[row[brighter], column[brighter]] = True
    # A neighbour may hold the edge of what was found; around a pole all columns are neighbours.
    marked = maximum_filter(marked, 3, mode=("nearest", "wrap"))
    for pole in (slice(0, 3), slice(-3, None)):
        marked[pole] |= marked[pole].any()
    found = np.argwhere(marked)
    if len(found):
        samples = int(np.clip(SUN_SAMPLES // len(found), 2 * SKY_SAMPLES, MOST_SUN_SAMPLES))
        pixels[marked], _ = _pixel_means(emitter, found, height, samples)
    # Near the horizon Mitsuba's sun leaves the sRGB gamut, and one channel of it is negative.
    return EnvironmentMap(np.maximum(pixels, 0))


def _pixel_means(emitter, pixels, height, samples):
    """Mean radiance (k, 3) of the pixels (row, column).

    Samples are weighted by the pixel's hat in bilinear interpolation: the interpolated map then has
    the emitter's energy, at the poles too. Also the contrast (k, 1) within each pixel: its largest
    sample over its mean.
    """
    # A golden-ratio lattice, all of whose samples have latitudes of their own: at a pole the edge
    # of a sun runs along rows.
    place = np.arange(samples) + 0.5
    offsets = 2 * np.stack([place / samples, place * (5**0.5 - 1) / 2 % 1], axis=-1) - 1
    sums, weights, largest = 0.0, 0.0, 0.0
    for chunk in np.array_split(offsets, max(1, len(pixels) * len(offsets) >> 20)):
        directions = _directions_in(pixels, chunk, height)
        radiance = evaluate(emitter, directions.reshape(-1, 3)).reshape(directions.shape)
        sine = np.hypot(directions[..., 0], directions[..., 2])
        weight = sine * (1 - np.abs(chunk)).prod(axis=1)
        sums = sums + (radiance * weight[..., None]).sum(axis=1)
        weights = weights + weight.sum(axis=1)[:, None]
        largest = np.maximum(largest, radiance.max(axis=(1, 2)))
    means = sums / np.maximum(weights, 1e-12)
    return means, (largest / np.maximum(means.max(axis=1), 1e-12))[:, None]


def _directions_in(pixels, offsets, height):
    """Directions (k, o, 3) of places in pixels (k, 2); for many pixels from factors of each row and
    column.
    """
    if len(pixels) < 4 * height:
        places = pixels[:, None] + offsets
        return pixel_directions(places[..., 0], places[..., 1], height, 2 * height)
    rows = row_factors(np.arange(height)[:, None] + offsets[:, 0], height)
    columns = column_factors(np.arange(2 * height)[:, None] + offsets[:, 1], 2 * height)
    return directions_of(*(x[pixels[:, 0]] for x in rows), *(x[pixels[:, 1]] for x in columns))


def _pixel_of(directions, height):
    x, y, z = directions.T
    row = np.rint(np.arccos(np.clip(y, -1, 1)) * ((height - 1) / np.pi)).astype(np.int64)
    column = np.floor(np.arctan2(x, -z) * (height / np.pi)).astype(np.int64) % (2 * height)
    return row, column


def evaluate(emitter, directions):
    """Radiance (k, 3) that arrives from directions (k, 3)."""
    import drjit as dr

    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(directions.T.astype(np.float32))
    return np.broadcast_to(rgb_of(emitter.eval(si)), directions.shape)


def origin(count):
    import drjit as dr

    return dr.zeros(mitsuba().Interaction3f, count)


def rgb_of(colour):
    return np.array(mitsuba().Color3f(colour)).reshape(3, -1).T.astype(np.float64)
