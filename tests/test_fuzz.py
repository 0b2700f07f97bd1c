"""The fuzzer of asset files, over the container: no hostile file does harm, and harm is noticed."""

import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import small_assets
from mutants import TURNS, Mutator

from mi_prt.asset import container
from mi_prt.basis.basis import BASES
from mi_prt.errors import AssetError
from mi_prt.system.schema import Array, ListOf, Number, OneOf, Record, Text, check

FUZZER = Path(__file__).parent / "fuzz_assets.py"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="limits and watches are Linux's"),
]

# --- a small asset that has what the real one has: indices, ranges, kinds, a recorded path --------

SPEC = Record(
    {
        "scene": Record({"kind": Text("file", "mesh"), "path": OneOf(Text(), Number())}),
        "basis": Text("pca", "haar"),
        "surfaces": ListOf(Text()),
        "bounces": Number(0, 1000, whole=True),
    }
)
SCHEMA = {
    "points/positions": Array("f4", ("n", 3)),
    "points/buried": Array("?", ("n",)),
    "points/surface": Array("i4", ("n",), least=0, below="surfaces"),
    "clusters/starts": Array("i8", ("c+1",), least=0, below="n+1"),
    "basis/vectors": Array("f4", ("d", "s")),
    "coefficients/indices": Array(("u2", "u4"), ("n", "k"), below="d"),
    "coefficients/values": Array(("i2", "f4"), ("n", "k")),
    "extra": Array("f8", ("e",), optional=True),
}


def make(path, scene):
    rng = np.random.default_rng(0)
    header = {
        "scene": {"kind": "file", "path": str(scene)},
        "basis": "haar",
        "surfaces": ["floor", "wall"],
        "bounces": 8,
    }
    arrays = {
        "points/positions": rng.random((50, 3), np.float32),
        "points/buried": rng.random(50) < 0.2,
        "points/surface": rng.integers(0, 2, 50, np.int32),
        "clusters/starts": np.array([0, 20, 50]),
        "basis/vectors": rng.random((16, 24), np.float32),
        "coefficients/indices": rng.integers(0, 16, (50, 4), np.uint16),
        "coefficients/values": rng.random((50, 4), np.float32),
    }
    container.write(path, header, arrays)
    return path


def load(path):
    with container.opened(path) as stored:
        header = check(stored.header, SPEC)
        stored.check(SCHEMA, {"surfaces": len(header["surfaces"])})
        asset = {name: stored.array(name) for name in stored.names}
        starts, points = asset["clusters/starts"], len(asset["points/buried"])
        if starts[0] != 0 or starts[-1] != points or (np.diff(starts) < 1).any():
            raise ValueError("clusters/starts do not part the points")
        return asset


def relight(asset):
    """Uses each index, without a check of its own: NumPy would take −1."""
    np.zeros(2)[asset["points/surface"]]
    with np.errstate(all="ignore"):
        light = asset["basis/vectors"].sum(axis=1)[asset["coefficients/indices"]]
        values = (light * asset["coefficients/values"]).sum(axis=1)
        np.add.reduceat(values, asset["clusters/starts"][:-1])


GOOD = Path(os.environ["GOOD"]).read_bytes() if "GOOD" in os.environ else None
HARMS = ("traceback", "crash", "hang", "memory", "foreign read", "message")


def load_badly(path):
    """A load that does harm, of another kind to every eighth mutant or so."""
    content = Path(path).read_bytes()
    harm = zlib.crc32(content) % 64
    if content == GOOD or harm > 8:
        return load(path)
    if harm == 0:
        raise KeyError("basis")
    if harm == 1:
        os.abort()
    if harm == 2:
        time.sleep(60)
    if harm == 3:
        return np.ones(250 << 17)
    if harm == 4:
        return Path("/etc/passwd").read_bytes()
    if harm == 5:
        raise AssetError("two\nlines")
    if harm == 6:
        while True:
            pass
    if harm == 7:  # as a library does it
        return ctypes.CDLL(None).open(os.fsencode(Path(path).with_name("trap.xml")), 0)
    os.listdir("/")
    return None


# --- the fuzzer -----------------------------------------------------------------------------------


def fuzz(*arguments, **environment):
    """What the program says: exit code, counts by (kind, outcome), failures, text."""
    with tempfile.TemporaryDirectory() as folder:
        result = os.path.join(folder, "result.json")
        ran = subprocess.run(
            [sys.executable, FUZZER, *map(str, arguments), "--json", result],
            capture_output=True,
            text=True,
            env=os.environ | environment,
        )
        assert os.path.exists(result), ran.stdout[-2000:] + ran.stderr[-2000:]
        found = json.loads(Path(result).read_text())
    counts = {(kind, outcome): count for kind, outcome, count in found["counts"]}
    return ran.returncode, counts, found["failures"], ran.stdout


