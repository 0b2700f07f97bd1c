"""Precomputed radiance transfer for Mitsuba 3.

>>> import mi_prt
>>> asset = mi_prt.precompute("scene.xml", directions="cubemap:32", coefficients=48)
>>> asset.save("scene.prt")
>>> light = mi_prt.EnvironmentMap("sky.exr").rotated(axis="y", degrees=30)
>>> mi_prt.load("scene.prt").relight(light)   # outgoing radiance at the points, (n, 3)

Importing this package chooses the LLVM that Dr.Jit will load and registers the integrator plugin `prt` with Mitsuba.
"""

from .system.llvm import select_llvm

select_llvm()  # before anything can load Dr.Jit: an LLVM that is too old would end the process

from .asset.asset import Asset  # noqa: E402
from .errors import (  # noqa: E402
    AssetError,
    InputError,
    LightError,
    PrtError,
    RuntimeSetupError,
    SceneError,
    SettingsError,
)
from .evaluate.compare import compare  # noqa: E402
from .lighting.environment import EnvironmentMap, LightWarning  # noqa: E402
from .lighting.light import DirectionalLight, Light  # noqa: E402
from .lighting.local_lights import AreaLight, PointLight, SpotLight  # noqa: E402
from .asset.meshless_asset import MeshlessAsset  # noqa: E402
from .asset.opening import load  # noqa: E402
from .precompute.precompute import precompute  # noqa: E402
from .output.relight import relight_to_file  # noqa: E402
from .render.integrator import register_integrator  # noqa: E402

__version__ = "0.4.0"
__all__ = [
    "AreaLight",
    "Asset",
    "AssetError",
    "DirectionalLight",
    "EnvironmentMap",
    "InputError",
    "Light",
    "LightError",
    "LightWarning",
    "MeshlessAsset",
    "PointLight",
    "PrtError",
    "RuntimeSetupError",
    "SceneError",
    "SettingsError",
    "SpotLight",
    "compare",
    "load",
    "precompute",
    "relight_to_file",
]

register_integrator()
