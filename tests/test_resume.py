"""Interrupted runs: what was computed is kept, nothing half-written opens, and a continued run
gives the same file.
"""

import fcntl
import json
import os
import shutil
import signal
import sys
import time

import numpy as np
import pytest
from conftest import cube, diffuse, disk, distant, rectangle, scene
from forked import Starter

import mi_prt
import mi_prt.system.runtime
from mi_prt import AssetError, SettingsError
from mi_prt.basis import pca
from mi_prt.precompute import budget as room
from mi_prt.precompute.workspace import RowFile, durable, temporary
from mi_prt.system.memory import resident_bytes
from mi_prt.system.runtime import mitsuba, peak_memory_bytes
from mi_prt.system.runtime import thread_count as mitsuba_threads
from mi_prt.transport.interreflection import MOST_SUMMED_BOUNCES


def carpet(between=0.3):
    """A floor of 40 x 40 cells of 0.1 m, of one colour but for a line through the middle of each
    cell, where no point is.
    """
    pixels = np.full((120, 120, 3), [0.8, 0.5, 0.3], np.float32)
    pixels[:, 1::3] = between
    texture = {
        "type": "bitmap",
        "bitmap": mitsuba().Bitmap(pixels),
        "raw": True,
        "filter_type": "nearest",
    }
    return rectangle(size=2, bsdf={"type": "diffuse", "reflectance": texture})


SCENE = scene(
    floor=carpet(),
    box=cube((0.2, 0.4, 0), 0.4),
    ball=disk((0, -1, 0.1), (0.3, 1.5, 0), 0.6, bsdf=diffuse([0.2, 0.7, 0.4])),
)
SETTINGS = dict(directions="cubemap:16", edge_length=0.1, coefficients=24, bounces=0)
REFLECTING = {
    name: SETTINGS | dict(bounces=2, indirect=name, paths_per_point=32)
    for name in ("solve", "paths")
}
RUNS = {"direct": SETTINGS} | REFLECTING
LANES = 768 * 40  # blocks of 40 points: dozens of them


