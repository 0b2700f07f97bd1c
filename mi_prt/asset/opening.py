"""Opening assets of any kind."""

from pathlib import Path

from . import asset_file, container, meshless_file
from .asset import Asset
from .meshless_asset import MeshlessAsset

_KINDS = {"distant": (Asset, asset_file), "local": (MeshlessAsset, meshless_file)}


def load(path):
    """Open an asset.

    Parameters
    ----------
    path : path

    Returns
    -------
    Asset or MeshlessAsset
        For distant light, or for local lights.

    Raises
    ------
    AssetError
        If the file is missing, truncated, no asset, or of a format version this program does not
        know.
    """
    with container.opened(path) as (file, transport):
        kind, layout = _KINDS[transport]
        return kind(**layout.read(file, Path(path)))
