"""Precomputed radiance transfer for Mitsuba 3.

>>> import mi_prt
>>> asset = mi_prt.precompute("scene.xml", directions="cubemap:32", coefficients=48)
>>> asset.save("scene.prt")
>>> light = mi_prt.EnvironmentMap("sky.exr").rotated(axis="y", degrees=30)
>>> mi_prt.load("scene.prt").relight(light)   # outgoing radiance at the points, (n, 3)

Importing this package chooses the LLVM that Dr.Jit will load and registers the integrator plugin
`prt` with Mitsuba.
"""

from .system.starting import end_quietly_when_interrupted

end_quietly_when_interrupted()  # in the program alone, until its main() takes over

from .system.llvm import select_llvm

select_llvm()  # before anything can load Dr.Jit: an LLVM that is too old would end the process

from .asset.asset import Asset, load
from .errors import (
    AssetError,
    InputError,
    LightError,
    PrtError,
    RuntimeSetupError,
    SceneError,
    SettingsError,
)
from .evaluate.compare import compare
from .lighting.area import AreaLight
from .lighting.directional import DirectionalLight
from .lighting.environment import EnvironmentMap, LightWarning
from .lighting.light import Light
from .lighting.own_light import SceneLight
from .lighting.point import PointLight
from .lighting.spot import SpotLight
from .output.film import LightPath
from .output.moving import animate
from .output.relight import relight_to_file
from .precompute.info import info
from .precompute.precompute import precompute
from .precompute.settings import Settings
from .render.integrator import register_integrator
from .scene.camera import Camera
from .scene.scene import open_scene

__version__ = "0.5.0"
__all__ = [
    "AreaLight",
    "Asset",
    "AssetError",
    "Camera",
    "DirectionalLight",
    "EnvironmentMap",
    "InputError",
    "Light",
    "LightError",
    "LightPath",
    "LightWarning",
    "PointLight",
    "PrtError",
    "RuntimeSetupError",
    "SceneError",
    "SceneLight",
    "Settings",
    "SettingsError",
    "SpotLight",
    "animate",
    "compare",
    "info",
    "load",
    "open_scene",
    "precompute",
    "relight_to_file",
]

register_integrator()