@pytest.fixture(scope="module", autouse=True)
def iterations():
    """Even of so small a scene the basis is iterated, in passes that are kept."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pca, "NEGLIGIBLE", 0)
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The file of each run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    for name, settings in RUNS.items():
        mi_prt.precompute(SCENE, output=folder / f"{name}.prt", **settings)
    return {name: folder / f"{name}.prt" for name in RUNS}


@pytest.fixture(scope="module")
def undisturbed(files):
    """That of direct light."""
    return files["direct"]


def test_the_runs_are_three(files):
    """Coloured reflections, and another result by each way to them."""
    assets = {name: mi_prt.load(path) for name, path in files.items()}
    found = {name: distant(asset) for name, asset in assets.items()}
    assert {name: (one.report["bounces"], one.channels) for name, one in found.items()} == {
        "direct": (0, 1),
        "solve": (2, 3),
        "paths": (2, 3),
    }
    assert len({path.read_bytes() for path in files.values()}) == 3


def partial(path):
    return path.with_name(path.name + ".partial")


# --- SIGKILL --------------------------------------------------------------------------------------


def run_slowly(path, run):
    """Goes on where a run was left, with moments between the writes, in which a signal may arrive
    as well. In a process of its own.
    """
    pca.NEGLIGIBLE, room.LANES = 0, LANES

    def progress(stage, done, total, detail):
        print(stage, done, total, flush=True)
        time.sleep(0.002)

    mi_prt.precompute(SCENE, output=path, resume=True, progress=progress, **RUNS[run])


@pytest.fixture(scope="module")
def starter():
    with Starter("test_resume") as starter:
        yield starter


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "chain"), [("direct", 0), ("solve", 1), ("solve", 2), ("paths", 3), ("paths", 4)]
)
def test_killed_runs_end_in_the_same_file(files, starter, tmp_path, run, chain):
    """Four SIGKILLs in a row at random moments, 20 in all five cases, the last two of each while
    reflections are computed, if there are any; then the run is left alone.

    While it is unfinished no file of that name opens; every continuation starts at or beyond where
    the last one was.
    """
    undisturbed = files[run]
    rng, path, reached, killed = np.random.default_rng(chain), tmp_path / "asset.prt", {}, 0
    while killed < 4:
        process = starter.start("run_slowly", str(path), run)
        lines = [process.stdout.readline()]
        assert lines[0], process.communicate()[1][-2000:]
        while (
            run != "direct" and killed >= 2 and lines[-1] and not lines[-1].startswith("indirect")
        ):
            lines.append(process.stdout.readline())
        time.sleep(rng.uniform(0, 0.4))
        process.send_signal(signal.SIGKILL)
        output, _ = process.communicate()
        killed += process.returncode == -signal.SIGKILL
        for stage in ("transport", "indirect"):
            done = [
                int(line.split()[1])
                for line in [*lines, *output.splitlines()]
                if line.startswith(stage) and line.count(" ") == 2
            ]
            assert not done or done[0] >= reached.get(stage, 0)
            reached[stage] = max([reached.get(stage, 0), *done])
        # it has to be whole, whether the process was killed after it or came to its end; then anew
        if path.exists():
            assert path.read_bytes() == undisturbed.read_bytes()
            path.unlink()
            reached = reached if (partial(path) / "run.json").exists() else {}
    last = starter.start("run_slowly", str(path), run)
    output, errors = last.communicate(timeout=120)
    assert last.returncode == 0, errors[-2000:]
    assert path.read_bytes() == undisturbed.read_bytes()
    assert os.listdir(tmp_path) == ["asset.prt"]


@pytest.mark.parametrize(
    ("run", "stage"),
    [
        ("direct", "transport"),
        ("direct", "basis"),
        ("direct", "coefficients"),
        ("solve", "coefficients"),
        ("solve", "indirect"),
        ("solve", "reflections"),
        ("paths", "basis"),
        ("paths", "indirect"),
    ],
)
def test_interrupts_keep_what_was_computed(files, tmp_path, monkeypatch, run, stage):
    """Ctrl-C in the middle of each stage: no file, the rows of before are there, and continuing,
    with other blocks, gives the same file.
    """
    path, seen = tmp_path / "asset.prt", []

    def interrupt(at, done, total, detail):
        if at == stage and done > total // 2:
            raise KeyboardInterrupt

    def watch(at, done, total, detail):
        seen.append((at, done))

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(room, "LANES", LANES)
        mi_prt.precompute(SCENE, output=path, progress=interrupt, **RUNS[run])
    assert not path.exists() and partial(path).is_dir()
    mi_prt.precompute(SCENE, output=path, progress=watch, resume=True, **RUNS[run])
    assert seen[0][0] == "transport" and seen[0][1] > 10 * 40
    if stage in ("indirect", "reflections"):
        assert dict(reversed(seen))["indirect"] > 1000  # the first event of the stage
    assert path.read_bytes() == files[run].read_bytes() and not partial(path).exists()


# --- what may not be continued --------------------------------------------------------------------


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A run that was interrupted after all rays were traced."""
    path = tmp_path_factory.mktemp("interrupted") / "asset.prt"

    def interrupt(stage, done, total, detail):
        if stage == "basis":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mi_prt.precompute(SCENE, output=path, progress=interrupt, **SETTINGS)
    return path


@pytest.fixture
def unfinished(interrupted, tmp_path):
    """A copy of it, that a test may change."""
    path = tmp_path / "asset.prt"
    shutil.copytree(partial(interrupted), partial(path))
    return path


OTHER_SCENES = {
    "moved": SCENE | dict(box=cube((0.3, 0.4, 0), 0.4)),
    "repainted": SCENE | dict(floor=rectangle(size=2, bsdf=diffuse(0.7))),
    "repainted between its points": SCENE | dict(floor=carpet(0.4)),
    "without the ball": {key: part for key, part in SCENE.items() if key != "ball"},
}


