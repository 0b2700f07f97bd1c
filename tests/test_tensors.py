"""The container of assets: what is written reads back, and every fault is one AssetError."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_prt.asset import container
from mi_prt.errors import AssetError, SettingsError
from mi_prt.system.schema import Array

ARRAYS = {
    "points/buried": np.array([True, False, False, True, False]),
    "points/positions": np.arange(15, dtype=np.float32).reshape(5, 3) / 7,
    "points/surface": np.array([0, 2, 1, 0, 1], np.int32),
    "starts": np.array([0, 2, 5], np.int64),
    "extent": np.array(2.5),
    "bits": np.arange(10, dtype=np.uint8).reshape(5, 2),
    "rows": np.zeros((0, 4), np.float32),
}
SCHEMA = {
    "points/buried": Array("?", ("n",)),
    "points/positions": Array("f4", ("n", 3)),
    "points/surface": Array("i4", ("n",), least=0, below="surfaces"),
    "starts": Array("i8", ("c+1",), least=0, below="n+1"),
    "extent": Array(("f4", "f8"), (), least=0),
    "bits": Array("u1", ("n", "b")),
    "rows": Array("f4", ("r", 4), optional=True),
    "colours": Array("f4", ("n",), optional=True),
}
SIZES = {"surfaces": 3}
HEADER = {"settings": {"seed": 2**64 - 1, "edge": 0.1}, "scene": "müsli.xml", "lamps": [None, True]}


@pytest.fixture
def path(tmp_path):
    container.write(tmp_path / "a.prt", HEADER, ARRAYS)
    return tmp_path / "a.prt"


def read(path, schema=SCHEMA, sizes=SIZES, copy=False):
    """Header, arrays and sizes, with all checks."""
    with container.opened(path) as stored:
        bound = stored.check(schema, sizes)
        return stored.header, {name: stored.array(name, copy) for name in stored.names}, bound


def refused(path, message, read=read):
    """Reading ends in one AssetError of one line that names the file and the fault."""
    with pytest.raises(AssetError, match=message) as caught:
        read(path)
    assert type(caught.value) is AssetError and "\n" not in str(caught.value)
    assert os.path.basename(path) in str(caught.value)


def parts(path):
    """Header as a dict, and the arrays' bytes; independent of the code under test."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def put(path, content):
    """Write a new file: ext4 flushes one that is written over, which takes 3 ms."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)


def rewrite(path, header, data):
    """A file of any header, a dict or bytes, and any data."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    put(path, struct.pack("<Q", len(text)) + text + data)
    return path


# --- what is written reads back -------------------------------------------------------------------


@pytest.mark.parametrize("copy", [False, True])
def test_what_is_written_reads_back(path, copy):
    header, arrays, sizes = read(path, copy=copy)
    assert header == HEADER
    assert arrays.keys() == ARRAYS.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, ARRAYS[name], strict=True)
        assert array.flags.writeable == copy or not array.size
    assert sizes == {"surfaces": 3, "n": 5, "c": 2, "b": 2, "r": 0}


def test_a_reader_of_ten_lines(path):
    """A browser reads the format with JSON and typed arrays: no other knowledge goes into this."""
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    metadata = header.pop("__metadata__")
    letters = {"BOOL": "?", "U8": "B", "I32": "i", "I64": "q", "F32": "f", "F64": "d"}
    for name, entry in header.items():
        start, stop = (8 + length + offset for offset in entry["data_offsets"])
        values = [
            v for (v,) in struct.iter_unpack("<" + letters[entry["dtype"]], content[start:stop])
        ]
        assert values == ARRAYS[name].ravel().tolist() and entry["shape"] == [*ARRAYS[name].shape]
    assert (metadata["format"], metadata["format_version"]) == ("mi_prt asset", "6")
    assert json.loads(metadata["mi_prt"]) == HEADER and header.keys() == ARRAYS.keys()


