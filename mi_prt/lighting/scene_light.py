"""Between Mitsuba's emitters and this program's light: the distant light of a scene, and a scene
under other light.

Its local light is in `local_emitters`.
"""

import numpy as np
import scipy.ndimage

from ..errors import LightError
from ..scene.scene import is_dark, rebuilt_scene
from ..scene.traversal import children, transform_of
from ..system.runtime import mitsuba
from .environment import EnvironmentMap
from .light import DirectionalLight, Light, as_light
from .local_emitters import local_scene_light

SCENE = "scene"  # the scene's own distant light, in a list of lights
BAKED_HEIGHT = 512  # rows of the map that an analytic sky is baked to
SKY_SAMPLES = 8  # samples of every pixel
SUN_SAMPLES = 1 << 24  # samples shared by the pixels in which a sun was found
MOST_SUN_SAMPLES = 1 << 16  # samples of one of them
SUN_SEARCH = 1 << 16  # emitter samples that look for a sun
# of the grid on which unlike maps are summed; odd, so that its nodes hold those of the largest map
SUM_REFINEMENT = 3
BAND = 1 << 20  # pixels resampled at a time


def scene_light(scene):
    """All distant light of a scene: `envmap`, `constant`, `sunsky`, `directional`, and any other
    distant emitter.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Light

    Raises
    ------
    LightError
        If the scene has no distant emitter, or one holds NaN, infinite or negative radiance.
    """
    if not scene.distant_emitters:
        raise LightError(
            "the scene has no distant light (envmap, constant, sunsky, directional): pass a light"
        )
    return emitters_light(scene.distant_emitters)


def emitters_light(emitters):
    """The sum of some distant emitters as Light; see `scene_light`."""
    maps, directionals = [], []
    for emitter in emitters:
        kind = emitter.class_name()
        if kind == "DirectionalEmitter":
            directionals.append(_directional(emitter))
        elif kind == "EnvironmentMapEmitter":
            maps.append(_environment_map(emitter))
        elif kind == "ConstantBackgroundEmitter":
            radiance = _evaluate(emitter, np.array([[0.0, 1.0, 0.0]]))
            maps.append(EnvironmentMap(np.broadcast_to(radiance, (2, 4, 3))))
        else:
            maps.append(_baked(emitter))
    return Light(tuple(maps), tuple(directionals))


def lit_scene(mi_scene, light=None, keep_local=True):
    """The same shapes and sensors as a new mi.Scene under other light, with watertight
    intersections.

    An area light becomes a rectangle that reflects nothing. It is a shape like others then: it
    blocks light, which the area light of this program does not, and is seen in pictures.

    Parameters
    ----------
    mi_scene : mi.Scene
    light : what `as_light` accepts, optional
        Takes the place of the scene's distant emitters; by default they stay.
    keep_local : bool
        Whether the scene's local emitters stay. Shapes stay in any case, and with them emitters on
        them: to leave out local emitters, pass a scene in which those are dark, as `Scene.modelled`
        and `Scene.unlit` are.

    Returns
    -------
    mi.Scene

    Raises
    ------
    LightError
        If the light has emissions (they stand for emitters of a scene, which are kept in it
        instead), or a shape shines that should not.

    Notes
    -----
    Mitsuba takes one environment map, so several become one, see `summed_maps`.
    """
    mi = mitsuba()
    kept = []
    for _, child in children(mi_scene):
        if isinstance(child, mi.Emitter):
            stays = (
                light is None
                if mi.has_flag(child.flags(), mi.EmitterFlags.Infinite)
                else keep_local
            )
        else:
            stays = isinstance(child, mi.Shape | mi.Sensor)
            if (
                isinstance(child, mi.Shape)
                and child.is_emitter()
                and not keep_local
                and not is_dark(child.emitter())
            ):
                raise LightError(
                    f"shape '{child.id()}' shines: to leave out local light, pass what Scene.unlit"
                    " or modelled gives"
                )
        if stays:
            kept.append(child)
    return rebuilt_scene(kept, None if light is None else _emitters(as_light(light)))


def turned_light(scene, light=None, rotate=None):
    """The light to show a scene in.

    Parameters
    ----------
    scene : Scene or None
        Whose own distant light is taken where `light` is None, or in the place of 'scene' in a
        list; not needed otherwise.
    light : what `as_light` accepts, or a list of such and 'scene', optional
    rotate : (axis, degrees), optional
        Turns the distant light.

    Returns
    -------
    shown : Light or None
        What replaces the scene's distant emitters; None where they stay.
    chosen : Light
        What the asset is lit by.
    """
    if is_of_scene(light):
        chosen = as_light(
            [scene_light(scene) if is_of_scene(part) else part for part in _listed(light)]
        )
    else:
        chosen = as_light(light)
    if rotate is not None:
        chosen = chosen.rotated(*rotate)
    return (None if light is None and rotate is None else chosen), chosen


