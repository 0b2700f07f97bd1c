"""Hostile asset files, made from good ones: mutant i of a seed is the same everywhere.

Knows the safetensors format and nothing of mi_prt.
"""

import json
import math
import os
import struct
from dataclasses import dataclass

import numpy as np

_CODES = (
    "BOOL u1 U8 u1 I8 i1 U16 <u2 I16 <i2 F16 <f2 U32 <u4 I32 <i4 F32 <f4 U64 <u8 I64 <i8 F64 <f8"
)
CODES = dict(zip(_CODES.split()[::2], _CODES.split()[1::2]))  # BOOL can hold what is no truth
OTHER_CODES = ["BF16", "F8_E5M2", "F99", "", "f4", "|O", None, 4, ["F32"], {"a": 1}]
# fmt: off
NUMBERS = [
    0, 1, 2, -1, 255, 65536, 2**31 - 1, 2**31, -(2**31), 2**32, 2**53 + 1, 2**63 - 1, 2**63,
    2**64 - 1, 2**64, -(2**63), -(2**63) - 1, 10**30, 10**400, 0.5, -0.5, -0.0, 1e9, 1e300, -1e308,
    5e-324, 3.0,
]
WORDS = [
    "", " ", "x", "x" * 70_000, "\0", "\n", "\x1b[31m", "\ud800", "é", "𝄞", "nan", "1e999", "-1",
    "%s%n", "{0.__class__}", "$(id)", "__class__", "__proto__", "null", "9" * 5000, "cubemap:0",
    "cubemap:99999999", "latlong:99999999x99999999", "halton:-3", "halton:1e9", "pca", "cpca", "sh",
    "haar", "haar-shared", "none", "vertices", "samples", "patches", "spacing", "distant", "own",
    "local", "total", "direct", "indirect", "file", "dict", "mesh",
]
PATHS = [
    "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", "../../../../etc/passwd", "~", ".",
    "//host/share/x.xml", "\\\\host\\share\\x.xml", "file:///etc/passwd", "http://127.0.0.1:9/x",
]
TURNS = [
    "truncated", "flipped", "field", "own", "entry", "layout", "own", "text",
    "field", "entry", "own", "flipped", "layout", "own", "entry", "own",
]
# fmt: on


@dataclass
class Parts:
    """A file taken apart: header without metadata, the metadata, the own header, the data."""

    table: dict
    metadata: dict
    own: dict
    data: bytes

    @classmethod
    def of(cls, content):
        (length,) = struct.unpack("<Q", content[:8])
        table = json.loads(content[8 : 8 + length])
        metadata = table.pop("__metadata__")
        return cls(table, metadata, json.loads(metadata["mi_prt"]), content[8 + length :])

    def join(self, table_text=None, own_text=None):
        """The file; of texts where a value does not do."""
        own = json.dumps(self.own) if own_text is None else own_text
        table = {"__metadata__": self.metadata | {"mi_prt": own}} | self.table
        text = (table_text or json.dumps(table)).encode("utf-8", "surrogatepass")
        text += b" " * (-len(text) % 8)
        return struct.pack("<Q", len(text)) + text + self.data

    def arrays(self):
        """Arrays by name, as (code, array)."""
        result = {}
        for name, entry in self.table.items():
            start, stop = entry["data_offsets"]
            values = np.frombuffer(self.data[start:stop], CODES[entry["dtype"]])
            result[name] = entry["dtype"], values.reshape(entry["shape"]).copy()
        return result

    def with_arrays(self, arrays):
        """The file of these arrays, in a header that is right."""
        table, blocks, end = {}, [], 0
        for name in sorted(arrays, key=lambda n: -arrays[n][1].itemsize):
            code, array = arrays[name]
            place = [end, end := end + array.nbytes]
            table[name] = {"dtype": code, "shape": [*array.shape], "data_offsets": place}
            blocks.append(array.tobytes())
        return Parts(table, self.metadata, self.own, b"".join(blocks)).join()