def test_the_library_reads_it(path):
    safetensors = pytest.importorskip("safetensors")
    with safetensors.safe_open(path, framework="numpy") as file:
        assert set(file.keys()) == ARRAYS.keys()
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(file.get_tensor(name), array, strict=True)
        assert json.loads(file.metadata()["mi_prt"]) == HEADER


def test_arrays_are_aligned(path):
    """The first at 64 bytes in the file, each at its item size, as typed arrays of browsers ask."""
    header, _ = parts(path)
    first = 8 + int.from_bytes(path.read_bytes()[:8], "little")
    assert first % 64 == 0
    for name, array in ARRAYS.items():
        assert header[name]["data_offsets"][0] % array.itemsize == 0


def test_the_same_input_gives_the_same_bytes(path, tmp_path):
    """Also in another order, byte order and memory layout."""
    other = {
        name: a.astype(a.dtype.newbyteorder(">")).copy(order="F") for name, a in ARRAYS.items()
    }
    other = dict(reversed(other.items()))
    container.write(tmp_path / "b.prt", dict(reversed(HEADER.items())), other)
    assert (tmp_path / "b.prt").read_bytes() == path.read_bytes()


class Rows:
    """Rows that are made when they are asked for; remembers how many at once."""

    def __init__(self, count, width):
        self.shape, self.dtype, self.most = (count, width), np.dtype("f4"), 0

    def __getitem__(self, rows):
        first, last, _ = rows.indices(self.shape[0])
        self.most = max(self.most, last - first)
        return np.repeat(np.arange(first, last, dtype=np.float32)[:, None], self.shape[1], axis=1)


def test_rows_are_streamed(tmp_path):
    """No more than a block is asked for at once, and an array across blocks is whole."""
    rows = Rows(5000, 1000)
    container.write(tmp_path / "a.prt", {}, {"rows": rows})
    assert rows.most * 4000 <= container.BLOCK < 5000 * 4000
    array = read(tmp_path / "a.prt", {"rows": Array("f4", ("n", 1000))})[1]["rows"]
    np.testing.assert_array_equal(array, rows[0:5000])


@settings(max_examples=50, deadline=None)
@given(
    st.dictionaries(
        st.text(max_size=5),
        st.recursive(
            st.none()
            | st.booleans()
            | st.floats(allow_nan=False, allow_infinity=False)
            | st.integers(-(2**63), 2**64 - 1)
            | st.text(max_size=9),
            lambda inner: st.lists(inner) | st.dictionaries(st.text(max_size=3), inner),
            max_leaves=9,
        ),
    )
)
def test_any_header_reads_back(tmp_path_factory, header):
    """What JSON holds, of any characters (hypothesis makes no half characters)."""
    path = tmp_path_factory.getbasetemp() / "header.prt"
    container.write(path, header, {})
    assert read(path, {})[0] == header


def test_views_outlive_the_file(path):
    """An asset stays usable while its file is replaced or removed."""
    _, arrays, _ = read(path)
    container.write(path, {}, {"other": np.zeros(9)})
    path.unlink()
    np.testing.assert_array_equal(arrays["points/positions"], ARRAYS["points/positions"])


# --- what write refuses ---------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_no_file_is_written_that_would_not_load(path, value):
    old, array = path.read_bytes(), np.zeros((9, 2), np.float32)
    array[7, 1] = value
    with pytest.raises(AssetError, match="holds NaN or infinity"):
        container.write(path, {}, {"a": array})
    assert path.read_bytes() == old and os.listdir(path.parent) == ["a.prt"]


@pytest.mark.parametrize(
    "header",
    [{"a": np.nan}, {"a": 2**64}, {"a": object()}, {"a": "\udcff"}, {"a": {1, 2}}],
    ids=["nan", "large", "object", "surrogate", "set"],
)
def test_headers_that_would_not_read_back_are_refused(tmp_path, header):
    with pytest.raises((ValueError, TypeError)):
        container.write(tmp_path / "a.prt", header, {})
    assert not os.listdir(tmp_path)