def chosen_local_light(scene, light=None):
    """The local light to show a scene in.

    Parameters
    ----------
    scene : Scene or None
        Whose own local light is taken where `light` is None, or in the place of 'scene' in a list;
        not needed otherwise.
    light : what `as_light` accepts, or a list of such and 'scene', optional

    Returns
    -------
    shown : Light
        What is shown beside the scene's own emitters; with the next, what `lit_scene` takes.
    keep_local : bool
        Whether the scene's own emitters shine.
    chosen : Light
        What the asset is lit by: the sum of both.
    """
    keep_local = is_of_scene(light)
    others = [part for part in _listed(light) if not is_of_scene(part)]
    shown = as_light(others) if others or not keep_local else Light()
    return shown, keep_local, as_light([shown, local_scene_light(scene)]) if keep_local else shown


def is_of_scene(light):
    """Whether a light, as `turned_light` and `chosen_local_light` take it, contains the scene's
    own.
    """
    return any(part is None or (isinstance(part, str) and part == SCENE) for part in _listed(light))


def _listed(light):
    return light if isinstance(light, list | tuple) else [light]


def summed_maps(maps):
    """One map in place of several.

    Maps of one size and rotation are summed pixel by pixel. Others are resampled to a grid three
    times finer than the largest of them and turned like it. The largest is then kept exactly and
    constants are too; of the others, interpolation changes the energy by 1e-5 in smooth maps, 4e-4
    in noise, and up to 2 % in a sun of a single pixel.

    Parameters
    ----------
    maps : sequence of EnvironmentMap or LatticeMap

    Returns
    -------
    EnvironmentMap
    """
    largest = max(maps, key=lambda environment: np.prod(environment.size))
    if all(_is_alike(environment, largest) for environment in maps):
        return (
            maps[0]
            if len(maps) == 1
            else EnvironmentMap(sum(m.pixels for m in maps), largest.rotation)
        )
    height, width = largest.size
    height, width = SUM_REFINEMENT * max(height - 1, 1) + 1, SUM_REFINEMENT * width
    pixels = np.empty((height, width, 3), np.float32)
    step = max(1, BAND // width)
    for first in range(0, height, step):
        rows, columns = np.indices((min(step, height - first), width)).reshape(2, -1)
        # beside a pole: in it, all columns would be one direction
        rows = np.clip(rows + first, 1e-6, height - 1 - 1e-6)
        vectors = _pixel_directions(rows, columns, height, width) @ largest.rotation.T
        pixels[first : first + step] = sum(m.at(vectors) for m in maps).reshape(-1, width, 3)
    return EnvironmentMap(pixels, largest.rotation)


def _is_alike(one, other):
    """Whether two maps have pixels in the same directions."""
    both_pixels = isinstance(one, EnvironmentMap) and isinstance(other, EnvironmentMap)
    return (
        both_pixels
        and one.size == other.size
        and np.allclose(one.rotation, other.rotation, rtol=0, atol=1e-9)
    )


def _emitters(light):
    """Mitsuba emitter dicts of a Light."""
    if light.emissions:
        raise LightError(
            "emission of a scene's own emitters has no emitter of its own: keep those of the scene,"
            " keep_local"
        )
    mi = mitsuba()
    emitters = {}
    if light.maps:
        environment = summed_maps(light.maps)
        to_world = np.eye(4)
        to_world[:3, :3] = environment.rotation
        emitters["environment"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(environment.pixels),
            "to_world": mi.ScalarTransform4f(to_world),
        }
    for i, source in enumerate(light.directionals):
        emitters[f"directional{i}"] = {
            "type": "directional",
            "direction": [float(x) for x in source.direction],
            "irradiance": _spectrum(source.irradiance),
        }
    for i, source in enumerate(light.point_lights):
        emitters[f"point{i}"] = point_emitter(source)
    for i, source in enumerate(light.spot_lights):
        emitters[f"spot{i}"] = _spot_emitter(source)
    for i, source in enumerate(light.area_lights):
        emitters[f"area{i}"] = _area_emitter(source)
    return emitters


def point_emitter(light):
    """Mitsuba emitter dict of a PointLight."""
    return {
        "type": "point",
        "position": [float(x) for x in light.position],
        "intensity": _spectrum(light.intensity),
    }


def _spot_emitter(light):
    mi = mitsuba()
    aside = np.eye(3)[np.argmin(np.abs(light.direction))]
    to_world = mi.ScalarTransform4f().look_at(
        list(light.position), list(light.position + light.direction), list(aside)
    )
    return {
        "type": "spot",
        "to_world": to_world,
        "intensity": _spectrum(light.intensity),
        "cutoff_angle": light.cutoff_degrees,
        "beam_width": light.beam_degrees,
    }


def _area_emitter(light):
    to_world = np.eye(4)
    to_world[:3] = np.stack(
        [light.edge_u / 2, light.edge_v / 2, light.normal, light.centre], axis=-1
    )
    return {
        "type": "rectangle",
        "to_world": mitsuba().ScalarTransform4f(to_world),
        "emitter": {"type": "area", "radiance": _spectrum(light.radiance)},
        "bsdf": {"type": "diffuse", "reflectance": _spectrum([0, 0, 0])},
    }


def _spectrum(rgb):
    return {"type": "rgb", "value": [float(x) for x in rgb]}


def _directional(emitter):
    it = _origin(1)
    sample, irradiance = emitter.sample_direction(it, mitsuba().Point2f(0.5))
    return DirectionalLight(-np.array(sample.d).reshape(-1, 3)[0], _rgb(irradiance)[0])


def _environment_map(emitter):
    mi = mitsuba()
    parameters = mi.traverse(emitter)
    data = np.array(parameters["data"])
    # Mitsuba pads the rows with a column at either end, for wrapping round.
    return EnvironmentMap(
        data[:, 1:-1, :3],
        transform_of(emitter)[:3, :3],
        scale=float(np.array(parameters["scale"]).ravel()[0]),
    )


def _baked(emitter):
    """Any other emitter, averaged over the pixels of a map; pixels that hold a sun are sampled
    densely.

    Samples that Mitsuba itself would take of the emitter tell where a sun is: those brighter than
    the map has them mark pixels to refine, and so does contrast within a pixel.
    """
    height, width = BAKED_HEIGHT, 2 * BAKED_HEIGHT
    every = np.indices((height, width)).reshape(2, -1).T
    pixels, contrast = (
        x.reshape(height, width, -1) for x in _pixel_means(emitter, every, height, SKY_SAMPLES)
    )
    mi = mitsuba()
    side = int(SUN_SEARCH**0.5)
    grid = (np.indices((side, side)).reshape(2, -1) + 0.5) / side
    sample, weight = emitter.sample_direction(_origin(side * side), mi.Point2f(grid))
    direction = np.array(sample.d).T
    row, column = _pixel_of(direction, height)
    brighter = (_rgb(weight) * np.array(sample.pdf)[:, None]).max(axis=1) > 1.5 * pixels[
        row, column
    ].max(axis=1) + 1e-6
    marked = contrast[..., 0] > 1.5
    marked[row[brighter], column[brighter]] = True
    # A neighbour may hold the edge of what was found; around a pole all columns are neighbours.
    marked = scipy.ndimage.maximum_filter(marked, 3, mode=("nearest", "wrap"))
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
        rows = pixels[:, None, 0] + chunk[None, :, 0]
        columns = pixels[:, None, 1] + chunk[None, :, 1]
        directions = _pixel_directions(rows, columns, height, 2 * height)
        radiance = _evaluate(emitter, directions.reshape(-1, 3)).reshape(*rows.shape, 3)
        sine = np.hypot(directions[..., 0], directions[..., 2])
        weight = sine * (1 - np.abs(chunk)).prod(axis=1)
        sums = sums + (radiance * weight[..., None]).sum(axis=1)
        weights = weights + weight.sum(axis=1)[:, None]
        largest = np.maximum(largest, radiance.max(axis=(1, 2)))
    means = sums / np.maximum(weights, 1e-12)
    return means, (largest / np.maximum(means.max(axis=1), 1e-12))[:, None]


def _pixel_directions(rows, columns, height, width):
    """Directions (…, 3) in which a map of a size shows some of its pixels, or places between them,
    in its own frame.
    """
    theta = rows * (np.pi / (height - 1))
    phi = (columns + 0.5) * (2 * np.pi / width)
    sine = np.maximum(np.sin(theta), 0)  # beyond the poles there is nothing
    return np.stack([np.sin(phi) * sine, np.cos(theta), -np.cos(phi) * sine], axis=-1)


def _pixel_of(directions, height):
    x, y, z = directions.T
    row = np.rint(np.arccos(np.clip(y, -1, 1)) * ((height - 1) / np.pi)).astype(np.int64)
    column = np.floor(np.arctan2(x, -z) * (height / np.pi)).astype(np.int64) % (2 * height)
    return row, column


def _evaluate(emitter, directions):
    """Radiance (k, 3) that arrives from directions (k, 3)."""
    import drjit as dr

    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(directions.T.astype(np.float32))
    return np.broadcast_to(_rgb(emitter.eval(si)), directions.shape)


def _origin(count):
    import drjit as dr

    return dr.zeros(mitsuba().Interaction3f, count)


def _rgb(colour):
    return np.array(mitsuba().Color3f(colour)).reshape(3, -1).T.astype(np.float64)
