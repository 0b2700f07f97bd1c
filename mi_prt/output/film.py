"""Light that moves along a path, and frames as a video file or numbered images."""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np

from ..errors import SettingsError
from ..render.image_file import to_8bit, write_displayed
from ..system.files import MARK, check_own, check_writable, is_marked, replacing
from ..system.whole import check_whole

VIDEOS = (".mp4", ".gif")
FRAMES, FPS = 48, 25  # of a film, by default
MAX_FRAMES = 100_000  # more than an hour
MAX_FPS = {".mp4": 240, ".gif": 50}  # viewers slow down a GIF of more
PATH_FORM = "write it as 'x,y,z x,y,z …', two or more positions separated by spaces or semicolons"
_STEPS = 1024  # of the polygon that measures and stands for each piece of a path
_NUMBER = re.compile(r"%0?(\d*)d")


@dataclass(frozen=True, eq=False)
class LightPath:
    """A smooth path through key positions: the centripetal Catmull-Rom spline, which makes no loops
    of its own between them.

    Parameters
    ----------
    keys : (k, 3)
        Metres. The path is closed, without a corner there, if the last is the first.

    Raises
    ------
    SettingsError
        If there are fewer than two, two in a row are the same, or one is not finite.
    """

    keys: np.ndarray

    def __post_init__(self):
        keys = np.asarray(self.keys, np.float64)
        if keys.ndim != 2 or keys.shape[1] != 3 or len(keys) < 2 or not np.isfinite(keys).all():
            raise SettingsError(
                f"a light path must be 2 or more finite positions, (k, 3), got {keys.shape}:"
                f" {PATH_FORM}"
            )
        still = np.flatnonzero((np.diff(keys, axis=0) == 0).all(axis=1))
        if len(still):
            raise SettingsError(
                f"positions {still[0] + 1} and {still[0] + 2} of the light path are the same: leave"
                " one out"
            )
        object.__setattr__(self, "keys", keys)

    @property
    def closed(self):
        """Whether the path ends where it begins."""
        return bool((self.keys[0] == self.keys[-1]).all())

    def positions(self, frames):
        """Positions (frames, 3) float64 at equal steps of arc length.

        They go from the first key to the last; on a closed path they stop one step before it, so
        that a film of them can be played in a loop.

        Raises
        ------
        SettingsError
            If `frames` is not an integer from 1 to `MAX_FRAMES`.
        """
        check_whole("frames", frames, 1, MAX_FRAMES, "write longer films in parts")
        polygon = self._polygon()
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(polygon, axis=0), axis=1))])
        wanted = np.linspace(0, length[-1], frames, endpoint=not self.closed)
        return np.stack([np.interp(wanted, length, coordinate) for coordinate in polygon.T], axis=1)

    def _polygon(self):
        """Points along the spline, `_STEPS` for each piece."""
        from scipy.interpolate import CubicHermiteSpline

        chords = np.diff(self.keys, axis=0)
        # of the parameter: the root makes it centripetal
        steps = np.sqrt(np.linalg.norm(chords, axis=1))
        speeds, widths = chords / steps[:, None], steps[:, None]
        # which piece comes before the first key, and after the last
        before, after = (-1, 0) if self.closed else (0, -1)
        speeds = np.vstack([speeds[before], speeds, speeds[after]])
        widths = np.vstack([widths[before], widths, widths[after]])
        tangents = (speeds[:-1] * widths[1:] + speeds[1:] * widths[:-1]) / (
            widths[:-1] + widths[1:]
        )
        knots = np.concatenate([[0], np.cumsum(steps)])
        places = np.interp(
            np.arange(_STEPS * len(steps) + 1) / _STEPS, np.arange(len(knots)), knots
        )
        return CubicHermiteSpline(knots, self.keys, tangents)(places)


def as_path(path):
    """A LightPath from one, from its text, or from positions (k, 3)."""
    if isinstance(path, LightPath):
        return path
    return light_path(path) if isinstance(path, str) else LightPath(np.asarray(path))


def light_path(text):
    """The path of a moving light from its key positions as text, for example '0,1,0 1,1,0 1,1,1'.

    Raises
    ------
    SettingsError
        If the text is of another form; else as `LightPath`.
    """
    keys = [key.split(",") for key in re.split(r"[\s;]+", text.strip())]
    try:
        positions = [[float(number) for number in key] for key in keys]
    except ValueError:
        raise SettingsError(f"light path '{text}' is not understood: {PATH_FORM}") from None
    if any(len(key) != 3 for key in keys):
        raise SettingsError(
            f"light path '{text}' has a position that is not of three numbers: {PATH_FORM}"
        )
    return LightPath(np.array(positions))