@pytest.fixture
def good(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text("<scene version='3.0.0'/>")
    return make(tmp_path / "good.prt", scene)


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """Paths of the small assets by kind."""
    return small_assets.make(tmp_path_factory.mktemp("small"))


def test_no_hostile_container_does_harm(good):
    """3,200 mutants of the file above. Some of each kind must load, else the fuzzer would reach no
    deeper code.
    """
    code, counts, failures, text = fuzz(
        good, "--count", 3200, "--load", "test_fuzz:load", "--relight", "test_fuzz:relight"
    )
    assert not failures and code == 0, text[-4000:]
    assert sum(counts.values()) == 3200
    assert {kind for kind, outcome in counts if outcome == "refused"} == {*TURNS, "bomb"}
    loaded = {kind: count for (kind, outcome), count in counts.items() if outcome == "loaded"}
    assert {"flipped", "own", "entry", "layout", "text"} <= loaded.keys(), text


def test_no_hostile_file_does_harm(small):
    """80 mutants of each small asset: loaded, relit, described, and looked up between points.

    Some of each kind must load, else the fuzzer would reach no deeper code.
    """
    count = 80 * len(small)
    code, counts, failures, text = fuzz(*small.values(), "--count", count, "--seconds", 120)
    assert not failures and code == 0, text[-4000:]
    assert sum(counts.values()) == count
    assert {kind for kind, outcome in counts if outcome == "refused"} >= {*TURNS}
    loaded = {kind: count for (kind, outcome), count in counts.items() if outcome == "loaded"}
    assert {"flipped", "own", "entry", "layout"} <= loaded.keys(), text


def test_small_assets_are_of_all_kinds(small):
    """So that mutants reach each branch of the reader: all arrays that the format knows are
    there.
    """
    names, headers = set(), []
    for path in small.values():
        with container.opened(path) as stored:
            names.update(stored.names)
            headers.append(stored.header)
    assert len({h["points"]["layout"] for h in headers}) == 2
    parts = [part for h in headers for part in h["transports"].items()]
    assert {part["basis"] for kind, part in parts if kind == "distant"} == set(BASES)
    assert {part["sparse"] for kind, part in parts if kind == "local"} == {True, False}
    assert {part["quantize"] for kind, part in parts if kind != "distant"} == {"16", "none"}
    for text in ("direct/coefficients", "transfer/matrix", "transfer/ends", "direct_scale"):
        assert any(name.endswith(text) for name in names)


def test_harm_is_noticed(good):
    """Each kind of failure, by a load that does it on purpose to about six files of 400.

    The files are the same in every run, up to the folder that the traps are in.
    """
    good = make(good, "scene.xml")
    code, counts, failures, text = fuzz(
        good, "--count", 400, "--load", "test_fuzz:load_badly", "--relight", "none",
        "--seconds", 1, "--workers", 8, GOOD=str(good),
    )  # fmt: skip
    assert code == 1
    assert {failure["outcome"] for failure in failures} == set(HARMS), text
    assert sum(counts.values()) == 400
    said = " ".join(failure["said"] for failure in failures)
    for words in (
        "KeyError",
        "SIGABRT",
        "/etc/passwd",
        "a trap, by a library",
        "os.listdir",
        "two",
    ):
        assert words in said
    mutator = Mutator(good.read_bytes())
    for failure in failures:
        assert failure["kind"] == mutator.make(1, failure["index"])[0]


def test_the_same_seed_makes_the_same_files(good):
    """And another seed others; few are good or made twice."""
    one, two = (Mutator(good.read_bytes(), ["a", "b", "c"]) for _ in range(2))
    files = [one.make(3, index) for index in range(500)]
    assert files == [two.make(3, index) for index in range(500)]
    assert files != [two.make(4, index) for index in range(500)]
    unchanged = sum(content == good.read_bytes() for _, _, content in files)
    assert unchanged < 10
    assert len({content for _, _, content in files}) > 400


def test_a_mutant_can_be_kept(good, tmp_path):
    """To look into a failure: the file that its index names."""
    subprocess.run([sys.executable, FUZZER, good, "--save", f"21:{tmp_path / 'x'}"], check=True)
    traps = ["trap.txt", "trap.xml", "trap.fifo"]
    assert (tmp_path / "x").read_bytes() == Mutator(good.read_bytes(), traps).make(1, 21)[2]
