"""What an asset holds."""


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
