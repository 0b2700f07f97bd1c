"""Formats of relit files by the ending of their names."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from ..errors import SettingsError
from ..system.files import is_marked
from ..system.registry import Registry

FORMATS = Registry("output", "mi_prt.output")


@dataclass(frozen=True, eq=False)
class Relit:
    """What a format writes.

    Parameters
    ----------
    asset : Asset
    irradiance : (n, 3)
        W/m² at the asset's points.
    radiance : (n, 3)
        W/(m²·sr) that leaves them.
    exposure : float
        Factor for display.
    image : (h, w, 3) or None
        Linear radiance as a sensor sees it, for formats that are pictures.
    """

    asset: Any
    irradiance: Any
    radiance: Any
    exposure: float
    image: Any = None


class Format(ABC):
    """A kind of file.

    Attributes
    ----------
    kind : str
        How names of such files end, such as ".exr".
    is_picture : bool
        Whether it shows what a sensor sees.
    """

    kind: ClassVar[str]
    is_picture: ClassVar[bool] = False

    @classmethod
    def is_own(cls, path):
        """Whether a file of such a name was written by this program, and may be replaced: by
        default, whether it holds `MARK` (mi_prt.system.files).
        """
        return is_marked(path)

    @classmethod
    @abstractmethod
    def write(cls, path, relit):
        """Write a file, all or nothing.

        Parameters
        ----------
        path : path
        relit : Relit

        Raises
        ------
        SettingsError
            If the path cannot be written.
        """


def format_of(path):
    """The format of a file's name.

    Raises
    ------
    SettingsError
        If there is none of its ending.
    """
    ending = Path(path).suffix.lower()
    if ending not in FORMATS:
        raise SettingsError(f"output '{path}' must end in {', '.join(FORMATS)}")
    return FORMATS[ending]