def check_frames_output(output, fps=25, frames=1, force=False):
    """Raise SettingsError unless `write_frames` can write so many frames there; and, without
    `force`, if that would replace files of others.
    """
    output = Path(output)
    suffix = output.suffix.lower()
    if suffix in VIDEOS:
        if not 0 < fps <= MAX_FPS[suffix]:
            raise SettingsError(
                f"fps of {suffix} must be above 0 and at most {MAX_FPS[suffix]}, got {fps}"
            )
        check_writable(output)
        check_own(output, is_marked, force)
    elif suffix == ".png":
        if output.name.count("%") != 1 or not _NUMBER.search(output.name):
            raise SettingsError(
                f"output '{output}' needs a place for each frame's number: name it like"
                " 'frame-%03d.png'"
            )
        check_writable(_numbered(output, 0))
        for number in range(frames):
            check_own(_numbered(output, number), is_marked, force)
    else:
        raise SettingsError(
            f"output '{output}' must end in {', '.join(VIDEOS)}, or be numbered like"
            " 'frame-%03d.png'"
        )


def write_frames(output, frames: Iterable, fps=25):
    """Write an animation. Frames are taken one at a time: memory does not grow with their number.

    Parameters
    ----------
    output : path
        .mp4 (H.264) or .gif (256 colours for each frame, dithered, played in a loop): written all
        or nothing. Or .png with a number, like 'frame-%03d.png': one file for each frame from 0 on,
        each written all or nothing.
    frames : iterable of (h, w, 3)
        Displayed values 0…1, all of one size.
    fps : number
        Frames a second.

    Returns
    -------
    int
        Frames written.

    Raises
    ------
    SettingsError
        If the name is of another kind or cannot be written, if there is no frame, one is of another
        size, or `fps` is out of range.

    Notes
    ----- H.264 needs an even width and height: the last row or column is repeated. A quarter of the
    resolution carries colour.
    """
    check_frames_output(output, fps, force=True)
    output, images = Path(output), _images(frames)
    if output.suffix.lower() == ".png":
        count = 0
        for count, image in enumerate(images, 1):
            write_displayed(_numbered(output, count - 1), image)
        return count
    write = _write_mp4 if output.suffix.lower() == ".mp4" else _write_gif
    with replacing(output) as temporary:
        return write(temporary, images, Fraction(fps).limit_denominator(1001))


def _images(frames):
    """The same frames, one at a time; SettingsError for none, or for one of another size than the
    first.
    """
    shape = None
    for image in frames:
        shape = shape or np.shape(image)
        if np.shape(image) != shape or len(shape) != 3 or shape[2] != 3:
            raise SettingsError(
                f"frames must all be of one shape (h, w, 3), got {np.shape(image)} after {shape}"
            )
        yield image
    if shape is None:
        raise SettingsError("there is no frame to write: ask for one or more")


def _numbered(output, number):
    """The name of a frame's file; only the number is filled in, whatever else the path holds."""
    return output.with_name(_NUMBER.sub(lambda field: field[0] % number, output.name))


def _write_mp4(path, images, fps):
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    first = to_8bit(next(images))
    height, width = (side + side % 2 for side in first.shape[:2])
    with av.open(path, "w", format="mp4", options={"movflags": "+faststart"}) as file:
        file.metadata["comment"] = MARK
        stream = file.add_stream("libx264", rate=fps, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        codec = stream.codec_context
        codec.colorspace, codec.color_range = Colorspace.ITU709, ColorRange.MPEG
        codec.color_primaries, codec.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1
        count = 0
        for image in chain([first], map(to_8bit, images)):
            count += 1
            image = np.pad(
                image,
                [(0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)],
                mode="edge",
            )
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame = frame.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return count


def _write_gif(path, images, fps):
    import av
    import av.filter

    first = to_8bit(next(images))
    height, width = first.shape[:2]
    graph = av.filter.Graph()  # a palette for each frame, so that no two frames must be in memory
    source = graph.add_buffer(width=width, height=height, format="rgb24", time_base=1 / fps)  # pyright: ignore[reportArgumentType]
    copies, sink = graph.add("split"), graph.add("buffersink")
    palette, applied = (
        graph.add("palettegen", "stats_mode=single"),
        graph.add("paletteuse", "new=1"),
    )
    source.link_to(copies)
    copies.link_to(palette, 0, 0)
    copies.link_to(applied, 1, 0)
    palette.link_to(applied, 0, 1)
    applied.link_to(sink)
    graph.configure()
    with av.open(path, "w", format="gif") as file:
        stream = file.add_stream("gif", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "pal8"
        count = 0
        for image in chain([first], map(to_8bit, images)):
            count += 1
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = count - 1, 1 / fps
            graph.push(frame)
            file.mux(stream.encode(graph.pull()))  # pyright: ignore[reportArgumentType]
        file.mux(stream.encode())
    _mark_gif(path)
    return count


def _mark_gif(path):
    """Add a comment, before the byte that ends a GIF."""
    with open(path, "r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x21\xfe" + bytes([len(MARK)]) + MARK.encode() + b"\0;")