@pytest.mark.parametrize("other", OTHER_SCENES)
def test_another_scene_is_refused(unfinished, other):
    with pytest.raises(SettingsError, match="scene was") as caught:
        mi_prt.precompute(OTHER_SCENES[other], output=unfinished, resume=True, **SETTINGS)
    assert "\n" not in str(caught.value) and "delete the folder" in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        dict(directions="cubemap:8"),
        dict(coefficients=25),
        dict(seed=1),
        dict(rays_per_direction=2),
        dict(basis="haar"),
        dict(edge_length=0.2),
        dict(coefficients="auto", variance=0.9),
        dict(bounces=1),
        dict(bounces="auto"),
        dict(indirect="paths"),
        dict(paths_per_point=64),
        dict(denoise=False),
    ],
    ids=str,
)
def test_other_settings_are_refused(unfinished, change):
    """Each by its name, with both values; what was computed stays and can still be continued."""
    with pytest.raises(SettingsError) as caught:
        mi_prt.precompute(SCENE, output=unfinished, resume=True, **SETTINGS | change)
    for key, value in change.items():
        assert f"{key} was {SETTINGS.get(key, '')}" in str(caught.value) and f"now {value}" in str(
            caught.value
        )
    assert (partial(unfinished) / "visibility.rows").stat().st_size > 0


def test_another_version_is_refused(unfinished):
    recorded = json.loads((partial(unfinished) / "run.json").read_text())
    recorded["versions"]["mitsuba"] = "1.0"
    (partial(unfinished) / "run.json").write_text(json.dumps(recorded))
    with pytest.raises(SettingsError, match="versions was"):
        mi_prt.precompute(SCENE, output=unfinished, resume=True, **SETTINGS)


def test_an_unfinished_run_is_not_overwritten(unfinished):
    """Without `resume` it could only be lost."""
    with pytest.raises(SettingsError, match="--resume"):
        mi_prt.precompute(SCENE, output=unfinished, **SETTINGS)


def test_resume_without_anything_to_continue_starts(undisturbed, tmp_path):
    """So that a script can always pass it."""
    mi_prt.precompute(SCENE, output=tmp_path / "a.prt", resume=True, **SETTINGS)
    assert (tmp_path / "a.prt").read_bytes() == undisturbed.read_bytes()


def test_too_many_coefficients_cost_no_rays(tmp_path):
    """The rank is known only after the fit: then another number may be asked for, and the rays are
    not traced again.
    """
    flat = scene(box=cube())  # six normals and no shadow
    settings = dict(directions="cubemap:8", edge_length=0.4)
    path, seen = tmp_path / "a.prt", []
    with pytest.raises(SettingsError, match="at most") as caught:
        mi_prt.precompute(flat, output=path, coefficients=60, **settings)
    rank = int(str(caught.value).split("at most ")[1].split()[0])
    asset = mi_prt.precompute(
        flat,
        output=path,
        coefficients=rank,
        resume=True,
        progress=lambda *event: seen.append(event),
        **settings,
    )
    assert len(distant(asset).basis) == rank == 5
    assert seen[0][:3] == ("transport", seen[0][2], seen[0][2])


def test_a_workspace_belongs_to_one_process(tmp_path):
    with durable(tmp_path / "a.prt", {}, False):
        other = durable(tmp_path / "a.prt", {}, True)
        with pytest.raises(SettingsError, match="another process"), other:
            pass
    assert os.listdir(tmp_path) == []


def test_what_stands_in_the_way(tmp_path):
    """A file where the folder should be; a folder that was left before anything was recorded is no
    run.
    """
    (tmp_path / "a.prt.partial").write_text("")
    blocked = durable(tmp_path / "a.prt", {}, False)
    with pytest.raises(SettingsError, match="a.prt.partial"), blocked:
        pass
    (tmp_path / "b.prt.partial").mkdir()
    (tmp_path / "b.prt.partial" / "visibility.rows").write_bytes(b"old")
    with durable(tmp_path / "b.prt", {}, False) as workspace:
        assert workspace.rows("visibility", 2, 3).filled == 0


