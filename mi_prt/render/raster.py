"""Raster images of an asset by pyrender: the triangles between its points, without tracing a ray at
them.

They show what the integrator `prt` shows: irradiance interpolated between points times albedo, and
what is seen of the emitters. Differences remain at outlines (curved shapes are the polygons between
their points), at edges within textures (a pixel has few samples), and where a texture is larger
than 4096 texels over a surface.

The program's own shaders draw linear radiance into a float32 image. pyrender's framebuffer would
round each sample to 8 bits and mix the colour of its background into outlines before the real
background is known.

Importing this module opens OpenGL.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from ..errors import SceneError, SettingsError
from ..system.runtime import mitsuba
from .canvas import draw, drawing, make_current, new_primitive, open_canvas
from .display import display
from .view import view_of

MIN_TEXELS, MAX_TEXELS = 512, 4096  # along a side of a baked texture
PROCEDURAL_TEXELS = 256  # along a period of a texture that is no bitmap
# of buried points in interpolation: nothing beside others, all where there are no others
BURIED_WEIGHT = 1e-5


def render_raster(asset, scene, irradiance, sensor, factor, samples=2):
    """Displayed image of a scene lit from an asset. See `RasterScene`, which draws many.

    Parameters
    ----------
    asset : Asset
    scene : Scene
    irradiance : (n, 3)
        W/m² at the asset's points.
    sensor : mi.Sensor
    factor : float
        Exposure, see `display`.
    samples : int
        Along each side of a pixel.

    Returns
    -------
    (h, w, 3) float32
        0…1, sRGB encoded.
    """
    with RasterScene(asset, scene, sensor, samples) as raster:
        return raster.draw(irradiance, factor)


class RasterScene:
    """A scene as one sensor sees it, to be drawn under changing light; a context manager, see
    `close`.

    Each pixel is the mean of its samples' linear radiance, as in Mitsuba with a box filter,
    whatever the film's own filter is.

    Parameters
    ----------
    asset : Asset
    scene : Scene
        That of the asset. Its environment is the background, its area lights are seen.
    sensor : mi.Sensor
        perspective, orthographic, or thinlens (drawn without its blur). The film's crop window is
        respected.
    samples : int
        Along each side of a pixel: 2 for four in all.

    Raises
    ------
    SettingsError
        If the sensor is of another kind, or the image too large for OpenGL.
    SceneError
        If the scene is not the asset's.
    RuntimeSetupError
        If OpenGL cannot be opened.

    Notes
    ----- Radiance of area lights is interpolated between their points. Shapes that have no points
    are not drawn.
    """

    def __init__(self, asset, scene, sensor, samples=2):
        if samples < 1:
            raise SettingsError(f"samples must be ≥ 1 along each side of a pixel, got {samples}")
        _check_surfaces(scene, asset.points)
        self._view = view_of(sensor)
        self._scene, self._samples = scene, samples
        self._weight = np.where(asset.buried, np.float32(BURIED_WEIGHT), np.float32(1))[:, None]
        self._reflection, self._emission, albedo = _shading(scene, asset.points)
        self._parts = _parts(scene, asset.points)
        width, height = self._view.size
        self._canvas = open_canvas(width * samples, height * samples)
        self._primitives = [new_primitive(part, asset.points, albedo) for part in self._parts]
        self._drawing = drawing(self._primitives, self._view)
        self._sky = None

    def draw(self, irradiance, factor, background=None):
        """Displayed image (h, w, 3) float32, 0…1. See `radiance` and `display`."""
        return display(self.radiance(irradiance, background), factor)

    def radiance(self, irradiance, background=None):
        """Image of linear radiance.

        Parameters
        ----------
        irradiance : (n, 3)
            W/m² at the asset's points.
        background : mi.Scene, optional
            Whose environment is seen; by default that of the scene, as it is now.

        Returns
        -------
        (h, w, 3) float32
        """
        if np.shape(irradiance) != self._emission.shape:
            raise SettingsError(
                f"irradiance must be of shape {self._emission.shape}, got {np.shape(irradiance)}"
            )
        light = np.hstack(
            [self._weight * (self._reflection * irradiance + self._emission), self._weight]
        )
        make_current()
        for part, primitive in zip(self._parts, self._primitives):
            primitive.color_0 = light[part.points]
            if primitive._in_context():
                primitive._remove_from_context()
                primitive._add_to_context()
        drawn = draw(self._canvas, self._drawing)
        self._add_background(drawn, (background or self._scene.mi_scene).environment())
        k = self._samples
        return sum(drawn[i::k, j::k, :3] for i in range(k) for j in range(k)) / np.float32(k * k)

    def close(self):
        """Free what OpenGL holds."""
        make_current()
        self._canvas.delete()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.close()

    def _add_background(self, drawn, environment):
        """Fill the samples (h, w, 4) that no triangle covers with the radiance of an emitter, or
        leave them black.
        """
        import drjit as dr

        uncovered = drawn[..., 3] == 0
        if environment is None or not uncovered.any():
            return
        if self._sky is None:  # the same directions in each image
            row, column = np.nonzero(uncovered)
            height, width = uncovered.shape
            directions = self._view.directions((column + 0.5) / width, (row + 0.5) / height)
            self._sky = dr.zeros(mitsuba().SurfaceInteraction3f, len(row))
            self._sky.wi = mitsuba().Vector3f(-directions.T.astype(np.float32))
        drawn[uncovered, :3] = _rgb(environment.eval(self._sky), uncovered.sum())


# --- triangles and what they reflect --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Part:
    """Triangles that share a texture.

    Parameters
    ----------
    points : (v,) int
        The asset's point at each vertex.
    uv : (v, 2) float32
        Into the texture, 0…1.
    triangles : (m, 3) int
        Of vertices.
    texture : (h, w, 3) float16 or None
        Albedo; None where the points' own is enough.
    """

    points: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray
    texture: np.ndarray | None


def _check_surfaces(scene, points):
    known = len(points.surfaces)
    added = [s.name for s in scene.surfaces[known:]]
    unlike = [s.kind for s in scene.surfaces[:known]] != [s["kind"] for s in points.surfaces]
    if unlike or not all(s.shape.is_emitter() for s in scene.surfaces[known:]):
        raise SceneError(
            "the scene's shapes are not those of the asset: pass the scene that it was precomputed"
            " from"
        )
    bare = [s["name"] for s in points.surfaces if not s["patches"]] + added
    if bare:
        warnings.warn(
            f"the raster renderer leaves out shapes without points: {', '.join(bare)}", stacklevel=3
        )


def _parts(scene, points):
    """The triangles of both sides: one part for each side of a textured surface, one for all other
    surfaces.
    """
    backs = _backs(points)
    fronts = points.layout.triangles()
    surface = points.surface[fronts[:, 0]]
    textured = np.array([_is_baked(s) for s in scene.surfaces])
    plain = fronts[~textured[surface]]
    back = backs[points.surface[plain[:, 0]], None]
    plain = np.concatenate([plain, (plain + back)[back[:, 0] > 0]])
    parts = (
        [_Part(np.arange(len(points)), np.zeros_like(points.uv), plain, None)] if len(plain) else []
    )
    for i in np.unique(surface[textured[surface]]):
        vertices, uv, triangles = _textured_triangles(points, i, fronts[surface == i])
        low, high = uv.min(axis=0), uv.max(axis=0)
        extent = np.maximum(high - low, 1e-6)
        for side in (1, -1) if backs[i] else (1,):
            texture = _bake(scene.surfaces[i], side, low, extent)
            parts.append(
                _Part(
                    vertices + (backs[i] if side < 0 else 0),
                    (uv - low) / extent,
                    triangles,
                    texture,
                )
            )
    return parts


def _backs(points):
    """What takes a point of each surface to the point behind it, (surfaces,) int; 0 where the back
    does not reflect.
    """
    return np.array(
        [points.layout.back[s["first_patch"]] if s["patches"] else 0 for s in points.surfaces]
    )


def _textured_triangles(points, index, fronts):
    """Vertices (v,) as points, their uv (v, 2), and triangles (m, 3) of vertices, of a surface's
    front.
    """
    if points.surfaces[index]["kind"] == "mesh":
        vertices, triangles = np.unique(fronts, return_inverse=True)
        return vertices, points.uv[vertices], triangles.reshape(-1, 3)
    # Points on the seam of an analytic shape have two uv: each node of its patches is a vertex.
    nodes, uv, triangles = points.layout.domain(points.surfaces[index]["first_patch"])
    return nodes, uv.astype(np.float32), triangles


def _shading(scene, points):
    """What takes irradiance E at the points to a light r·E + e that, times albedo a, is their
    radiance.

    Returns
    -------
    reflection, emission : (n, 3) float32
    albedo : (n, 4) float32
        The fourth is 1 where the other side of the surface has points too, plus 2 on analytic
        shapes.
    """
    reflection = np.full((len(points), 3), 1 / np.pi, np.float32)
    emission = np.zeros((len(points), 3), np.float32)
    flags = (_backs(points) > 0) + 2 * np.array([s["kind"] != "mesh" for s in points.surfaces])
    albedo = np.hstack([points.albedo, flags[points.surface, None]]).astype(np.float32)
    for i, surface in enumerate(scene.surfaces[: len(points.surfaces)]):
        if surface.shape.emitter() is None or not points.surfaces[i]["patches"]:
            continue
        own = np.flatnonzero(points.surface == i)
        reflection[own] *= points.albedo[own]
        albedo[own, :3] = 1
        front = own[: len(own) // 2] if flags[i] % 2 else own
        emission[front] = _emitted(surface, points.uv[front])
    return reflection, emission, albedo


def _emitted(surface, uv):
    """Radiance (k, 3) of an area light towards its front at some uv (k, 2)."""
    return _rgb(surface.shape.emitter().eval(_interaction(surface, uv)), len(uv))


def _is_baked(surface):
    """Whether a surface has textures over uv.

    For attributes of meshes, and on lights, the points' albedo must do.
    """
    modelled = surface.material.modelled
    has_map = any(key.endswith("to_uv") for key in mitsuba().traverse(modelled).keys())
    return has_map and "MeshAttribute" not in str(modelled) and surface.shape.emitter() is None


def _bake(surface, side, low, extent):
    """Albedo (h, w, 3) float16 of a side of a surface over the box low + [0, extent] of uv."""
    width, height = _texels(surface.material.modelled, extent)
    v, u = (np.indices((height, width)).reshape(2, -1) + 0.5) / [[height], [width]]
    uv = (low + np.stack([u, v], axis=-1) * extent).astype(np.float32)
    albedo = surface.material.modelled.eval_diffuse_reflectance(_interaction(surface, uv, side))
    return _rgb(albedo, len(uv)).astype(np.float16).reshape(height, width, 3)


def _texels(bsdf, extent):
    """Texels (width, height) that show a material's bitmaps over an extent (2,) of uv.

    Those of the bitmap itself, so that nothing is resampled; a multiple of them where they are few,
    so that it does not matter if the bitmap is turned against uv.
    """
    parameters = mitsuba().traverse(bsdf)
    wanted = [(1, 1)]
    for key in parameters.keys():
        if key.endswith("to_uv"):
            data = key.removesuffix("to_uv") + "data"
            shape = (
                parameters[data].shape[1::-1]
                if data in parameters
                else (PROCEDURAL_TEXELS, PROCEDURAL_TEXELS)
            )
            to_texels = np.array(parameters[key].matrix, dtype=np.float64)[:2, :2] * np.reshape(
                shape, (2, 1)
            )
            wanted.append(np.linalg.norm(to_texels, axis=0) * extent)
    texels = np.max(wanted, axis=0)
    return np.minimum(np.rint(texels * np.ceil(MIN_TEXELS / texels)), MAX_TEXELS).astype(int)


def _interaction(surface, uv, side=1):
    """Points at some uv (k, 2) of a surface, seen straight from its front (1) or back (-1)."""
    import drjit as dr

    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(uv.T)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.wi = mi.Vector3f(0, 0, side)
    si.shape = mi.ShapePtr(surface.shape)
    return si


def _rgb(colour, count):
    """A Mitsuba colour as (count, 3)."""
    return np.broadcast_to(np.array(mitsuba().Color3f(colour)).reshape(3, -1).T, (count, 3))
