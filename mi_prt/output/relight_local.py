"""From an asset of local lights to a file: image, points, or frames of a light that moves."""

import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..asset.meshless_asset import COMPONENTS
from ..asset.provenance import open_scene_of
from ..errors import LightError, SettingsError
from ..evaluate.local_lights import local_and_given
from ..lighting.emission import emission_of
from ..lighting.light import Light, as_light
from ..lighting.to_mitsuba import lit_scene
from ..render.display import display, exposure
from ..render.image import pick_sensor, render_image, resized
from ..render.integrator import DIRECT
from ..scene.scene import Scene
from ..system.files import check_writable
from .export import write_image, write_npz, write_ply
from .film import check_frames_output, write_frames

IMAGES = (".exr", ".png")
MESHES = (".ply", ".npz")
SPLAT_RADII = 3.0  # radii of samples that a splat reaches; a dozen of them overlap
FRAME_SAMPLES = 1  # of a frame's pixel, along each side, of splats


def relight_local(
    asset,
    output,
    light=None,
    scene=None,
    sensor=0,
    size=None,
    renderer="mitsuba",
    spp=64,
    component="total",
    direct="points",
):
    """Relight an asset of local lights and write the result; parameters as of `relight_to_file`."""
    output = Path(output)
    suffix = output.suffix.lower()
    if suffix not in IMAGES + MESHES:
        raise SettingsError(f"output '{output}' must end in {', '.join(IMAGES + MESHES)}")
    check_writable(output)
    _check(component, direct, renderer)
    started = time.perf_counter()
    if suffix in MESHES:
        if light is not None and as_light(light).of_scene:
            light = _named(asset, light)
        irradiance = asset.irradiance(light, component)
        relit = time.perf_counter()
        radiance = asset.outgoing_radiance(irradiance)
        (
            write_ply(output, asset, radiance)
            if suffix == ".ply"
            else write_npz(output, asset, radiance, irradiance)
        )
    else:
        shown = LocalPicture(asset, open_scene_of(asset, scene), light, component, direct)
        started = time.perf_counter()
        irradiance = shown.irradiance()
        relit = time.perf_counter()
        with shown.drawn(sensor, size, renderer, spp) as image:
            picture = image(irradiance)
        write_image(output, picture, exposure(asset.outgoing_radiance(shown.at_points())))
    seconds = {
        "relight": round(relit - started, 5),
        "render": round(time.perf_counter() - relit, 5),
    }
    return {"points": len(asset.points), "seconds": seconds}


def animate_local(
    asset,
    output,
    path,
    frames=48,
    fps=25,
    light=None,
    scene=None,
    sensor=0,
    size=None,
    renderer="raster",
    spp=16,
    component="total",
    direct="points",
    progress=lambda stage, done, total, detail="": None,
):
    """Move the first light along a path, and write a frame for each place of it.

    Parameters
    ----------
    asset : MeshlessAsset
    output : path
        .mp4 or .gif, or .png with the number of the frame in its name, such as frame-%03d.png.
    path : LightPath
    frames, fps : int
    light : what `as_light` accepts, or a list of such
        Whose first light moves; the others stay.
    scene, sensor, size, renderer, spp, component, direct :
        As of `relight_to_file`.
    progress : callable(stage, done, total, detail)

    Returns
    -------
    dict
        points, frames, seconds{relight, render} of all frames.
    """
    _check(component, direct, renderer)
    check_frames_output(output, fps)
    moving = _moving(light)
    opened = open_scene_of(asset, scene)
    places = path.positions(frames)
    seconds = {"relight": 0.0, "render": 0.0}
    shown = LocalPicture(asset, opened, moving(places[0]), component, direct)
    # An area light is a shape, so that the scene that is seen changes with its place.
    runs = [[place] for place in places] if _moves_a_shape(light) else [places]

    def pictures():
        done, factor = 0, None
        for run in runs:
            shown.move(moving(run[0]))
            with shown.drawn(sensor, size, renderer, spp, FRAME_SAMPLES) as image:
                for place in run:
                    started = time.perf_counter()
                    shown.move(moving(place))
                    irradiance = shown.irradiance()
                    relit = time.perf_counter()
                    picture = image(irradiance)
                    seconds["relight"] += relit - started
                    seconds["render"] += time.perf_counter() - relit
                    if factor is None:  # that of the first frame for all
                        factor = exposure(asset.outgoing_radiance(shown.at_points()))
                    done += 1
                    progress("frames", done, frames, "")
                    yield display(picture, factor)

    write_frames(output, pictures(), fps)
    return {
        "points": len(asset.points),
        "frames": frames,
        "seconds": {k: round(v, 5) for k, v in seconds.items()},
    }