@pytest.mark.parametrize("content", ["", "3", "[1]", "{no json", "null"])
def test_a_damaged_record_is_refused_and_nothing_deleted(unfinished, content):
    """What rows belong to cannot be told any more; without versions or scene it could be any
    run's.
    """
    (partial(unfinished) / "run.json").write_text(content)
    with pytest.raises(SettingsError, match="damaged"):
        mi_prt.precompute(SCENE, output=unfinished, resume=True, **SETTINGS)
    (partial(unfinished) / "run.json").write_text("{}")
    with pytest.raises(SettingsError, match="scene was not recorded"):
        mi_prt.precompute(SCENE, output=unfinished, resume=True, **SETTINGS)
    assert (partial(unfinished) / "visibility.rows").stat().st_size > 0


@pytest.mark.parametrize("foreign", ["thesis.tex", "folder"])
def test_files_that_are_not_ours_are_left_alone(tmp_path, foreign):
    folder = tmp_path / "a.prt.partial"
    folder.mkdir()
    (folder / foreign).mkdir() if foreign == "folder" else (folder / foreign).write_text("precious")
    with pytest.raises(SettingsError, match=foreign):
        mi_prt.precompute(SCENE, output=tmp_path / "a.prt", **SETTINGS)
    assert os.listdir(folder) == [foreign]


def test_a_link_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "a.prt.partial").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SettingsError, match="link"):
        mi_prt.precompute(SCENE, output=tmp_path / "a.prt", **SETTINGS)


def test_a_folder_that_was_replaced_while_it_was_locked(tmp_path, monkeypatch):
    """The first lock is on a folder that another process removes and makes again: it is noticed,
    and the new one is locked.
    """
    flock, calls = fcntl.flock, []

    def replaced(handle, operation):
        if not calls:
            (tmp_path / "a.prt.partial").rmdir()
            (tmp_path / "a.prt.partial").mkdir()
        calls.append(handle)
        flock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", replaced)
    with durable(tmp_path / "a.prt", {}, False):
        monkeypatch.setattr(fcntl, "flock", flock)
        other = durable(tmp_path / "a.prt", {}, True)
        with pytest.raises(SettingsError, match="another process"), other:
            pass
    assert len(calls) == 2


def test_the_scene_is_not_overwritten(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("<scene version='3.0.0'><shape type='sphere'/></scene>")
    with pytest.raises(SettingsError, match="was not written by mi_prt"):
        mi_prt.precompute(path, output=path)
    with pytest.raises(SettingsError, match="the scene itself"):
        mi_prt.precompute(path, output=path, force=True)
    assert "sphere" in path.read_text() and os.listdir(tmp_path) == ["scene.xml"]


def test_a_link_to_the_output_stays_a_link(undisturbed, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "a.prt").symlink_to(tmp_path / "data" / "a.prt")
    mi_prt.precompute(SCENE, output=tmp_path / "a.prt", **SETTINGS)
    assert (tmp_path / "a.prt").is_symlink() and (
        tmp_path / "data" / "a.prt"
    ).read_bytes() == undisturbed.read_bytes()


def test_resume_needs_an_output():
    with pytest.raises(SettingsError, match="output"):
        mi_prt.precompute(SCENE, resume=True, **SETTINGS)


def test_numbers_of_other_types_are_the_same_settings(unfinished, undisturbed):
    """The command line passes text, programs NumPy's numbers."""
    settings = dict(
        directions="cubemap:16", edge_length="0.10", coefficients=np.int64(24), seed=np.int32(0)
    )
    settings |= dict(rays_per_direction=np.int16(1), bounces=np.uint8(0))
    mi_prt.precompute(SCENE, output=unfinished, resume=True, **settings)
    assert unfinished.read_bytes() == undisturbed.read_bytes()


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    ("run", "negligible"),
    [("direct", 0), ("direct", 1e9), ("solve", 0), ("paths", 0)],
    ids=["iterated", "exact", "solve", "paths"],
)
def test_results_do_not_depend_on_threads_and_memory(
    files, tmp_path, monkeypatch, threads, run, negligible
):
    """The way of the fit is chosen by shape alone, and sums are taken in an order that is fixed."""
    expected = files[run]
    if negligible:
        monkeypatch.setattr(pca, "NEGLIGIBLE", negligible)
        mi_prt.precompute(SCENE, output=tmp_path / "a.prt", **RUNS[run])
        expected = tmp_path / "a.prt"
    before = mitsuba_threads()
    mi_prt.system.runtime.set_threads(threads)
    try:
        limit = resident_bytes() + 200_000_000
        mi_prt.precompute(SCENE, output=tmp_path / "b.prt", max_memory=limit, **RUNS[run])
    finally:
        mi_prt.system.runtime.set_threads(before)
    assert expected.read_bytes() == (tmp_path / "b.prt").read_bytes()


