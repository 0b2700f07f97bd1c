"""Films of a light that moves through a scene, or of distant light that turns."""

import time
from dataclasses import dataclass, field
from typing import Any

from ..asset.provenance import open_scene_of
from ..errors import LightError, SettingsError
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
    path=None,
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
    turn=None,
):
    """Move the first local light along a path, turn the distant light, or both, and write a film.

    Parameters
    ----------
    asset : Asset
    output : path
        .mp4 or .gif, or .png with the number of the frame in its name, such as frame-%03d.png.
    path : LightPath, (k, 3), or text, optional
        Positions that the light goes through, such as '0,1,0 1,1,0 1,1,1'.
    frames, fps : int
    light : what `as_light` accepts, or a list of such
        Whose first point, spot or area light moves along the path, and whose distant light turns;
        all else stays.
    scene, sensor, size, renderer, spp, component, direct, rotate, exposure, force :
        As of `relight_to_file`.
    progress : callable(stage, done, total, detail)
    turn : (axis, degrees), optional
        By how much distant light turns in the whole film, in equal steps, so that a film of 360
        degrees can be played in a loop.

    Returns
    -------
    dict
        points, frames, exposure{ev, factor}, seconds{relight, render} of all frames.

    Raises
    ------
    SettingsError, SceneError, LightError
        Also if there is neither path nor turn, or no light that they move.
    """
    if path is None and turn is None:
        raise SettingsError("a film needs a light path (--light-path) or a turn (--turn y:360)")
    RENDERERS[renderer]
    check_picture(size, sensor, spp)
    check_direct(direct)
    Question(Light(()), component)  # which checks it
    places = None if path is None else as_path(path).positions(frames)
    check_frames_output(output, fps, frames, force)
    opened = open_scene_of(asset, scene)
    moving = _Moving(asset, asset.resolved(light, rotate, opened), places, turn, frames)
    film = _Film(
        Picture(asset, opened, moving.at(0), component, direct, exposure=exposure),
        moving,
        progress,
        frames,
    )
    numbers = range(frames)
    runs = [[number] for number in numbers] if moving.is_seen else [numbers]

    def pictures():
        for run in runs:
            film.picture.move(moving.at(run[0]))
            with film.picture.drawn(sensor, size, renderer, spp, FRAME_SAMPLES) as draw:
                for number in run:
                    yield film.frame(number, draw)

    write_frames(output, pictures(), fps)
    seconds = {name: round(value, 5) for name, value in film.seconds.items()}
    return {
        "points": len(asset.points),
        "frames": frames,
        "exposure": exposure_report(film.factor),
        "seconds": seconds,
    }


class _Moving:
    """Light in each frame: its first local part at a place of a path, its distant light turned."""

    def __init__(self, asset, light, places, turn, frames):
        self._places, self._turn, self._frames = places, turn, frames
        moved = [i for i, part in enumerate(light.parts) if part.is_movable]
        if places is not None and not moved:
            raise LightError(
                "a light path moves the first point, spot or area light that is given: pass one"
                " (--light point:0,0,0:r,g,b)"
            )
        if turn is not None and light.distant.is_empty:
            raise LightError(
                "a turn is of distant light, and there is none: pass one (--envmap sky.exr)"
            )
        self._parts = list(light.parts)
        self._index = moved[0] if places is not None else None
        # what turns is prepared for it once
        self._distant = light.distant if turn is None else asset.prepare_light(light.distant)

    @property
    def is_seen(self):
        """Whether what is drawn changes from frame to frame: a lamp that is a shape, a sky."""
        moves = self._index is not None and self._parts[self._index].is_shape
        return moves or self._turn is not None

    def at(self, number):
        """The Light of a frame."""
        distant = self._distant
        if self._turn is not None:
            axis, degrees = self._turn
            distant = distant.rotated(axis, degrees * number / self._frames)
        local = [
            part.moved(self._places[number]) if i == self._index else part
            for i, part in enumerate(self._parts)
            if not part.is_distant
        ]
        return Light((*distant.parts, *local))


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

    def frame(self, number, draw):
        """The displayed image (h, w, 3) of a frame."""
        started = time.perf_counter()
        self.picture.move(self.moving.at(number))
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