class LocalPicture:
    """A scene lit by an asset of local lights, ready to be drawn.

    Parameters
    ----------
    asset : MeshlessAsset
    opened : Scene
        The asset's.
    light : what `resolve` takes
    component, direct : str
    """

    def __init__(self, asset, opened, light, component="total", direct="points"):
        self._asset, self._opened, self._component = asset, opened, component
        self._at_pixels = direct == "pixels" and component != "indirect"
        self.move(light)

    def move(self, light):
        """Take another light."""
        self._chosen = local_and_given(self._opened, light)

    def at_points(self):
        """Irradiance (n, 3) of the component at the points."""
        return self._asset.irradiance(self._chosen, self._component)

    def irradiance(self):
        """Irradiance (n, 3) that is interpolated between the points."""
        if not self._at_pixels:
            return self.at_points()
        if self._component == "direct":
            return np.zeros_like(self._asset.points.positions)
        return self._asset.irradiance(self._chosen, "indirect")

    def lit(self):
        """The Scene as it is seen: under its lights, without distant ones."""
        return Scene(lit_scene(self._opened, self._chosen), self._opened.source)

    @contextmanager
    def drawn(self, sensor, size, renderer, spp, samples=2):
        """A context in which a function takes irradiance (n, 3) to an image (h, w, 3)."""
        lit = self.lit()
        with resized(pick_sensor(lit.mi_scene, sensor), size) as camera:
            if renderer == "mitsuba":
                yield lambda irradiance: self._image(lit, camera, spp, irradiance)
            else:
                with self._splats(lit, camera, samples) as splats:
                    yield splats.radiance

    def _image(self, lit, camera, spp, irradiance):
        """Image (h, w, 3) by the integrator."""
        places = emission_of(self._chosen) if self._at_pixels else None
        return render_image(
            self._asset, lit.mi_scene, camera, spp, irradiance=irradiance, pixel_light=places
        )

    def _splats(self, lit, camera, samples):
        """SplatScene of the samples."""
        if self._at_pixels:
            raise SettingsError(
                "direct light at pixels needs the renderer mitsuba, splats show that of the points"
            )
        from ..render.splats import SplatScene  # opens OpenGL: only where it is asked for

        samples_of = self._asset.samples
        radii = np.full(len(samples_of), SPLAT_RADII * samples_of.radius, np.float32)
        return SplatScene(
            self._asset.points.positions, self._asset.points.normals, radii, lit, camera, samples
        )


def _check(component, direct, renderer):
    for name, value, known in (
        ("component", component, COMPONENTS),
        ("direct", direct, DIRECT),
        ("renderer", renderer, ("mitsuba", "raster")),
    ):
        if value not in known:
            raise SettingsError(f"{name} '{value}' is not known: use {' or '.join(known)}")


def _named(asset, light):
    """A light in which 'scene' is the emission that the asset holds."""
    return Light(asset.emission() if part.of_scene else part for part in as_light(light).parts)


def _moving(light):
    """A function from a place to a light whose first one is there."""
    parts = as_light(light).parts if light is not None else ()
    number = next((i for i, part in enumerate(parts) if part.is_movable), None)
    if number is None:
        raise LightError(
            "a light path moves the first point, spot or area light that is given: pass one"
            " (--light point:0,0,0:r,g,b)"
        )
    before, first, after = parts[:number], parts[number], parts[number + 1 :]
    return lambda place: Light((*before, first.moved(place), *after))


def _moves_a_shape(light):
    return next(part for part in as_light(light).parts if part.is_movable).is_shape
