"""The check of JSON values against a specification, and JSON that reads back exactly."""

import pytest

from mi_prt.system import plain_json
from mi_prt.system.schema import (
    Anything,
    Flag,
    ListOf,
    MapOf,
    Nothing,
    Number,
    OneOf,
    Record,
    Text,
    check,
)

SPEC = Record(
    {
        "kind": Text("pca", "sh"),
        "name": OneOf(Nothing(), Text()),
        "count": Number(0, 10, whole=True),
        "edge": Number(0),
        "on": Flag(),
        "point": ListOf(Number(), 3),
        "lamps": MapOf(ListOf(Text())),
        "report": Anything(),
    },
    optional=("report", "name"),
)
GOOD = {"kind": "sh", "name": None, "count": 3, "edge": 0.5, "on": True, "point": [1, 2.5, -3],
        "lamps": {"a": ["x"], "b": []}, "report": [{}]}  # fmt: skip


def test_json_that_is_right():
    assert check(GOOD, SPEC) is GOOD
    check({k: v for k, v in GOOD.items() if k not in ("report", "name")} | {"edge": 7}, SPEC)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "haar"}, "header.kind is 'haar' instead of one of pca, sh"),
        ({"kind": []}, r"header.kind is \[\]"),
        ({"kind": "x" * 9999}, "header.kind is 'x{59} instead"),
        ({"name": 3}, "header.name is 3 instead of null; or header.name is 3 instead of a text"),
        ({"count": 3.0}, "header.count is 3.0 instead of a whole number from 0 to 10"),
        ({"count": True}, "header.count is True"),
        ({"count": 11}, "header.count is 11"),
        ({"count": -1}, "header.count is -1"),
        ({"edge": float("nan")}, "header.edge is nan"),
        ({"edge": float("inf")}, "header.edge is inf"),
        ({"edge": False}, "header.edge is False"),
        ({"edge": None}, "header.edge is None"),
        ({"on": 1}, "header.on is 1 instead of true or false"),
        ({"point": [1, 2]}, r"header.point is \[1, 2\] instead of a list of 3"),
        ({"point": [1, 2, "3"]}, r"header.point\[2\] is '3'"),
        ({"point": {"0": 1}}, "header.point is"),
        ({"lamps": {"a": ["x", 4]}}, r"header.lamps.a\[1\] is 4 instead of a text"),
        ({"lamps": {"\x1b": 3}}, r"header.lamps.\\x1b is 3 instead of a list"),
        ({"lamps": []}, r"header.lamps is \[\] instead of an object"),
        ({"more": 1}, "header has the unknown field 'more'"),
        ({"edge": ...}, "header.edge is missing"),
    ],
    ids=lambda x: str(x)[:30],
)
def test_json_that_is_wrong(change, message):
    """The message gives the path of the value; hostile texts are cut and quoted."""
    value = {k: v for k, v in (GOOD | change).items() if v is not ...}
    with pytest.raises(ValueError, match=message):
        check(value, SPEC)
    with pytest.raises(ValueError):
        check([value], SPEC)


def test_writing_json_is_exact():
    """Floats keep all their bits, keys are sorted, nothing but ASCII."""
    value = {"b": 0.1 + 0.2, "a": "é", "c": [5e-324, -0.0]}
    assert plain_json.dumps(value) == '{"a":"\\u00e9","b":0.30000000000000004,"c":[5e-324,-0.0]}'
    assert plain_json.loads(plain_json.dumps(value)) == value
