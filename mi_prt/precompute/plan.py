"""What a scene calls for: which points, and which transports, each with its reason."""

from dataclasses import dataclass
from typing import Any

from ..errors import SettingsError
from ..lighting.from_mitsuba import check_distant
from .job import BUILDERS
from .settings import BY_NAME, TRANSPORTS, Settings


@dataclass(frozen=True)
class Plan:
    """What will be precomputed.

    Parameters
    ----------
    settings : Settings
        With `points` and `transports` chosen.
    reasons : dict
        Why, by the name of the setting.
    """

    settings: Any
    reasons: dict

    @property
    def transports(self):
        """Kinds of transport, in the order in which they are built."""
        return tuple(self.settings.transports.split(","))


def make_plan(scene, given):
    """Choose what is left to the scene, and refuse settings that mean nothing then.

    Parameters
    ----------
    scene : Scene
    given : dict
        Settings that were asked for, by name.

    Returns
    -------
    Plan

    Raises
    ------
    SettingsError
        If a setting is unknown, out of range, or of points or transports that will not be there.
    LightError
        If distant light of the scene cannot be used.
    """
    unknown = [name for name in given if name not in BY_NAME]
    if unknown:
        raise SettingsError(f"'{unknown[0]}' is no setting: use {', '.join(BY_NAME)}")
    asked = Settings(**given)
    transports, reasons = _transports(scene, asked, given)
    if "distant" in transports:
        check_distant(scene)
    points, reasons["points"] = _points(scene, asked, given, transports)
    groups = {"general", points, *transports}
    for name in given:
        group = BY_NAME[name].group
        if group not in groups and given[name] != BY_NAME[name].default:
            raise SettingsError(_foreign(name, group, points, transports))
    chosen = dict(given) | {"points": points, "transports": ",".join(transports)}
    return Plan(Settings(**chosen), reasons)


def _transports(scene, asked, given):
    """Kinds of transport, and the reasons."""
    if asked.transports != "auto":
        kinds = asked.transports.split(",")
        if "own" in kinds and not scene.local_emitters:
            raise SettingsError(
                "transports own: the scene has no lamps of its own (area, point, spot): leave own"
                " out (--transports)"
            )
        return kinds, {"transports": "as asked"}
    why = {kind: BUILDERS[kind].wanted(scene, set(given)) for kind in TRANSPORTS}
    kinds = [kind for kind in TRANSPORTS if why[kind]]
    return kinds, {"transports": "; ".join(f"{kind}: {why[kind]}" for kind in kinds)}


def _points(scene, asked, given, transports):
    """Kind of points, and the reason."""
    if asked.points != "auto":
        return asked.points, "as asked"
    for name in given:
        if BY_NAME[name].group in ("vertices", "samples"):
            return BY_NAME[name].group, f"{name} was given"
    if "own" in transports or "local" in transports:
        return "samples", (
            "the scene has lamps, as rooms have: points spread evenly over what light can reach"
            " carry reflections between walls better than vertices of small things"
        )
    return "vertices", "light comes from afar: vertices show edges of shadows and small things best"


def _foreign(name, group, points, transports):
    option = "--" + name.replace("_", "-")
    if group in ("vertices", "samples"):
        return f"{name} ({option}) is a setting of points {group}, and these are {points}"
    wanted = ",".join(kind for kind in TRANSPORTS if kind in (*transports, group))
    return (
        f"{name} ({option}) is a setting of the transport {group}, and what is built is"
        f" {', '.join(transports)}: leave it out, or ask for transports {wanted} (--transports)"
    )