@pytest.mark.parametrize("bounces", [40, "auto"])
def test_reflections_that_are_solved_for_do_not_depend_on_threads_and_blocks(
    tmp_path, monkeypatch, bounces
):
    """Between white walls, where a series is long and `auto` leaves it to a Krylov method."""
    walls = {
        name: rectangle(normal, -np.array(normal), 1, bsdf=diffuse([0.95, 0.9, 0.9]))
        for name, normal in {
            "floor": (0, 1, 0),
            "left": (1, 0, 0),
            "right": (-1, 0, 0),
            "back": (0, 0, 1),
            "roof": (0, -1, 0),
        }.items()
    }
    settings = dict(directions="cubemap:8", edge_length=0.3, bounces=bounces, paths_per_point=32)
    mi_prt.precompute(scene(**walls), output=tmp_path / "a.prt", **settings)
    assert distant(mi_prt.load(tmp_path / "a.prt")).report["bounces"] > MOST_SUMMED_BOUNCES
    monkeypatch.setattr(room, "LANES", LANES)
    before = mitsuba_threads()
    mi_prt.system.runtime.set_threads(3)
    try:
        mi_prt.precompute(scene(**walls), output=tmp_path / "b.prt", **settings)
    finally:
        mi_prt.system.runtime.set_threads(before)
    assert (tmp_path / "a.prt").read_bytes() == (tmp_path / "b.prt").read_bytes()


def test_a_share_that_is_out_of_reach_costs_no_rays(tmp_path):
    """Harmonics do not get there: another share may be asked for, and the rays are not traced
    again.
    """
    settings = dict(
        directions="cubemap:8", edge_length=0.3, basis="sh", coefficients="auto", bounces=0
    )
    path, seen = tmp_path / "a.prt", []
    with pytest.raises(SettingsError, match="resume"):
        mi_prt.precompute(SCENE, output=path, variance=0.99999, **settings)
    mi_prt.precompute(
        SCENE,
        output=path,
        variance=0.8,
        resume=True,
        progress=lambda *event: seen.append(event),
        **settings,
    )
    assert seen[0][:3] == ("transport", seen[0][2], seen[0][2])


def test_passes_of_a_fit_that_failed_do_not_reach_another(tmp_path, monkeypatch):
    """A search for a share of the variance starts its later fits from earlier ones. When it fails
    and so many components are asked for outright, that fit is the one of an undisturbed run.
    """
    module, tried = sys.modules["mi_prt.precompute.distant"], []
    leading = pca._leading
    monkeypatch.setattr(
        pca, "_leading", lambda *arguments: tried.append(arguments[2]) or leading(*arguments)
    )
    auto = SETTINGS | dict(coefficients="auto", variance=0.993)

    def refuse(*_):
        raise SettingsError("no room")

    with monkeypatch.context() as patch:
        patch.setattr(module, "check_room", refuse)
        with pytest.raises(SettingsError, match="no room"):
            mi_prt.precompute(SCENE, output=tmp_path / "a.prt", **auto)
    assert len(tried) > 1
    outright = SETTINGS | dict(coefficients=tried[1])
    mi_prt.precompute(SCENE, output=tmp_path / "a.prt", resume=True, **outright)
    mi_prt.precompute(SCENE, output=tmp_path / "b.prt", **outright)
    assert (tmp_path / "a.prt").read_bytes() == (tmp_path / "b.prt").read_bytes()


