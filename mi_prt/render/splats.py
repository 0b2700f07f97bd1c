"""Splats: raster images of a scene lit at sample points, without triangles between them (Meshless
PRT, section 5).

Each sample is an elliptical Gaussian: a disk in its tangent plane, seen exactly as the sensor sees
it. What the sensor sees is found once, by a ray for each sample of the image. Splats are added up
on it, weighted by how near they are to the place that is seen and how alike the normals are. So
outlines and creases are those of the scene and textures are as fine as the image, however few the
points are; and nothing leaks through a wall or round a corner.

Importing this module opens OpenGL.
"""

from dataclasses import replace

import numpy as np

from ..errors import SettingsError
from ..scene.materials import facing, reflectance_at
from ..system.runtime import mitsuba
from .canvas import check_size
from .display import display
from .splat_canvas import SplatCanvas
from .view import rays, view_of

SHARPNESS = 3.0  # radii of a splat over its standard deviation
FLATNESS = 4.0  # radii of a splat over how far off its plane it still reaches
# cosine to the viewer below which a splat is left out; normals of curved surfaces turn within a
# splat
BACK_FACING = -0.3
RANGE = 1e5  # most that the far plane is farther than the near one
RAYS = 1 << 22  # at a time


class SplatScene:
    """A scene as one sensor sees it, to be drawn by splats under changing light; a context manager,
    see `close`.

    Each pixel is the mean of its samples' linear radiance, as in Mitsuba with a box filter,
    whatever the film's own filter is. The radiance of a sample is albedo/π times the mean
    irradiance of the splats there, plus what is seen of emitters.

    A splat of radius r counts where d < r, with d² = |q|² + (4² − 1)(q·n)² for the way q from its
    centre to what is seen. Its weight is exp(−½ (3d/r)²) · max(0, n·n')⁸, n' being the normal of
    what is seen. On a plane that is a Gaussian of standard deviation r/3, cut at the disk's edge;
    off its plane it reaches no farther than r/4.

    Parameters
    ----------
    positions, normals : (n, 3)
        Of the samples, in metres; unit normals on the side that they stand for.
    radii : (n,)
        Of the splats in metres. Twice the spacing of blue noise makes a dozen overlap.
    scene : Scene
        As it is to be seen: with its environment as background and its area lights.
    sensor : mi.Sensor
        perspective, orthographic, or thinlens (drawn without its blur). The film's crop window is
        respected.
    samples : int
        Along each side of a pixel: 2 for four in all.

    Raises
    ------
    SettingsError
        If the sensor is of another kind, the image too large for OpenGL, an array of another shape,
        or a radius not positive.
    RuntimeSetupError
        If OpenGL cannot be opened.

    Notes
    -----
    Surfaces that no splat reaches are black, but for the light that they emit.
    """

    def __init__(self, positions, normals, radii, scene, sensor, samples=2):
        if samples < 1:
            raise SettingsError(f"samples must be ≥ 1 along each side of a pixel, got {samples}")
        splats = _splats(positions, normals, radii)
        view = view_of(sensor)
        check_size(*(samples * side for side in view.size))
        surface, reflected, self._emitted = _see(scene, sensor, view, samples)
        view, depth = _bounded(view, surface[..., 3], 2 * splats[:, 3].max())
        toward = view.eye[:3] - view.eye[3] * splats[:, :3]
        distance = np.linalg.norm(toward, axis=1)
        self._facing = np.flatnonzero(
            np.einsum("ij,ij->i", toward, splats[:, 4:]) >= BACK_FACING * distance
        )
        self._count = len(splats)
        constants = {"SHARPNESS": SHARPNESS, "FLATNESS": FLATNESS}
        splats = splats[self._facing]
        self._canvas = SplatCanvas(view, samples, surface, reflected, depth, splats, constants)

    def draw(self, irradiance, factor):
        """Displayed image (h, w, 3) float32, 0…1. See `radiance` and `display`."""
        return display(self.radiance(irradiance), factor)

    def radiance(self, irradiance):
        """Image of linear radiance.

        Parameters
        ----------
        irradiance : (n, 3)
            W/m² at the samples.

        Returns
        -------
        (h, w, 3) float32
        """
        if np.shape(irradiance) != (self._count, 3):
            raise SettingsError(
                f"irradiance must be of shape ({self._count}, 3), got {np.shape(irradiance)}"
            )
        return self._canvas.draw(np.asarray(irradiance, np.float32)[self._facing]) + self._emitted

    def close(self):
        """Free what OpenGL holds."""
        self._canvas.delete()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.close()


