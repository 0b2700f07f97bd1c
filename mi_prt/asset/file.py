"""The asset as one file: a JSON header and arrays; docs/asset-format.md describes it field by
field.
"""

from pathlib import Path
from typing import Any

from ..errors import AssetError, SettingsError
from ..points.layout import LAYOUTS
from ..points.points import Points
from ..system.files import check_own, check_writable
from ..system.schema import (
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
from ..transport.transport import BOUNCES, TRANSPORTS
from . import container
from .provenance import path_from_file, path_in_file

_TEXTS = ("scene", "settings", "versions", "report")
_EMITTER = Record({"name": Text(), "kind": Text(), "distant": Flag()})
_LEFT_OUT = Record(
    {"what": Text(), "shapes": ListOf(Text()), "share": OneOf(Nothing(), Number(-1e30, 1e30))}
)
_SCENE = Record(
    {
        "kind": Text("file", "dict", "object"),
        "path": OneOf(Nothing(), Text()),
        "is_relative": Flag(),
        "parameters": MapOf(Text()),
        "hash": Text(),
        "appearance": Text(),
        "left_out": ListOf(_LEFT_OUT),
    }
)
_SETTINGS = Record({"bounces": OneOf(Nothing(), BOUNCES), "points": Text()}, others=Anything())
_HEADER = Record(
    {
        "scene": _SCENE,
        "settings": _SETTINGS,
        "versions": MapOf(Text()),
        "report": MapOf(Anything()),
        "emitters": ListOf(_EMITTER),
        "points": Record(
            {"layout": Text(), "surfaces": ListOf(MapOf(Anything())), "report": MapOf(Anything())}
        ),
        "transports": MapOf(MapOf(Anything())),
    }
)


def write(asset, path, folder=None, force=False):
    """Write an `Asset` to one file, all or nothing.

    Parameters
    ----------
    asset : Asset
    path : path
    folder : path, optional
        Where the file is until it is whole, see `replacing`.
    force : bool
        Whether to replace a file that is no asset.

    Raises
    ------
    SettingsError
        If the path cannot be written, for example because the disk is full.
    """
    check_writable(path)
    check_own(path, container.is_own, force)
    points = asset.points
    scene = asset.scene | {"path": path_in_file(asset.scene, path)}
    header = {name: getattr(asset, name) for name in _TEXTS} | {
        "scene": scene,
        "emitters": list(asset.emitters),
        "points": {
            "layout": points.layout.kind,
            "surfaces": list(points.surfaces),
            "report": points.report,
        },
        "transports": {kind: t.header() for kind, t in asset.transports.items()},
    }
    arrays = {f"points/{name}": getattr(points, name) for name in Points.SHAPES}
    arrays |= {f"layout/{name}": array for name, array in points.layout.arrays().items()}
    for kind, transport in asset.transports.items():
        arrays |= {f"transports/{kind}/{name}": a for name, a in transport.arrays().items()}
    container.write(path, header, arrays, folder)


def read(path) -> dict[str, Any]:
    """Read an asset.

    Parameters
    ----------
    path : path

    Returns
    -------
    dict
        The fields of `Asset`.

    Raises
    ------
    AssetError
        If it is missing, damaged, foreign, or of another format version.
    """
    with container.opened(path) as stored:
        try:
            fields = _fields(stored)
        except (ValueError, KeyError, TypeError, SettingsError) as error:
            raise AssetError(
                f"'{path}' is no sound asset: {' '.join(str(error).split())}"
            ) from None
    scene = fields["scene"]
    scene["path"] = path_from_file(scene["path"], path)
    return fields | {"path": Path(path).absolute()}


def _fields(stored):
    header = stored.header
    check(header, _HEADER, "header")
    if (header["scene"]["kind"] == "file") != (header["scene"]["path"] is not None):
        raise ValueError("a scene of a file has a path, and no other has")
    layout, schema = _schema(header)
    surfaces = tuple(header["points"]["surfaces"])
    check(list(surfaces), ListOf(layout.SURFACE), "points.surfaces")
    if not stored.check(schema, {"surfaces": len(surfaces)})["n"]:
        raise ValueError("it has no points")
    arrays = {name: stored.array(name) for name in schema if name in stored.names}

    def under(prefix):
        return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}

    points = Points(
        **under("points/"),
        layout=layout.from_arrays(under("layout/"), header["points"]["report"]),
        surfaces=surfaces,
        report=header["points"]["report"],
    )
    points.layout.check(points)
    transports = {
        kind: TRANSPORTS[kind].from_arrays(part, under(f"transports/{kind}/"), points)
        for kind, part in header["transports"].items()
    }
    texts = {name: header[name] for name in _TEXTS}
    emitters = tuple(header["emitters"])
    _check_emitters(emitters, transports)
    return {"points": points, "transports": transports, "emitters": emitters, **texts}


def _check_emitters(emitters, transports):
    """Names are unique, and lamps whose light is baked are among the local ones."""
    names = [emitter["name"] for emitter in emitters]
    if len(set(names)) < len(names):
        raise ValueError("emitters repeat a name")
    local = {emitter["name"] for emitter in emitters if not emitter["distant"]}
    if "own" in transports and not local.issuperset(transports["own"].names):
        raise ValueError("transports.own.lamps are no emitters of the scene")


def _schema(header):
    """The layout of points, and what each array of the file must be."""
    if not header["transports"]:
        raise ValueError("it holds no transport")
    layout = LAYOUTS[header["points"]["layout"]]
    schema = {f"points/{name}": array for name, array in Points.SHAPES.items()}
    schema |= {f"layout/{name}": array for name, array in layout.SHAPES.items()}
    for kind, part in header["transports"].items():
        transport = TRANSPORTS[kind]
        check(part, transport.header_spec(), f"transports.{kind}")
        for name, array in transport.shapes(part).items():
            schema[f"transports/{kind}/{name}"] = array.within(kind, shared=("n",))
    return layout, schema