def test_paths_kept_in_a_span_that_was_given_up_do_not_reach_another(tmp_path, monkeypatch):
    """Reflections make a second fit necessary, to more of direct transport; there is no room for
    it. As many coefficients as the first fit had, asked for outright, have another span by a
    little: the paths of an undisturbed run are told in that one.
    """
    module, fits = sys.modules["mi_prt.precompute.distant"], []
    walls = {
        name: rectangle(normal, -np.array(normal), 1)
        for name, normal in dict(a=(0, 1, 0), b=(1, 0, 0), c=(0, 0, 1)).items()
    }
    corner = scene(
        **{
            name: wall | {"bsdf": diffuse(0.9)}
            for name, wall in (walls | dict(box=cube((-0.2, -0.6, -0.2), 0.4))).items()
        }
    )
    settings = dict(
        directions="cubemap:8", edge_length=0.2, bounces=1, indirect="paths", paths_per_point=256
    )

    def refuse(what, *_):
        fits.append(int(what.split()[1]))
        if len(fits) > 1:
            raise SettingsError("no room")

    with monkeypatch.context() as patch:
        patch.setattr(module, "check_room", refuse)
        with pytest.raises(SettingsError, match="no room"):
            mi_prt.precompute(
                corner, output=tmp_path / "a.prt", coefficients="auto", variance=0.97, **settings
            )
    assert 40 < fits[0] < fits[1] and list(partial(tmp_path / "a.prt").glob("paths-*.rows"))
    mi_prt.precompute(
        corner, output=tmp_path / "a.prt", coefficients=fits[0], resume=True, **settings
    )
    mi_prt.precompute(corner, output=tmp_path / "b.prt", coefficients=fits[0], **settings)
    assert (tmp_path / "a.prt").read_bytes() == (tmp_path / "b.prt").read_bytes()


def test_an_unfinished_run_is_no_asset(unfinished):
    for path in [unfinished, partial(unfinished), partial(unfinished) / "visibility.rows"]:
        with pytest.raises(AssetError):
            mi_prt.load(path)


# --- rows on disk ---------------------------------------------------------------------------------


@pytest.fixture
def rows(tmp_path):
    """Rows 0…9 of 5 bytes in blocks of 4, 4 and 2, and their file."""
    matrix = np.random.default_rng(0).integers(0, 256, (10, 5)).astype(np.uint8)
    file = RowFile(tmp_path / "a.rows", 10, 5)
    for block in np.split(matrix, [4, 8]):
        file.append(block)
    file.close()
    return tmp_path / "a.rows", matrix


def test_rows_are_read_by_slice_and_by_index(rows):
    path, matrix = rows
    file = RowFile(path, 10, 5)
    assert file.filled == 10 and file.shape == matrix.shape
    for index in [
        slice(None),
        slice(3, 7),
        slice(8, 20),
        np.array([0, 3, 9]),
        np.array([5]),
        np.array([], int),
    ]:
        np.testing.assert_array_equal(file[index], matrix[index])


@pytest.mark.parametrize("cut", range(0, 51, 7))
def test_a_torn_end_is_dropped(rows, cut):
    """The data end anywhere, as after a power failure: whole blocks stay, and appending goes on
    behind them.
    """
    path, matrix = rows
    path.write_bytes(path.read_bytes()[:cut])
    file = RowFile(path, 10, 5)
    kept = 0 if cut < 20 else 4 if cut < 40 else 8 if cut < 50 else 10
    assert file.filled == kept
    if kept < 10:
        file.append(matrix[kept:])
    np.testing.assert_array_equal(file[:], matrix)
    file.close()
    np.testing.assert_array_equal(RowFile(path, 10, 5)[:], matrix)