def test_a_header_beyond_the_limit_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="4,194,304"):
        container.write(tmp_path / "a.prt", {"a": "x" * container.MAX_HEADER}, {})


def test_arrays_of_other_kinds_are_refused(tmp_path):
    for array in (np.array([1j]), np.array(["a"]), np.array([None])):
        with pytest.raises(ValueError, match="has no place"):
            container.write(tmp_path / "a.prt", {}, {"a": array})


def test_rows_that_are_not_what_they_say_are_refused(tmp_path):
    rows = Rows(10, 3)
    rows.shape = (10, 4)
    rows.__class__ = type(
        "Odd", (Rows,), {"__getitem__": lambda self, rows: np.zeros((10, 3), "f4")}
    )
    with pytest.raises(ValueError, match="rows of a"):
        container.write(tmp_path / "a.prt", {}, {"a": rows})
    assert not os.listdir(tmp_path)


# --- all or nothing -------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="a limit on file sizes stands for a full disk")
@pytest.mark.parametrize("limit", [10, 3_000, 1_000_000])
def test_a_full_disk_is_an_error(path, limit):
    """Writes that fail in the header, in the first array, in a later block."""
    code = f"""
import resource, sys, numpy as np
from mi_prt.asset import container
from mi_prt.errors import SettingsError
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
try:
    container.write(sys.argv[1], dict(x="y" * 2000), dict(a=np.zeros(100_000), b=np.zeros(100_000)))
except SettingsError as error:
    print(error)
"""
    old = path.read_bytes()
    ran = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert ran.returncode == 0 and "cannot be written" in ran.stdout, ran.stderr
    assert path.read_bytes() == old and os.listdir(path.parent) == ["a.prt"]


def test_a_killed_write_leaves_the_old_file(path):
    """SIGKILL between two blocks."""
    code = """
import sys, time, numpy as np
from mi_prt.asset import container
class Rows:
    shape, dtype = (5000, 1000), np.dtype("f4")
    def __getitem__(self, rows):
        if rows.start:
            print("half", flush=True)
            time.sleep(60)
        return np.ones((len(range(*rows.indices(5000))), 1000), "f4")
container.write(sys.argv[1], {}, {"a": Rows()})
"""
    old = path.read_bytes()
    writer = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE)
    assert writer.stdout.readline() == b"half\n"
    assert len(os.listdir(path.parent)) == 2  # the file is under way
    writer.send_signal(signal.SIGKILL)
    writer.communicate()
    assert path.read_bytes() == old
    assert read(path)[0] == HEADER


def test_paths_that_cannot_be_written(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "folder", tmp_path / "none" / "a.prt", tmp_path / ("x" * 300)):
        with pytest.raises(SettingsError):
            container.write(path, {}, {})


# --- what is no file ------------------------------------------------------------------------------


def test_what_is_no_regular_file(tmp_path):
    """None of them is opened: a fifo would wait for ever."""
    start = time.monotonic()
    refused(tmp_path / "none.prt", "does not exist")
    (tmp_path / "file").write_text("x")
    refused(tmp_path / "file" / "none.prt", "does not exist")
    (tmp_path / "link").symlink_to("none.prt")
    refused(tmp_path / "link", "does not exist")
    (tmp_path / "loop").symlink_to("loop")
    refused(tmp_path / "loop", "cannot be read")
    refused(tmp_path, "is a folder")
    os.mkfifo(tmp_path / "fifo")
    refused(tmp_path / "fifo", "is a fifo")
    refused("/dev/zero", "is a device")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket"))
        refused(tmp_path / "socket", "is a socket")
    refused(tmp_path / ("x" * 300), "cannot be read")
    with pytest.raises(AssetError, match="null"):
        read("a\0b")
    assert time.monotonic() - start < 5


