"""Light paths are Catmull-Rom splines at equal steps of arc length; frames come back from the files
that hold them.
"""

from itertools import islice

import av
import numpy as np
import pytest
from PIL import Image

from mi_prt.errors import SettingsError
from mi_prt.output.film import LightPath, check_frames_output, light_path, write_frames

HEIGHT, WIDTH = 47, 65  # odd, which H.264 is not


def frames(count):
    """Smooth images of which each is another, all in one array: what keeps frames instead of
    writing them holds only the last.
    """
    y, x = np.indices((HEIGHT, WIDTH))
    image = np.empty((HEIGHT, WIDTH, 3), np.float32)
    for i in range(count):
        image[:] = np.stack([x / WIDTH, y / HEIGHT, np.full(x.shape, i / count)], axis=-1)
        yield image


def stored(count):
    return [np.rint(image * 255).astype(int) for image in frames(count)]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# --- paths ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["0,1,0 1,1,0 1,2,5", "0,1,0;1,1,0;1,2,5", " 0,1,0 ;  1,1,0\n1e0,+2,5.0 "]
)
def test_text_of_a_path(text):
    np.testing.assert_array_equal(light_path(text).keys, [[0, 1, 0], [1, 1, 0], [1, 2, 5]])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1,2,3",
        "1,2 3,4",
        "0,0,0 a,b,c",
        "0,0,0 1,nan,0",
        "0,0,0 1,1,inf",
        "0,0,0 1,1,1 1,1,1",
        "0, 0, 0 1, 1, 1",
        "0,0,0;1,1,1;",
    ],
)
def test_bad_paths_are_refused(text):
    with pytest.raises(SettingsError):
        light_path(text)


@pytest.mark.parametrize("count", [0, -1, 2.0, True, "3"])
def test_bad_numbers_of_frames_are_refused(count):
    with pytest.raises(SettingsError, match="frames"):
        light_path("0,0,0 1,0,0").positions(count)


def test_two_keys_make_a_straight_line():
    np.testing.assert_allclose(
        light_path("1,0,0 3,4,0").positions(5), np.linspace([1, 0, 0], [3, 4, 0], 5), atol=1e-12
    )
    np.testing.assert_array_equal(light_path("1,0,0 3,4,0").positions(1), [[1, 0, 0]])


def test_there_and_back():
    """A closed path of two different keys is the line between them, twice; six steps of a third of
    its length.
    """
    expected = np.array([0, 1, 2, 3, 2, 1])[:, None] / 3 * [0, 0, 6.0]
    np.testing.assert_allclose(light_path("0,0,0 0,0,6 0,0,0").positions(6), expected, atol=1e-9)


def barry_goldman(keys, parameter):
    """The centripetal Catmull-Rom curve between the middle two of four keys, by Barry and Goldman's
    pyramid; parameter 0…1.
    """
    t = np.concatenate([[0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(keys, axis=0), axis=1)))])
    x = (t[1] + (t[2] - t[1]) * parameter)[:, None]

    def mix(a, b, first, last):
        return (t[last] - x) / (t[last] - t[first]) * a + (x - t[first]) / (t[last] - t[first]) * b

    a = [mix(keys[i], keys[i + 1], i, i + 1) for i in range(3)]
    b = [mix(a[0], a[1], 0, 2), mix(a[1], a[2], 1, 3)]
    return mix(b[0], b[1], 1, 2)


@pytest.mark.parametrize("closed", [False, True])
def test_the_curve_is_catmull_roms(closed):
    """Positions lie on the curve of another algorithm, at equal steps of its length, and that goes
    through all keys.

    Rationale: an open path's first and last piece see the neighbouring key mirrored at the end; a
    closed one goes round. The reference is a fine polygon, 4000 edges a piece, so that distances to
    it are below 1e-6 of the path's length.
    """
    keys = np.random.default_rng(3).uniform(-2, 2, (6, 3))
    if closed:
        keys[-1] = keys[0]
        around = np.vstack([keys[-2], keys, keys[1]])
    else:
        around = np.vstack([2 * keys[0] - keys[1], keys, 2 * keys[-1] - keys[-2]])
    s = np.linspace(0, 1, 4001)
    curve = np.concatenate(
        [barry_goldman(around[i : i + 4], s)[:-1] for i in range(5)] + [keys[-1:]]
    )
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    count = 101
    wanted = np.linspace(0, length[-1], count, endpoint=not closed)
    expected = np.stack([np.interp(wanted, length, c) for c in curve.T], axis=1)
    np.testing.assert_allclose(LightPath(keys).positions(count), expected, atol=1e-5 * length[-1])
    assert LightPath(keys).closed == closed


