"""The asset as one file: a JSON header and arrays; docs/asset-format.md describes it field by
field.
"""

from pathlib import Path
from typing import Any

from ..errors import AssetError, SettingsError
from ..points.layout import LAYOUTS
from ..points.points import Points
from ..system.schema import Anything, Flag, ListOf, MapOf, Record, Text, check
from ..transport.transport import TRANSPORTS
from . import container

_TEXTS = ("scene", "settings", "versions", "report")
_EMITTER = Record({"name": Text(), "kind": Text(), "distant": Flag()})
_HEADER = Record(
    {
        "scene": Record(
            {
                "kind": Text(),
                "path": Anything(),
                "parameters": MapOf(Text()),
                "hash": Text(),
                "appearance": Text(),
                "left_out": ListOf(MapOf(Anything())),
            }
        ),
        "settings": MapOf(Anything()),
        "versions": MapOf(Text()),
        "report": MapOf(Anything()),
        "emitters": ListOf(_EMITTER),
        "points": Record(
            {"layout": Text(), "surfaces": ListOf(MapOf(Anything())), "report": MapOf(Anything())}
        ),
        "transports": MapOf(MapOf(Anything())),
    }
)


def write(asset, path, folder=None):
    """Write an `Asset` to one file, all or nothing.

    Parameters
    ----------
    asset : Asset
    path : path
    folder : path, optional
        Where the file is until it is whole, see `replacing`.

    Raises
    ------
    SettingsError
        If the path cannot be written, for example because the disk is full.
    """
    points = asset.points
    header = {name: getattr(asset, name) for name in _TEXTS} | {
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
            return _fields(stored) | {"path": Path(path).absolute()}
        except (ValueError, KeyError, TypeError, SettingsError) as error:
            raise AssetError(
                f"'{path}' is no sound asset: {' '.join(str(error).split())}"
            ) from None


def _fields(stored):
    header = stored.header
    check(header, _HEADER, "header")
    layout, schema = _schema(header)
    surfaces = tuple(header["points"]["surfaces"])
    sizes = stored.check(schema, {"surfaces": len(surfaces)})
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
    assert sizes["n"] == len(points)
    texts = {name: header[name] for name in _TEXTS}
    emitters = tuple(header["emitters"])
    return {"points": points, "transports": transports, "emitters": emitters, **texts}


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
