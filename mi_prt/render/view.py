"""Where a sensor puts the world in an image, for the raster renderers."""

import warnings
from dataclasses import dataclass

import numpy as np

from ..errors import SettingsError
from ..scene.traversal import transform_of
from ..system.runtime import mitsuba

SENSORS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
}


@dataclass(frozen=True, eq=False)
class View:
    """Where a sensor puts the world. Positions in the image go from (0, 0), upper left, to (1, 1),
    lower right.

    Parameters
    ----------
    size : (width, height)
    image : (2, 4)
        World to the first two rows of OpenGL's clip space.
    eye : (4,)
        Position of the viewer; for parallel rays the direction to it, with w = 0.
    axis : (4,)
        Dot product with a position (x, y, z, 1): how far it is in front of the viewer, along the
        axis.
    near, far : float
        What is seen lies between these distances along the axis.
    """

    size: tuple
    image: np.ndarray
    eye: np.ndarray
    axis: np.ndarray
    near: float
    far: float

    @property
    def to_clip(self):
        """World to OpenGL's clip space, (4, 4) float64."""
        return np.vstack([self.image, *self._z_and_w(self.axis, np.array([0, 0, 0, 1]))])

    def window_depth(self, distance):
        """What OpenGL compares, 0 at the near plane and 1 at the far one, of some distances along
        the axis.
        """
        z, w = self._z_and_w(distance, 1)
        return (1 + z / w) / 2

    def _z_and_w(self, distance, one):
        """The last two of clip space's coordinates, linear in a distance along the axis."""
        near, far = self.near, self.far
        if self.eye[3]:
            return ((far + near) * distance - 2 * far * near * one) / (far - near), distance
        return (2 * distance - (far + near) * one) / (far - near), one

    @property
    def depth(self):
        """Dot product with a position (x, y, z, 1): 0 at the near plane, 1 at the far plane."""
        return (self.axis - [0, 0, 0, self.near]) / (self.far - self.near)

    def directions(self, x, y):
        """Unit directions (k, 3) of rays through positions x, y (k,) in the image."""
        ones = np.ones_like(x)
        far = np.linalg.solve(self.to_clip, [2 * x - ones, ones - 2 * y, ones, ones])
        directions = (
            far[:3] / far[3] - self.eye[:3, None] if self.eye[3] else -self.eye[:3, None] * ones
        ).T
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def view_of(sensor):
    """The view of a sensor, from its own rays through two corners of the image.

    Raises
    ------
    SettingsError
        If the sensor is of a kind that is not in `SENSORS`.
    """
    kind = sensor.class_name()
    if kind not in SENSORS:
        raise SettingsError(
            f"the raster renderer draws {', '.join(SENSORS.values())} sensors, not {kind}: use"
            " mitsuba"
        )
    if kind == "ThinLensCamera":
        warnings.warn(
            "the raster renderer draws a thinlens sensor as a pinhole, all in focus", stacklevel=3
        )
    to_world = transform_of(sensor)
    to_camera = np.linalg.inv(to_world)
    corners = rays(sensor, [0, 1], [0, 1])
    # In Mitsuba's camera space, x to the left, y up, and z forward. Clip space is x to the right,
    # -1 to 1 times w.
    if kind == "OrthographicCamera":
        (x0, x1), (y0, y1), _ = (
            to_camera[:3, :3] @ np.array(corners.o, np.float64) + to_camera[:3, 3:]
        )
        eye, centre = -to_world[:, 2], 3
    else:
        x, y, z = to_camera[:3, :3] @ np.array(corners.d, np.float64)
        (x0, x1), (y0, y1) = x / z, y / z
        eye, centre = to_world[:, 3], 2
    image = np.zeros((2, 4))
    image[0, [0, centre]] = np.array([2, -x0 - x1]) / (x1 - x0)
    image[1, [1, centre]] = np.array([2, -y0 - y1]) / (y0 - y1)
    size = tuple(map(int, sensor.film().crop_size()))
    return View(size, image @ to_camera, eye, to_camera[2], sensor.near_clip(), sensor.far_clip())


def rays(sensor, x, y):
    """The sensor's rays (mi.Ray3f) through positions x, y (k,) in the image, without blur."""
    mi = mitsuba()
    image = mi.Point2f(np.stack([x, y]).astype(np.float32))
    return sensor.sample_ray(0.0, 0.5, image, mi.Point2f(0.5))[0]
