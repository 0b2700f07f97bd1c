"""Films of a light that moves through a scene."""

import time
from dataclasses import dataclass, field
from typing import Any

from ..asset.provenance import open_scene_of
from ..errors import LightError
from ..lighting.light import Light
from ..render.display import display, exposure_report
from ..render.integrator import check_direct
from ..render.picture import RENDERERS, Picture
from ..render.rendered import check_picture
from ..transport.transport import Question
from .film import FPS, FRAMES, as_path, check_frames_output, write_frames

FRAME_SAMPLES = 1  # of a frame's pixel, along each side, of splats


def animate(
    asset,
    output,
    path,
    frames=FRAMES,
    fps=FPS,
    light=None,
    scene=None,
    sensor=0,
    size=None,
    renderer="raster",
    spp=16,
    component="total",
    direct="points",
    progress=lambda stage, done, total, detail="": None,
    rotate=None,
    exposure="auto",
    force=False,
):
    """Move the first local light along a path, and write a frame for each place of it.

    Parameters
    ----------
    asset : Asset
    output : path
        .mp4 or .gif, or .png with the number of the frame in its name, such as frame-%03d.png.
    path : LightPath, (k, 3), or text
        Positions that the light goes through, such as '0,1,0 1,1,0 1,1,1'.
    frames, fps : int
    light : what `as_light` accepts, or a list of such
        Whose first point, spot or area light moves; all else stays.
    scene, sensor, size, renderer, spp, component, direct, rotate, exposure, force :
        As of `relight_to_file`.
    progress : callable(stage, done, total, detail)

    Returns
    -------
    dict
        points, frames, seconds{relight, render} of all frames.
    """
    RENDERERS[renderer]
    check_picture(size, sensor, spp)
    check_direct(direct)
    Question(Light(()), component)  # which checks it
    places = as_path(path).positions(frames)
    check_frames_output(output, fps, frames, force)
    opened = open_scene_of(asset, scene)
    moving = _Moving(asset.resolved(light, rotate, opened))
    first = moving.at(places[0])
    film = _Film(
        Picture(asset, opened, first, component, direct, exposure=exposure),
        moving,
        progress,
        frames,
    )
    # A light that is a shape is seen: what is drawn changes with its place.
    runs = [[place] for place in places] if moving.part.is_shape else [places]

    def pictures():
        for run in runs:
            film.picture.move(moving.at(run[0]))
            with film.picture.drawn(sensor, size, renderer, spp, FRAME_SAMPLES) as draw:
                for place in run:
                    yield film.frame(place, draw)

    write_frames(output, pictures(), fps)
    seconds = {name: round(value, 5) for name, value in film.seconds.items()}
    return {
        "points": len(asset.points),
        "frames": frames,
        "exposure": exposure_report(film.factor),
        "seconds": seconds,
    }


class _Moving:
    """Light whose first local part is taken from place to place."""

    def __init__(self, light):
        found = [i for i, part in enumerate(light.parts) if part.is_movable]
        if not found:
            raise LightError(
                "a light path moves the first point, spot or area light that is given: pass one"
                " (--light point:0,0,0:r,g,b)"
            )
        self._parts, self._index = light.parts, found[0]
        self.part = light.parts[found[0]]

    def at(self, place):
        """The Light with the part at a place (3,)."""
        parts = list(self._parts)
        parts[self._index] = self.part.moved(place)
        return Light(tuple(parts))


@dataclass(eq=False)
class _Film:
    """Frames, and the time that they take."""

    picture: Picture
    moving: _Moving
    progress: Any
    frames: int
    done: int = 0
    factor: float | None = None
    seconds: dict = field(default_factory=lambda: {"relight": 0.0, "render": 0.0})

    def frame(self, place, draw):
        """The displayed image (h, w, 3) with the light at a place."""
        started = time.perf_counter()
        self.picture.move(self.moving.at(place))
        irradiance = self.picture.irradiance()
        relit = time.perf_counter()
        image = draw(irradiance)
        self.seconds["relight"] += relit - started
        self.seconds["render"] += time.perf_counter() - relit
        if self.factor is None:  # that of the first frame for all
            self.factor = self.picture.exposure()
        self.done += 1
        self.progress("frames", self.done, self.frames, "")
        return display(image, self.factor)
