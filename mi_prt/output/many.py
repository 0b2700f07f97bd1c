"""One asset under several maps, seen by several sensors."""

from collections import Counter
from pathlib import Path

from ..asset.provenance import open_scene_of
from ..errors import LightError, SettingsError
from ..lighting.environment import EnvironmentMap
from ..lighting.map_file import ENDINGS
from ..render.rendered import check_picture
from .formats import format_of
from .relight import relight_to_file

ALL = "all"  # of the scene's sensors


def map_files(paths):
    """Files of environment maps from paths of files and folders; of these, all maps by name.

    Raises
    ------
    LightError
        If a folder holds none, or cannot be read.
    """
    found = []
    for path in map(Path, paths):
        if not path.is_dir():
            found.append(path)
            continue
        try:
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS)
        except OSError as error:
            raise LightError(f"folder '{path}' cannot be read: {error.strerror}") from None
        if not inside:
            raise LightError(
                f"folder '{path}' holds no environment map: maps end in {', '.join(ENDINGS)}"
            )
        found += inside
    return found


def relight_many(asset, pattern, maps=(), sensors=(0,), light=None, scene=None, **shown):
    """Relight an asset under each of several maps, as each of several sensors sees it.

    >>> relight_many(asset, "out/{map}_{sensor}.png", ["skies", "city.exr"], "all")

    Parameters
    ----------
    asset : Asset
    pattern : path
        Of the files, with {map} (the map's name without its ending) where there are several maps,
        and {sensor} (its index) where there are several sensors.
    maps : sequence of paths
        Files, and folders with files. None: `light` alone.
    sensors : sequence of int or Camera, or 'all'
    light : list, optional
        What else shines, in all files.
    scene : path, dict or mi.Scene, optional
    **shown
        Further arguments of `relight_to_file`.

    Returns
    -------
    list of dict
        For each file: file, map, sensor, and what `relight_to_file` returns.

    Raises
    ------
    SettingsError
        If the pattern lacks a place, or two files would be one.
    LightError, SceneError
    """
    is_picture = format_of(pattern).is_picture
    check_picture(shown.get("size"), spp=shown.get("spp", 1))
    maps = map_files(maps) or [None]
    count = 1
    if is_picture:
        scene = open_scene_of(asset, scene)
        count = max(len(scene.mi_scene.sensors()), 1)
    if sensors == ALL:
        sensors = range(count)
    files = _names(str(pattern), maps, sensors)
    told = []
    for number, file in enumerate(maps):
        shining = ([] if file is None else [EnvironmentMap(file)]) + list(light or [])
        for index, sensor in enumerate(sensors):
            output = files[number * len(sensors) + index]
            written = relight_to_file(
                asset, output, shining or None, scene=scene, sensor=sensor, **shown
            )
            name = None if file is None else str(file)
            told.append({"file": output, "map": name, "sensor": index} | written)
    return told


def _names(pattern, maps, sensors):
    """A file for each map and sensor."""
    for what, several in (("map", len(maps) > 1), ("sensor", len(sensors) > 1)):
        if several and f"{{{what}}}" not in pattern:
            path = Path(pattern)
            shown = path.with_name(f"{path.stem}_{{{what}}}{path.suffix}")
            raise SettingsError(
                f"output '{pattern}' names one file, and there are several {what}s: give it a place"
                f" for the {what}, like '{shown}'"
            )
    names = [
        pattern.replace("{map}", file.stem if file else "own").replace("{sensor}", str(index))
        for file in maps
        for index in range(len(sensors))
    ]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SettingsError(f"two maps would both be written to '{twice[0]}': rename one of them")
    return names