def test_a_damaged_block_and_a_torn_journal_are_dropped(rows):
    path, _ = rows
    content = bytearray(path.read_bytes())
    content[25] ^= 1  # in the second block
    path.write_bytes(content)
    assert RowFile(path, 10, 5).filled == 4
    journal = path.with_suffix(".journal")
    for text in [b"4", b"4 x\n", b"-4 1\n", b"999 1\n", b"\xff\xfe\n", b""]:
        journal.write_bytes(text)
        assert RowFile(path, 10, 5).filled == 0


def test_arrays_are_kept_whole_or_not_at_all():
    """Torn, with one bit flipped, or with another file's content: computed again, and stored."""
    with temporary() as workspace:
        path = workspace.folder / "a.array"
        assert workspace.keep("a", lambda: np.arange(3.0)).sum() == 3
        assert workspace.keep("a", lambda: np.zeros(3)).sum() == 3
        whole = path.read_bytes()
        for damaged in [
            b"",
            b"torn",
            whole[:-5],
            whole[:130] + bytes([whole[130] ^ 1]) + whole[131:],
            b"PK" + whole[2:],
            whole * 2,
        ]:
            path.write_bytes(damaged)
            assert workspace.keep("a", lambda: np.full(3, 5.0)).sum() == 15
        assert [p.name for p in workspace.folder.iterdir()] == ["a.array"]
        folder = workspace.folder
    assert not folder.exists()


def test_reads_beyond_what_the_system_gives_at_once(rows, monkeypatch):
    """Linux reads at most 2 GiB in one call; here three bytes."""
    path, matrix = rows
    pread = os.pread
    monkeypatch.setattr(os, "pread", lambda handle, size, start: pread(handle, min(size, 3), start))
    file = RowFile(path, 10, 5)
    assert file.filled == 10
    np.testing.assert_array_equal(file[:], matrix)


# --- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", ["0", "-1G", "many", "3 apples", "nan", 0, True, "inf", ""])
def test_bad_memory(bad):
    with pytest.raises(SettingsError, match="memory"):
        mi_prt.precompute(SCENE, max_memory=bad, **SETTINGS)


def test_too_little_memory_says_how_much_is_needed():
    with pytest.raises(SettingsError, match="raise max_memory"):
        mi_prt.precompute(SCENE, max_memory="10M", **SETTINGS)


def run_within_memory(path, run):
    """Prints a limit, the peak below it, and blocks with it and without. In a process of its
    own.
    """
    pca.NEGLIGIBLE, settings = 0, RUNS[run]
    small = dict(directions="cubemap:2", edge_length=1, coefficients=4)
    mi_prt.precompute(SCENE, **settings | small)  # what Mitsuba and Embree take once
    limit = resident_bytes() + 60_000_000

    def blocks(**options):
        stages = []
        mi_prt.precompute(
            SCENE, progress=lambda stage, *_: stages.append(stage), **options, **settings
        )
        return stages.count("transport")

    limited = blocks(output=path, max_memory=limit)
    print(limit, peak_memory_bytes(), limited, blocks())


@pytest.mark.parametrize("run", RUNS)
def test_a_run_stays_within_its_memory_and_gives_the_same_file(files, starter, tmp_path, run):
    """The peak of a process that ran nothing before, by the kernel's own count, with a limit that a
    whole wavefront does not fit into.
    """
    process = starter.start("run_within_memory", str(tmp_path / "a.prt"), run)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors[-2000:]
    limit, peak, limited, blocks = map(int, output.split())
    assert peak <= limit and limited > blocks
    assert (tmp_path / "a.prt").read_bytes() == files[run].read_bytes()
