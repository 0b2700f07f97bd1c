"""How pyrender opens OpenGL without a screen."""

import importlib
import os
import sys
from ctypes.util import find_library
from functools import cache
from types import ModuleType

from ..errors import RuntimeSetupError
from .llvm import install_command

RASTER_PLATFORMS = ("osmesa", "egl")
"""Values of `PYOPENGL_PLATFORM` that draw without a screen, the preferred one first."""

_RASTER_PACKAGES = {
    "apt-get": "libosmesa6",
    "dnf": "mesa-libEGL mesa-dri-drivers libglvnd-opengl",
    "zypper": "Mesa-libEGL1 Mesa-dri libglvnd",
    "pacman": "mesa libglvnd",
}


def raster_platform() -> str:
    """Choose how pyrender opens OpenGL without a screen, by setting `PYOPENGL_PLATFORM`; call it
    before using pyrender.

    A variable that is already set is kept. Else OSMesa is taken if its library is installed,
    because it needs no driver and draws the same everywhere, else EGL.

    Returns
    -------
    str
        "osmesa" or "egl".

    Raises
    ------
    RuntimeSetupError
        If neither library is installed, if the variable names another platform or one that is not
        installed, or if PyOpenGL was imported before with another platform.
    """
    installed = [name for name in RASTER_PLATFORMS if _installed(name)]
    chosen = os.environ.get("PYOPENGL_PLATFORM") or next(iter(installed), None)
    if chosen is None:
        raise RuntimeSetupError(
            "neither OSMesa nor EGL is installed, one of which draws without a screen; install it "
            f"with `{raster_install_command()}`"
        )
    if chosen not in installed:
        raise RuntimeSetupError(
            f"PYOPENGL_PLATFORM is {chosen}, but what draws without a screen here is "
            f"{' or '.join(installed) or 'nothing'}; unset it, or install a platform with "
            f"`{raster_install_command()}`"
        )
    loaded = sys.modules.get("OpenGL.platform")
    name = type(loaded.PLATFORM).__name__ if loaded else ""
    if loaded and not name.lower().startswith(chosen):
        raise RuntimeSetupError(
            f"PyOpenGL was imported before mi_prt and took {name}, but {chosen} is needed; import "
            f"OpenGL and pyrender after mi_prt, or start with PYOPENGL_PLATFORM={chosen}"
        )
    os.environ["PYOPENGL_PLATFORM"] = chosen
    return chosen


def pyrender() -> ModuleType:
    """The `pyrender` module, ready to draw without a screen on `raster_platform`.

    Its window class is left out: importing it needs X11 libraries, which servers lack and drawing
    off screen does not use.

    Raises
    ------
    RuntimeSetupError
        As `raster_platform` does.
    """
    raster_platform()
    if "pyrender" not in sys.modules:
        viewer = ModuleType("pyrender.viewer")
        viewer.Viewer = None  # pyright: ignore[reportAttributeAccessIssue]
        sys.modules["pyrender.viewer"] = viewer
    return importlib.import_module("pyrender")


def raster_install_command() -> str:
    """What to type to install a library that draws without a screen."""
    return install_command(_RASTER_PACKAGES)


@cache
def _installed(platform: str) -> bool:
    """Whether a raster platform's libraries are there; asked once, because each takes a process to
    find.
    """
    if platform == "osmesa":
        return find_library("OSMesa") is not None
    return find_library("EGL") is not None and any(map(find_library, ("OpenGL", "GL")))