def _splats(positions, normals, radii):
    """Centre, radius and normal in one array, (n, 7) float32."""
    count = len(positions)
    for name, values, shape in (
        ("positions", positions, (count, 3)),
        ("normals", normals, (count, 3)),
        ("radii", radii, (count,)),
    ):
        if np.shape(values) != shape:
            raise SettingsError(
                f"{name} of {count} splats must be of shape {shape}, got {np.shape(values)}"
            )
    splats = np.column_stack([positions, radii, normals]).astype(np.float32)
    if not len(splats) or not np.isfinite(splats).all() or splats[:, 3].min() <= 0:
        raise SettingsError(
            "splats must be 1 or more, at finite positions and of finite radii > 0: check the"
            " sample points"
        )
    return splats


def _see(scene, sensor, view, samples):
    """What each sample of an image, (H, W), or each pixel, (h, w), shows.

    Returns
    -------
    surface : (H, W, 4) float32
        Unit normal on the side that is seen, and distance along the view's axis; that is 0 where
        there is nothing.
    reflected : (H, W, 3) float32
        Radiance per irradiance.
    emitted : (h, w, 3) float32
        Radiance that comes straight from emitters.
    """
    import drjit as dr

    mi = mitsuba()
    width, height = (samples * side for side in view.size)
    surface, reflected = (
        np.empty((width * height, 4), np.float32),
        np.empty((width * height, 3), np.float32),
    )
    emitted = np.empty((width * height, 3), np.float32)
    axis, from_eye = (
        dr.opaque(mi.Vector3f, view.axis[:3].tolist()),
        dr.opaque(mi.Float, float(view.axis[3])),
    )
    for first in range(0, width * height, RAYS):
        block = slice(first, min(first + RAYS, width * height))
        row, column = np.divmod(np.arange(block.start, block.stop), width)
        ray = rays(sensor, (column + 0.5) / width, (row + 0.5) / height)
        pi = scene.mi_scene.ray_intersect_preliminary(ray)
        si = scene.interaction(pi, ray, True)
        hit = si.is_valid()
        light = mi.Color3f(si.emitter(scene.mi_scene).eval(si))
        normals, si.wi, reflects = facing(si, ray, scene.surfaces)
        albedo = dr.select(hit & reflects, reflectance_at(si, scene.surfaces, hit & reflects), 0)
        distance = dr.select(hit, dr.dot(axis, si.p) + from_eye, 0)
        dr.eval(normals.shading, distance, albedo, light)
        surface[block, :3], surface[block, 3] = np.array(normals.shading).T, np.array(distance)
        reflected[block], emitted[block] = np.array(albedo).T / np.float32(np.pi), np.array(light).T
    mean = emitted.reshape(height // samples, samples, width // samples, samples, 3).mean(
        axis=(1, 3)
    )
    return surface.reshape(height, width, 4), reflected.reshape(height, width, 3), mean


def _bounded(view, distance, reach):
    """The view between the nearest and the farthest of what is seen, and depths (H, W) float32
    behind which nothing counts.

    Parameters
    ----------
    view : View
    distance : (H, W)
        Along its axis; 0 where nothing is seen.
    reach : float
        Metres behind what is seen in which a splat can still count.
    """
    reach *= np.linalg.norm(view.axis[:3])
    seen = distance > 0
    if seen.any():
        far = float(distance.max()) + 2 * reach
        view = replace(
            view, near=max(view.near, float(distance[seen].min()) - reach, far / RANGE), far=far
        )
    depth = np.where(seen, view.window_depth(np.where(seen, distance + reach, 1)), 0)
    return view, depth.astype(np.float32)