class Mutator:
    """Mutants of one file.

    Parameters
    ----------
    content : bytes
        Of a good file.
    traps : list of str
        Paths that nobody may open; they take the place of values.
    number : int
        Of the file, so that each gets mutants of its own.
    """

    def __init__(self, content, traps=(), number=0):
        self.content, self.traps, self.number = content, list(traps), number
        parts = Parts.of(content)
        self.own_sites = list(sites(parts.own))
        self.table_sites = list(sites(parts.table))
        self.names = sorted(parts.table)
        self.sizes = sorted({length for e in parts.table.values() for length in e["shape"]})
        self.texts = sorted(
            {v for path in self.own_sites if isinstance(v := at(parts.own, path), str)}
        )

    def make(self, seed, index):
        """Mutant `index`: its kind, what was done, and its bytes.

        Kinds take turns, and those of fields and arrays go through all of them in turn.
        """
        rng = np.random.default_rng([seed, self.number, index])
        turn, kind = divmod(index, len(TURNS))
        kind = TURNS[kind]
        if kind == "text" and index % 1000 >= 1000 - len(TURNS):
            kind = "bomb"
        turn = turn * TURNS.count(kind) + TURNS[: index % len(TURNS)].count(kind)
        what, content = getattr(self, kind)(rng, turn)
        return kind, what, content

    # --- bytes ------------------------------------------------------------------------------------

    def truncated(self, rng, turn):
        ends = [0, 7, 8, 9, self.start - 1, self.start, len(self.content) - 1]
        length = ends[turn] if turn < len(ends) else int(rng.integers(len(self.content)))
        if turn % 5 == 4:
            more = rng.bytes(int(rng.integers(1, 1000)))
            return f"{len(more)} bytes more", self.content + more
        return f"to {length} bytes", self.content[:length]

    @property
    def start(self):
        """Where the arrays begin."""
        return 8 + int.from_bytes(self.content[:8], "little")

    def flipped(self, rng, turn):
        """Bytes of the length, of the header, of the data, of all."""
        ends = (0, 8, self.start, len(self.content))
        first, last = [ends[:2], ends[1:3], ends[2:], ends[::2]][turn % 4]
        content = bytearray(self.content)
        places = rng.integers(first, max(last, first + 1), rng.integers(1, 9)).clip(
            0, len(content) - 1
        )
        for place in places:
            content[place] ^= int(rng.integers(1, 256))
        return f"bytes {sorted(places.tolist())}", bytes(content)

    # --- header -----------------------------------------------------------------------------------

    def field(self, rng, turn):
        """One value of the header."""
        parts = Parts.of(self.content)
        if turn % 20 == 19:
            key = _pick(rng, ["format", "format_version", "mi_prt", "more"])
            parts.metadata[key] = value = _pick(
                rng, [*WORDS, *NUMBERS, "4", "5", "6", "05", [], {}]
            )
            if key == "mi_prt":
                return f"{key} = {value!r}", parts.join(own_text=value)
            return f"{key} = {value!r}", parts.join()
        path = self.table_sites[turn % len(self.table_sites)]
        what = self.change(rng, parts.table, path, [*CODES, *OTHER_CODES])
        return what, parts.join()

    def own(self, rng, turn):
        """One value of the own header."""
        parts = Parts.of(self.content)
        what = self.change(rng, parts.own, self.own_sites[turn % len(self.own_sites)], self.texts)
        return what, parts.join()

    def change(self, rng, root, path, more):
        """Change a value in place; returns what was done."""
        parent, key = at(root, path[:-1]), path[-1]
        value = parent[key]
        where = ".".join(map(str, path))
        operation = int(rng.integers(10))
        if operation == 0:
            del parent[key]
            return f"{where} deleted"
        if operation == 1 and isinstance(value, dict):
            name = _pick(rng, ["", "more", "__class__", "x" * 1000, "\x1b[31m", "\ud800", *value])
            value[name] = _pick(rng, [None, 1, "x", {}, *value.values()])
            return f"{where}.{name!r} added"
        if operation == 2:
            parent[key] = changed = _nested(
                int(rng.choice([1, 30, 40, 200])), rng.random() < 0.5, value
            )
            return f"{where} nested: {str(changed)[:40]}"
        if operation <= 5 and (near := _near(value)):
            parent[key] = changed = _pick(rng, near)
            return f"{where} = {str(changed)[:80]}"
        lists = [[], {}, [[]], [None], {"": None}, [1] * 10_000, True, False, None]
        pools = [NUMBERS, WORDS, [*PATHS, *self.traps], lists, [*more, *self.sizes]]
        parent[key] = changed = _pick(rng, pools[int(rng.integers(len(pools)))])
        return f"{where} = {str(changed)[:80]!r}"

    def text(self, rng, turn):
        """What only a text can say: repeated keys, NaN, depth, bytes that are no text."""
        parts = Parts.of(self.content)
        own = json.dumps(parts.own)
        table = json.dumps({"__metadata__": parts.metadata | {"mi_prt": own}} | parts.table)
        inside = turn % 2
        text = own if inside else table
        colons = [i for i, c in enumerate(text) if c == ":"]
        place = int(_pick(rng, colons)) + 1
        tokens = ["NaN", "-Infinity", "1e999", "9" * 30, "9" * 5000, "[" * 10_000, '{"a":' * 10_000]
        tokens += [
            "[" * 500 + "]" * 500,
            '"\\ud800"',
            '"\\u0000"',
            "01",
            "0x1",
            "'a'",
            "",
            "\0",
            "/**/1",
        ]
        token = _pick(rng, tokens)
        operation = turn // 2 % 4
        if operation == 0:  # a token before a value
            text = text[:place] + token + text[place:]
        elif operation == 1:  # a token in the place of a value
            end = min(i for i in (text.find(c, place) for c in ",}]") if i > 0)
            text = text[:place] + token + text[end:]
        elif operation == 2:  # a field twice
            text = "{" + _pick(rng, text[1:-1].split(", ")) + ", " + text[1:]
        else:  # what is around it
            text = _pick(
                rng, ["\ufeff" + text, text + "{}", text + "\0", "[" + text + "]", text[:-1]]
            )
        what = f"{'own' if inside else 'table'} {operation} {token[:9]!r}"
        return what, parts.join(own_text=text) if inside else parts.join(table_text=text)

    def bomb(self, rng, turn):
        """A header that is large: up to the limit of the format, 100 MB."""
        unit = _pick(rng, ["[],", '{"":0},', "1.5,", '"ab",'])
        text = '{"a":[' + unit * (int(_pick(rng, [4_000_000, 5_000_000])) // len(unit)) + "0]}"
        parts = Parts.of(self.content)
        what = f"{len(text)} bytes of {unit}"
        return what, parts.join(own_text=text) if turn % 2 else parts.join(table_text=text)

    # --- arrays -----------------------------------------------------------------------------------

    def layout(self, rng, turn):
        """Arrays of another dtype, shape, number or name in a header that is right in itself."""
        parts = Parts.of(self.content)
        arrays = parts.arrays()
        name = self.names[turn % len(self.names)]
        code, array = arrays[name]
        operation = int(rng.integers(8))
        if operation == 0:
            del arrays[name]
        elif operation == 1:  # the same bytes, read otherwise
            same = [c for c in CODES if np.dtype(CODES[c]).itemsize == array.itemsize]
            arrays[name] = _pick(rng, same), array
        elif operation == 2:  # the same values of another dtype
            other = _pick(rng, list(CODES))
            with np.errstate(all="ignore"):
                arrays[name] = other, array.astype(CODES[other])
        elif operation == 3:  # another shape of the same bytes
            n = array.size
            shapes = [(n,), (n, 1), (1, n), array.shape[::-1], (1, *array.shape), (*array.shape, 1)]
            arrays[name] = code, array.reshape(_pick(rng, shapes))
        elif operation == 4 and array.ndim:  # rows or columns less or more
            axis = int(rng.integers(array.ndim))
            count = int(_pick(rng, [0, 1, array.shape[axis] - 1, array.shape[axis] + 1]))
            index = np.arange(max(count, 0)) % max(array.shape[axis], 1)
            arrays[name] = code, array.take(index, axis) if array.size else array
        elif operation == 5:
            odd = ["", "more", "../../x", "__class__", "x" * 9999, "\x1b[31m", *self.names]
            arrays[_pick(rng, odd)] = arrays[name] if rng.random() < 0.5 else arrays.pop(name)
        elif operation == 6:  # two arrays change places
            other = _pick(rng, self.names)
            arrays[name], arrays[other] = arrays[other], arrays[name]
        else:  # entries shuffled
            arrays[name] = code, rng.permutation(array.ravel()).reshape(array.shape)
        return f"{name} {operation}", parts.with_arrays(arrays)

    def entry(self, rng, turn):
        """One entry of an array, some, or all, set to an extreme."""
        parts = Parts.of(self.content)
        name = self.names[turn % len(self.names)]
        entry = parts.table[name]
        start, stop = entry["data_offsets"]
        array = np.frombuffer(parts.data[start:stop], CODES[entry["dtype"]]).copy()
        if not array.size:
            return f"{name} is empty", self.content
        if array.dtype.kind == "f":
            top = float(np.finfo(array.dtype).max)
            extremes = [np.nan, np.inf, -np.inf, top, -top, 1 / top, -1, 0, 1e9, -1e9, 1e-30]
        else:
            info = np.iinfo(array.dtype)
            near = [n + d for n in (0, *self.sizes, math.prod(self.sizes)) for d in (-1, 0, 1)]
            extremes = [*near, info.min, info.max, 2**31 - 1, 2**31, -(2**31), 2**15, 2**16, 2**32]
            extremes = [v for v in extremes if info.min <= v <= info.max] or [info.max]
        value = _pick(rng, extremes)
        count = _pick(rng, [1, 1, 1, 2, array.size])
        places = rng.choice(array.size, min(int(count), array.size), replace=False)
        with np.errstate(over="ignore"):
            array[places] = value
        parts.data = parts.data[:start] + array.tobytes() + parts.data[stop:]
        return f"{name}{places[:3].tolist()} = {value}", parts.join()


def sites(value, path=()):
    """Paths of all values below a JSON value; of long lists the first, one within and the last."""
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        keys = sorted({0, len(value) // 2, len(value) - 1}) if value else []
    else:
        keys = []
    for key in keys:
        yield (*path, key)
        yield from sites(value[key], (*path, key))


def at(value, path):
    for key in path:
        value = value[key]
    return value


def _pick(rng, choices):
    return choices[int(rng.integers(len(choices)))]


def _nested(depth, objects, value):
    for _ in range(depth):
        value = {"a": value} if objects else [value]
    return value


def _near(value):
    """Values like a value, but not it."""
    if isinstance(value, bool) or value is None:
        return [not value, int(bool(value)), str(value)]
    if isinstance(value, int | float):
        return [value + 1, value - 1, -value, value * 1000, value * 2**20, float(value), str(value)]
    if isinstance(value, str):
        return [value[1:], value[:-1], value + "x", value.upper(), value * 2, [value], len(value)]
    if isinstance(value, list):
        return [value[1:], value[:-1], value * 2, value[::-1], [], dict(enumerate(value))]
    return [list(value), list(value.values()), {}, str(value)]


def make_traps(folder):
    """Things in a folder that nobody may open: a file, a scene, a fifo."""
    names = [os.path.join(folder, name) for name in ("trap.txt", "trap.xml", "trap.fifo")]
    for name in names[:2]:
        with open(name, "w") as file:
            file.write("<scene version='3.0.0'/>\n")
    os.mkfifo(names[2])
    return names
