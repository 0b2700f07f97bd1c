"""A scene's own local emitters as this program's light."""

import numpy as np
from scipy.spatial import cKDTree

from ..errors import LightError, SettingsError
from ..scene.traversal import children, transform_of
from ..system.runtime import mitsuba
from .emission import flat_emission
from .light import as_light
from .point import PointLight
from .spot import SpotLight

EMITTER_SAMPLES = 64  # places that stand for one area emitter
SAMPLES_PER_PLACE = 64  # of radiance, in the part of an emitter that a place stands for
GOLDEN_RATIO = (5**0.5 - 1) / 2


def local_scene_light(scene, samples=EMITTER_SAMPLES):
    """All local light of a scene: `point`, `spot`, and `area` on any shape whose surface Mitsuba
    can sample.

    An area emitter becomes an Emission of places spread evenly over its surface. Each stands for
    the part of the surface that is nearest to it, and has the power of that part: the power of the
    whole is right, of textured emitters too. What is nearer to the emitter than its places are to
    each other tells them apart.

    Parameters
    ----------
    scene : Scene
    samples : int
        Places for each area emitter.

    Returns
    -------
    Light

    Raises
    ------
    LightError
        If the scene has no local emitter, or one that this light cannot stand for (it is named): a
        `projector` or `directionalarea`, a textured spot or one of more than 90 degrees, emission
        by mesh attributes, a shape that cannot be sampled, or radiance that is not finite or
        negative.
    SettingsError
        If `samples` is not an integer ≥ 1.
    """
    _check(samples)
    if not scene.local_emitters:
        raise LightError("the scene has no local light (point, spot, area): pass a light, --light")
    return as_light([local_part(emitter, samples) for emitter in scene.local_emitters])


def local_part(emitter, samples=EMITTER_SAMPLES):
    """One local emitter of Mitsuba as a part of light; see `local_scene_light`."""
    _check(samples)
    kind = emitter.class_name()
    shape = emitter.get_shape()
    name = (
        f"the scene's emitter '{emitter.id()}' ({kind})"
        if shape is None
        else f"the {kind} of shape '{shape.id()}'"
    )
    try:
        if kind == "PointLight":
            return PointLight(*_as_seen_from(emitter, [1, 0, 0]))
        if kind == "SpotLight":
            return _spot(emitter)
        if kind == "AreaLight":
            return _area(emitter, shape, samples)
        raise LightError("its kind is not supported, only point, spot and area are")
    except (LightError, RuntimeError) as error:  # Mitsuba's own say what a shape cannot do
        raise LightError(
            f"{name} cannot be taken as light: {' '.join(str(error).split())}; pass a light instead"
        ) from None


def _check(samples):
    if isinstance(samples, bool) or not isinstance(samples, int | np.integer) or samples < 1:
        raise SettingsError(f"samples of an emitter must be an integer ≥ 1, got {samples!r}")


def _as_seen_from(emitter, direction):
    """Position of an emitter that stands in one place, and its intensity in a direction."""
    import drjit as dr

    mi = mitsuba()
    it = dr.zeros(mi.Interaction3f)
    place = emitter.sample_direction(it, mi.Point2f(0.5))[0].p
    # no less: far from the origin float32 would lose it
    it.p = place + mi.Vector3f(direction) * dr.maximum(dr.norm(place), 1)
    sample, weight = emitter.sample_direction(it, mi.Point2f(0.5))
    return (
        np.array(place, dtype=np.float64).ravel(),
        (_rgb(weight, 1) * float(np.array(sample.dist).ravel()[0]) ** 2)[0],
    )


def _spot(emitter):
    if any(
        name == "texture" and texture.is_spatially_varying() for name, texture in children(emitter)
    ):
        raise LightError("it has a texture")
    parameters = mitsuba().traverse(emitter)
    axis = transform_of(emitter)[:3, 2]
    position, intensity = _as_seen_from(emitter, axis / np.linalg.norm(axis))
    cutoff, beam = (
        float(np.array(parameters[name]).ravel()[0]) for name in ("cutoff_angle", "beam_width")
    )
    return SpotLight(position, axis, intensity, cutoff, beam)


def _area(emitter, shape, samples):
    if any(texture.class_name() == "MeshAttribute" for _, texture in children(emitter)):
        raise LightError(
            "its radiance is an attribute of the mesh, which Mitsuba does not sample either"
        )
    positions, normals, _, area = _surface_samples(emitter, shape, samples)
    finer, finer_normals, radiance, _ = _surface_samples(
        emitter, shape, samples * SAMPLES_PER_PLACE
    )
    # Sides that face apart are as far from each other as the emitter is large, however thin it is.
    size = np.sqrt(area)
    _, place = cKDTree(np.c_[positions, size * normals]).query(np.c_[finer, size * finer_normals])
    sums = np.stack(
        [np.bincount(place, radiance[:, channel], samples) for channel in range(3)], axis=-1
    )
    return flat_emission(positions, normals, sums * (area / len(finer)))


def _surface_samples(emitter, shape, count):
    """Positions, normals and radiance (count, 3) at places spread evenly over an area emitter, and
    its area.

    The lattice of the golden ratio has places of their own along either axis: meshes pick a face by
    one of them alone.
    """
    import drjit as dr

    mi = mitsuba()
    number = np.arange(count) + 0.5
    sample = shape.sample_position(0.0, mi.Point2f(number * GOLDEN_RATIO % 1, number / count))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n, si.uv = sample.p, sample.n, sample.uv
    si.wi = mi.Vector3f(0, 0, 1)
    density = float(np.array(sample.pdf).ravel()[0])
    if not (np.isfinite(density) and density > 0):
        raise LightError(f"its surface cannot be sampled, got a density of {density:g} per m²")
    return _rgb(sample.p, count), _rgb(sample.n, count), _rgb(emitter.eval(si), count), 1 / density


def _rgb(value, count):
    """Three channels, or coordinates, as (count, 3) float64."""
    return np.broadcast_to(
        np.array(mitsuba().Color3f(value), dtype=np.float64).reshape(3, -1).T, (count, 3)
    )
