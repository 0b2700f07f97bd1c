"""What a scene requires, or an asset holds."""

from pathlib import Path

from ..asset.asset import Asset, load
from ..asset.container import is_asset
from ..asset.describe import describe_asset
from .forecast import describe


def info(source, parameters=None, **settings):
    """What precomputing a scene requires, uses, leaves out and costs; or what an asset holds.

    Parameters
    ----------
    source : path, dict, mi.Scene, or Asset
        Of a path the file tells whether it is a scene or an asset.
    parameters : dict, optional
        Values for `<default>` parameters of a scene.
    **settings
        Fields of `Settings`, of a scene.

    Returns
    -------
    dict
        See `describe_asset` of an asset, else `describe`.

    Raises
    ------
    SceneError, AssetError, SettingsError
    """
    if isinstance(source, Asset):
        return describe_asset(source)
    if isinstance(source, str | Path) and is_asset(source):
        return describe_asset(load(source))
    return describe(source, parameters, **settings)
