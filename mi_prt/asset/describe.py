"""What an asset holds."""

from html import escape
from pathlib import Path


def describe_asset(asset):
    """What an asset holds, as plain data.

    Returns
    -------
    dict
        points, transports{kind{…, storage of arrays in bytes}}, lights, ledger (known errors, the
        largest first, each with the knob that lowers it), scene, settings, versions, report, and
        the file's size in bytes.
    """
    ledger = sorted(asset.ledger(), key=lambda entry: -entry.value)
    return {
        "points": len(asset.points),
        "kind_of_points": asset.settings["points"],
        "buried_points": int(asset.buried.sum()),
        "transports": {
            kind: transport.summary() | {"report": transport.report}
            for kind, transport in asset.transports.items()
        },
        "lights": [dict(emitter) for emitter in asset.emitters],
        "ledger": [entry.as_dict() for entry in ledger],
        "bytes": asset.path.stat().st_size if asset.path else None,
        "scene": asset.scene,
        "settings": asset.settings,
        "versions": asset.versions,
        "report": asset.report | asset.points.report,
    }


def _shown(asset):
    """Name and value, both texts, of what is shown first."""
    place = asset.scene["path"]
    rows = [
        ("scene", Path(place).name if place else f"a {asset.scene['kind']} in memory"),
        ("points", f"{len(asset.points):,} {asset.settings['points']}"),
    ]
    rows += [(kind, transport.words) for kind, transport in asset.transports.items()]
    if asset.path:
        rows.append(("file", asset.path.name))
    return rows


def summary_line(asset):
    """One line of what an asset holds."""
    return f"<Asset {'; '.join(f'{name}: {value}' for name, value in _shown(asset))}>"


def summary_table(asset):
    """The same as a table of HTML."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td>{escape(value)}</td></tr>"
        for name, value in _shown(asset)
    )
    return f"<table><caption>mi_prt asset</caption>{rows}</table>"