def test_a_closed_path_has_no_corner():
    """Around a square: each step is as long as the others, and none turns by more than the eighth
    of a turn that 100 allow.
    """
    positions = light_path("0,0,0 1,0,0 1,1,0 0,1,0 0,0,0").positions(100)
    steps = np.diff(np.vstack([positions, positions[:2]]), axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert np.ptp(lengths) < 0.01 * lengths.mean()  # chords of a curve
    turns = np.einsum("ij,ij->i", steps[1:], steps[:-1]) / (lengths[1:] * lengths[:-1])
    assert turns.min() > np.cos(np.pi / 8)


# --- files ----------------------------------------------------------------------------------------


def test_gif(tmp_path):
    """40 frames of 20 ms, in a loop, in their order. A palette of 256 colours for 3055 of a smooth
    image, dithered, is within some levels of 255 on the mean; the colour that says which frame it
    is, constant over a frame, within 3.
    """
    assert write_frames(tmp_path / "a.gif", frames(40), fps=50) == 40
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"], image.info["loop"]) == (
            40,
            (WIDTH, HEIGHT),
            20,
            0,
        )
        for i, expected in enumerate(stored(40)):
            image.seek(i)
            shown = np.array(image.convert("RGB")).astype(int)
            assert np.abs(shown - expected).mean() < 8
            assert abs(shown[..., 2].mean() - expected[..., 2].mean()) < 3
    assert names(tmp_path) == ["a.gif"]


@pytest.mark.parametrize("fps", [25, 24000 / 1001])
def test_mp4(tmp_path, fps):
    """Frames come back in their order within what 8-bit BT.709 with video range and subsampled
    colour can hold; the size is even.
    """
    assert write_frames(tmp_path / "a.mp4", frames(40), fps) == 40
    with av.open(tmp_path / "a.mp4") as file:
        stream = file.streams.video[0]
        assert float(stream.average_rate) == pytest.approx(fps, rel=1e-5)
        shown = [f.to_ndarray(format="rgb24", src_colorspace="ITU709") for f in file.decode(stream)]
    assert len(shown) == 40 and shown[0].shape == (HEIGHT + 1, WIDTH + 1, 3)
    for image, expected in zip(shown, stored(40)):
        difference = image[:HEIGHT, :WIDTH].astype(int) - expected
        assert np.abs(difference).mean() < 4
        assert np.abs(difference.mean(axis=(0, 1))).max() < 4
    assert names(tmp_path) == ["a.mp4"]


def test_numbered_images(tmp_path):
    """Lossless, from 0 on; a folder's name may hold a percent sign."""
    folder = tmp_path / "100%d"
    folder.mkdir()
    assert write_frames(folder / "a-%03d.png", frames(3)) == 3
    assert names(folder) == ["a-000.png", "a-001.png", "a-002.png"]
    for name, expected in zip(names(folder), stored(3)):
        np.testing.assert_array_equal(np.array(Image.open(folder / name)), expected)


@pytest.mark.parametrize(
    "name, left",
    [("a.mp4", ["a.mp4"]), ("a.gif", ["a.gif"]), ("a%d.png", ["a0.png", "a1.png", "a2.png"])],
)
def test_an_interruption_leaves_nothing_half(tmp_path, name, left):
    """Ctrl-C in the fourth frame: a video that was there stays as it was, and of images there are
    three whole ones.
    """

    def interrupted():
        yield from islice(frames(10), 3)
        raise KeyboardInterrupt

    if "%" not in name:
        (tmp_path / name).write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write_frames(tmp_path / name, interrupted())
    assert names(tmp_path) == left
    for path in tmp_path.glob("*.png"):
        Image.open(path).load()
    assert "%" in name or (tmp_path / name).read_text() == "old"


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a%02d.png"])
def test_no_frames_and_frames_of_other_sizes_are_refused(tmp_path, name):
    with pytest.raises(SettingsError, match="no frame"):
        write_frames(tmp_path / name, iter([]))
    with pytest.raises(SettingsError, match="one shape"):
        write_frames(tmp_path / name, [np.zeros((4, 4))])
    assert names(tmp_path) == []
    with pytest.raises(SettingsError, match="one shape"):
        write_frames(tmp_path / name, [np.zeros((4, 4, 3)), np.zeros((4, 6, 3))])
    assert write_frames(tmp_path / name, [np.ones((1, 1, 3))]) == 1


@pytest.mark.parametrize(
    "name, fps, match",
    [
        ("a.avi", 25, "must end in"),
        ("a", 25, "must end in"),
        ("a.png", 25, "number"),
        ("a%s.png", 25, "number"),
        ("a%d%d.png", 25, "number"),
        ("a%%d.png", 25, "number"),
        ("nowhere/a.mp4", 25, "does not exist"),
        ("nowhere/%d.png", 25, "does not exist"),
        ("a.mp4", 0, "fps"),
        ("a.mp4", -1, "fps"),
        ("a.mp4", float("nan"), "fps"),
        ("a.mp4", 1e9, "fps"),
        ("a.gif", 51, "fps"),
    ],
)
def test_bad_outputs_are_refused_before_a_frame_is_made(tmp_path, name, fps, match):
    def never():
        raise AssertionError("a frame was asked for")
        yield

    with pytest.raises(SettingsError, match=match):
        write_frames(tmp_path / name, never(), fps)
    with pytest.raises(SettingsError, match=match):
        check_frames_output(tmp_path / name, fps)
    assert names(tmp_path) == []