def test_a_fifo_that_takes_the_place_of_a_file(tmp_path, monkeypatch):
    """Between the look at the file and its opening: still no wait."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").write_text("x")
    look = os.stat
    monkeypatch.setattr(os, "stat", lambda path: look(tmp_path / "file"))
    refused(tmp_path / "fifo", "is a fifo")


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read anything"
)
def test_a_file_without_permission(path):
    path.chmod(0)
    refused(path, "Permission denied")


# --- bytes that are no asset ----------------------------------------------------------------------


def test_other_files(path, tmp_path):
    for content, message in [
        (b"", "empty"),
        (b"short", "truncated"),
        (b"PK\3\4" + bytes(999), "truncated|no header|limit"),
        (b"\x89HDF\r\n\x1a\n" + bytes(99), "older version.*precompute it again"),
        (bytes(999), "no header"),
        (b"\xff" * 999, "truncated"),
    ]:
        (tmp_path / "x.prt").write_bytes(content)
        refused(tmp_path / "x.prt", message)
    refused(rewrite(path, {"__metadata__": {"format": "pt"}}, b""), "another safetensors")
    refused(rewrite(path, {}, b""), "another safetensors")


def test_every_truncation_is_refused(path):
    """A file that lacks one byte or more, or has one more."""
    content = path.read_bytes()
    for length in range(len(content)):
        put(path, content[:length])
        refused(path, "truncated|empty|file that holds|outside|can hold")
    path.write_bytes(content + b"\0")
    refused(path, "file that holds")


@pytest.mark.parametrize(
    ("version", "message"),
    [
        ("4", "older version.*precompute it again"),
        ("7", "newer version.*update mi_prt"),
        ("05", "no format version"),
        ("٥", "no format version"),
        ("-5", "no format version"),
        ("9" * 5000, "no format version"),
        (5, "no format version"),
        (None, "no format version"),
    ],
)
def test_versions(path, version, message):
    header, data = parts(path)
    header["__metadata__"]["format_version"] = version
    refused(rewrite(path, header, data), message)


@pytest.mark.parametrize(
    "own", ["[]", "3", "", "{", '{"a": NaN}', '{"a":1,"a":2}', '{"a":1e999}', None, {}, 3], ids=str
)
def test_own_headers(path, own):
    header, data = parts(path)
    header["__metadata__"]["mi_prt"] = own
    refused(rewrite(path, header, data), "damaged")


def test_unknown_metadata(path):
    header, data = parts(path)
    header["__metadata__"]["more"] = "x"
    refused(rewrite(path, header, data), "metadata")


# --- headers --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b'{"a":' + b"[" * 100_000, "nested deeper"),
        (b'{"a":' + b"[" * 33 + b"]" * 33 + b"}", "nested deeper"),
        (b'{"a":' + b'{"a":' * 50 + b"1" + b"}" * 51, "nested deeper"),
        (b'{"a":1,"a":1}', "repeats a key"),
        (b'{"a":{"b":1,"b":2}}', "repeats a key"),
        (b'{"a":NaN}', "NaN"),
        (b'{"a":-Infinity}', "Infinity"),
        (b'{"a":1e999}', "not finite"),
        (b'{"a":18446744073709551616}', "64 bits"),
        (b'{"a":' + b"9" * 100_000 + b"}", "64 bits"),
        (b'{"a":"\\ud800"}', "surrogates"),
        (b'{"a":"\xff"}', "utf-8"),
        (b'{"a":1}\0', "no JSON"),
        (b'{"a":1,}', "no JSON"),
        (b'{"a":"\n"}', "no JSON"),
        (b'\xef\xbb\xbf{"a":1}', "no header"),
        (b'["a"]', "no header"),
        (b" {}", "no header"),
        (b"{", "no JSON"),
    ],
    ids=lambda x: repr(x[:20]),
)
def test_json_that_is_refused(path, text, message):
    refused(rewrite(path, text, b""), message)


def test_a_header_longer_than_the_file_or_the_limit(path):
    content = path.read_bytes()
    for length in (2**64 - 1, 2**63, 2**32, len(content)):
        path.write_bytes(struct.pack("<Q", length) + content[8:])
        refused(path, "truncated")
    with open(path, "r+b") as file:  # the file has a hole, so that it is large on no disk
        file.write(struct.pack("<Q", 100_000_001))
        file.truncate(200_000_000)
    refused(path, "limit is 4,194,304")


F4 = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}


@pytest.mark.parametrize(
    ("entries", "held"),
    [
        ({"a": F4 | {"dtype": "F64"}}, 8),
        ({"a": F4 | {"dtype": "F99"}}, 8),
        ({"a": F4 | {"dtype": "BF16", "shape": [4]}}, 8),
        ({"a": F4 | {"dtype": 4}}, 8),
        ({"a": F4 | {"dtype": ["F32"]}}, 8),
        ({"a": F4 | {"shape": [3]}}, 8),
        ({"a": F4 | {"shape": [-2]}}, 8),
        ({"a": F4 | {"shape": [-1, -2]}}, 8),
        ({"a": F4 | {"shape": [True, 2]}}, 8),
        ({"a": F4 | {"shape": [2.0]}}, 8),
        ({"a": F4 | {"shape": ["2"]}}, 8),
        ({"a": F4 | {"shape": 2}}, 8),
        ({"a": F4 | {"shape": None}}, 8),
        ({"a": F4 | {"shape": [2**33, 2**31]}}, 8),  # 2**64 items: 0 where a product overflows
        ({"a": F4 | {"shape": [2**62, 0], "data_offsets": [0, 0]}}, 0),  # nothing claims no size
        ({"a": F4 | {"shape": [2] + [1] * 8}}, 8),
        ({"a": F4 | {"shape": [2] + [1] * 100_000}}, 8),
        ({"a": F4 | {"data_offsets": [8, 0]}}, 8),
        ({"a": F4 | {"data_offsets": [0, 16]}}, 8),
        ({"a": F4 | {"data_offsets": [-8, 0]}}, 8),
        ({"a": F4 | {"data_offsets": [0, 8, 8]}}, 8),
        ({"a": F4 | {"data_offsets": [False, 8]}}, 8),
        ({"a": F4 | {"data_offsets": [0.0, 8.0]}}, 8),
        ({"a": F4 | {"data_offsets": {}}}, 8),
        ({"a": F4 | {"data_offsets": [2**64 - 8, 2**64 - 1]}}, 8),
        ({"a": F4, "b": F4}, 8),  # overlap
        ({"a": F4, "b": F4 | {"data_offsets": [4, 12]}}, 12),
        ({"a": F4, "b": F4 | {"data_offsets": [12, 20]}}, 20),  # gap
        ({"a": F4}, 9),  # bytes that no array has
        ({}, 8),
        ({"b": {"dtype": "U8", "shape": [1], "data_offsets": [0, 1]},
          "a": F4 | {"data_offsets": [1, 9]}}, 9),  # not aligned
        ({"a": F4 | {"more": 1}}, 8),
        ({"a": {"dtype": "F32", "shape": [2]}}, 8),
        ({"a": None}, 8),
        ({"a": [F4]}, 8),
        ({"a": "F32"}, 8),
    ],
    ids=str,
)  # fmt: skip
def test_places_that_are_refused(path, entries, held):
    """dtype, shape and place of each array fit together, and all arrays fill the file."""
    header, _ = parts(path)
    rewrite(path, {"__metadata__": header["__metadata__"]} | entries, bytes(held))
    schema = {"a": Array("f4", ("n",)), "b": Array(("f4", "u1"), ("m",), optional=True)}
    refused(path, "damaged", lambda path: read(path, schema))


def test_the_base_of_those_files_is_read(path):
    """Nothing but the change is wrong in them."""
    header, _ = parts(path)
    rewrite(path, {"__metadata__": header["__metadata__"], "a": F4}, bytes(8))
    assert read(path, {"a": Array("f4", ("n",))})[2]["n"] == 2


def test_what_is_read_the_library_reads_too(path):
    """No file is an asset here and none there: 1,000 files with changed headers."""
    safetensors = pytest.importorskip("safetensors")
    rng, content, loaded = np.random.default_rng(5), path.read_bytes(), 0
    end = 8 + int.from_bytes(content[:8], "little")
    for _ in range(1000):
        changed = bytearray(content)
        for place in rng.integers(0, end, rng.integers(1, 3)):
            changed[place] = rng.choice(list(b'0123456789[]{}",: \n\\abFIU\x00\xff'))
        put(path, changed)
        try:
            with container.opened(path):
                pass
        except AssetError:
            continue
        loaded += 1
        with safetensors.safe_open(path, framework="numpy"):
            pass
    assert loaded > 10  # changes within texts and blanks


# --- the schema of arrays -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points/positions": None}, "points/positions is missing"),
        ({"odd": np.zeros(1)}, "unknown array 'odd'"),
        ({"od\nd\x1b[31m": np.zeros(1)}, r"unknown array 'od\\nd\\x1b"),
        ({"points/positions": np.zeros((5, 3))}, "dtype float64 instead of f4"),
        ({"points/surface": np.zeros(5, np.uint32)}, "dtype uint32 instead of i4"),
        (
            {"points/positions": np.zeros((4, 3), "f4")},
            r"shape \(4, 3\) instead of \(n, 3\).*n = 5",
        ),
        ({"points/positions": np.zeros((5, 4), "f4")}, r"shape \(5, 4\) instead of \(n, 3\)"),
        ({"points/positions": np.zeros((5, 3, 1), "f4")}, r"shape \(5, 3, 1\)"),
        ({"points/positions": np.zeros(15, "f4")}, r"shape \(15,\)"),
        ({"starts": np.zeros(0, np.int64)}, r"shape \(0,\) instead of \(c\+1\)"),
        ({"extent": np.zeros(1)}, "extent is of shape"),
    ],
    ids=lambda x: str(x)[:40],
)
def test_forms(path, change, message):
    arrays = {name: a for name, a in (ARRAYS | change).items() if a is not None}
    container.write(path, HEADER, arrays)
    refused(path, message)


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("points/surface", 4, -1, "holds -1, less than 0"),
        ("points/surface", 0, 3, "holds 3, not below 3"),
        ("points/surface", 0, 2**31 - 1, "not below 3"),
        ("points/surface", 0, -(2**31), "less than 0"),
        ("starts", 2, 6, "holds 6, not below 6"),
        ("points/positions", (4, 2), np.nan, "NaN"),
        ("points/positions", (0, 0), np.inf, "infinity"),
        ("points/positions", (0, 0), -np.inf, "infinity"),
        ("extent", (), -1e-9, "less than 0"),
    ],
)
@pytest.mark.parametrize("copy", [False, True])
def test_values(path, name, index, value, message, copy):
    header, data = parts(path)
    array = ARRAYS[name].copy()
    array[index] = value
    start, stop = header[name]["data_offsets"]
    rewrite(path, header, data[:start] + array.tobytes() + data[stop:])
    refused(path, message, lambda path: read(path, copy=copy))


@pytest.mark.parametrize("value", [2, 255])
def test_truth_is_0_or_1(path, value):
    header, data = parts(path)
    start, _ = header["points/buried"]["data_offsets"]
    rewrite(path, header, data[:start] + bytes([value]) + data[start + 1 :])
    refused(path, "points/buried holds")


def test_every_block_is_checked(tmp_path):
    """The first and the last value of an array of several blocks."""
    count = container.BLOCK // 4 * 2 + 10
    for place in (0, count // 2, count - 1):
        array = np.zeros(count, np.int32)
        array[place] = 7
        container.write(tmp_path / "a.prt", {}, {"a": array})
        refused(
            tmp_path / "a.prt", "holds 7", lambda p: read(p, {"a": Array("i4", ("n",), below=7)})
        )


def test_limits_that_nothing_gives(path):
    """A range by the name of a size that no array in the file has."""
    refused(path, "how large surfaces is", lambda path: read(path, sizes={}))


def test_sizes_that_are_known(path):
    assert read(path, sizes={"surfaces": 3, "n": 5})[2]["n"] == 5
    refused(path, "n = 6", lambda path: read(path, sizes={"surfaces": 3, "n": 6}))


def test_no_array_without_check(path):
    with container.opened(path) as stored, pytest.raises(KeyError):
        stored.array("points/positions")


def test_errors_of_the_reader(path):
    """ValueErrors within the block are faults of the file, others are faults of the program."""

    def fail(error):
        with container.opened(path):
            raise error

    refused(path, "odd number", lambda path: fail(ValueError("odd\nnumber")))
    refused(path, "a.prt.*cubemap", lambda path: fail(SettingsError("cubemap:0")))
    for error in (KeyError("x"), TypeError("x"), OSError("x")):
        with pytest.raises(type(error)):
            fail(error)


# --- memory ---------------------------------------------------------------------------------------

BOMBS = {
    "lists": b'{"a":[' + b"[]," * 1_398_000 + b"0]}",
    "objects": b'{"a":[' + b'{"":[]},' * 524_000 + b"0]}",
    "texts": b'{"a":[' + b'"ab",' * 838_000 + b"0]}",
    "keys": b"{" + b",".join(b'"%x":[]' % i for i in range(390_000)) + b"}",
    "shape": b'{"a":{"dtype":"F32","data_offsets":[0,4],"shape":[' + b"1," * 2_000_000 + b"1]}}",
    "digits": b'{"a":' + b"9" * 4_000_000 + b"}",
    "wide": b'{"a":"' + "𝄞".encode() * 1_000_000 + b'"}',
}


@pytest.mark.skipif(sys.platform != "linux", reason="needs limits of memory")
def test_no_file_takes_more_memory_than_promised(tmp_path, path):
    """At most 200 MB beyond what the file holds, whatever it claims; 300 MB of array are mapped."""
    for name, text in BOMBS.items():
        rewrite(tmp_path / name, text, bytes(4))
    header, _ = parts(path)
    header["__metadata__"]["mi_prt"] = (BOMBS["lists"][:4_190_000] + b"0]}").decode()
    rewrite(tmp_path / "inner", {"__metadata__": header["__metadata__"]}, b"")
    container.write(tmp_path / "array", {}, {"a": np.broadcast_to(np.float32(0), (75_000_000,))})
    code = """
import os, re, resource, sys
from mi_prt.asset import container
from mi_prt.errors import AssetError
from mi_prt.system.schema import Array
now = int(re.search(r"VmSize:\\s+(\\d+)", open("/proc/self/status").read())[1]) << 10
for path in sys.argv[1:]:
    if not os.fork():
        most = now + os.path.getsize(path) + (200 << 20)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        try:
            with container.opened(path) as stored:
                stored.check({"a": Array("f4", ("n",))})
                print("loaded", stored.array("a").sum(), os.path.basename(path), flush=True)
        except AssetError as error:
            print("refused", error, flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
"""
    paths = [str(tmp_path / name) for name in (*BOMBS, "inner", "array")]
    ran = subprocess.run([sys.executable, "-c", code, *paths], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-999:]
    lines = ran.stdout.splitlines()
    assert len(lines) == len(paths) and lines[-1] == "loaded 0.0 array"
    assert all(line.startswith(f"refused '{path}'") for path, line in zip(paths[:-1], lines))
