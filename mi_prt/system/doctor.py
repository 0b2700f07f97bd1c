"""Examination of the machine: what mi_prt needs, what is there, and what to type where something is
missing.

Whatever could end the process (an unusable LLVM, an OpenGL driver) runs in another one, with a time
limit.
"""

import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from packaging.requirements import Requirement

from . import llvm, opengl, runtime

TIME_LIMIT = 120
"""Seconds after which a probe counts as failed."""

# The path integrator is what an unusable LLVM cannot compile.
_RAYS_PROBE = """
import json
from mi_prt.system import runtime
mi = runtime.mitsuba()
import drjit as dr
film = {"type": "hdrfilm", "width": 4, "height": 4}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"},
                      "light": {"type": "constant"}, "sphere": {"type": "sphere"},
                      "sensor": {"type": "perspective", "film": film}})
hit = scene.ray_intersect(mi.Ray3f([0, 0, 5], [0, 0, -1]))
mi.render(scene, spp=1).numpy()
print(json.dumps({"variant": mi.variant(), "distance": float(hit.t[0]),
                  "threads": runtime.thread_count(), "embree": bool(mi.MI_ENABLE_EMBREE),
                  "gpu": bool(dr.has_backend(dr.JitBackend.CUDA)), "optix": runtime.cuda_usable(),
                  "llvm": runtime.versions()["llvm"]}))
"""

_RASTER_PROBE = """
import json
from mi_prt.system import opengl
pyrender = opengl.pyrender()
renderer = pyrender.OffscreenRenderer(16, 16)
from OpenGL.GL import GL_RENDERER, glGetString
driver = glGetString(GL_RENDERER).decode()
scene = pyrender.Scene(bg_color=[1.0, 1.0, 1.0, 1.0])
scene.add(pyrender.PerspectiveCamera(yfov=1.0))
color, _ = renderer.render(scene)
print(json.dumps({"platform": opengl.raster_platform(), "driver": driver,
                  "background": int(color.min())}))
"""


@dataclass(frozen=True)
class Check:
    """One thing examined.

    Parameters
    ----------
    name : str
        What was examined, in a word or two.
    status : str
        "ok", "warning" (works, but less than it could) or "fault" (does not work).
    value : str
        What was found.
    remedy : str or None
        What to do about it; every fault has one.
    """

    name: str
    status: str
    value: str
    remedy: str | None = None


def examine() -> list[Check]:
    """Examine the machine; takes a few seconds and raises nothing.

    Returns
    -------
    list of Check
        Python, each package, LLVM, rays (variant, Embree, threads, CUDA) and raster.
    """
    rays, complaint = _probe(_RAYS_PROBE)
    checks = [
        Check("python", "ok", f"{platform.python_version()} ({sys.executable})"),
        Check("mi_prt", "ok", runtime.package_version("mi_prt")),
    ]
    checks += [_package(requirement) for requirement in _requirements()]
    checks += [_llvm(rays), _other_llvm(), _rays(rays, complaint)]
    if rays:
        checks += [_threads(rays), _embree(rays), _cuda(rays)]
    return [*checks, check_raster()]


def check_rays() -> Check:
    """Whether Mitsuba traces a ray and renders with the path integrator in the variant that mi_prt
    chooses.
    """
    return _rays(*_probe(_RAYS_PROBE))


def check_raster() -> Check:
    """Whether pyrender draws without a screen on the platform that mi_prt chooses."""
    found, complaint = _probe(_RASTER_PROBE)
    if not found:
        return _fault(
            "raster",
            complaint,
            f"install a software renderer: `{opengl.raster_install_command()}`",
        )
    value = f"{found['platform']}: {found['driver']}"
    if found["background"] != 255:
        return Check(
            "raster",
            "fault",
            f"{value} draws white as {found['background']} of 255",
            "start with PYOPENGL_PLATFORM=osmesa or PYOPENGL_PLATFORM=egl, whichever is not used"
            " here",
        )
    return Check("raster", "ok", value)


def as_dict(checks: list[Check]) -> dict:
    """Checks as data for JSON.

    Returns
    -------
    dict
        ``ok`` (bool: no check is a fault) and ``checks`` (list of dict with name, status, value,
        remedy).
    """
    return {
        "ok": all(check.status != "fault" for check in checks),
        "checks": [asdict(check) for check in checks],
    }


def _probe(code: str) -> tuple[dict, str]:
    """Run code in another process: what it printed last, as JSON, and, if it failed, its complaint
    in one line.
    """
    folder = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH")]))
    try:
        run = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TIME_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {}, f"no answer within {TIME_LIMIT} s"
    if run.returncode == 0:
        return json.loads(run.stdout.splitlines()[-1]), ""
    lines = run.stderr.strip().splitlines() or ["no message"]
    if run.returncode < 0:
        telling = next((line for line in lines if "ERROR" in line), lines[-1])
        return {}, f"ended by signal {-run.returncode}: {telling}"
    return {}, lines[-1].removeprefix("mi_prt.errors.RuntimeSetupError: ")


def _fault(name: str, complaint: str, otherwise: str) -> Check:
    """A fault from a complaint; our own errors read "cause; remedy", others get the remedy
    given.
    """
    cause, _, remedy = complaint.partition("; ")
    return Check(name, "fault", cause, remedy or otherwise)


def _requirements() -> list[Requirement]:
    """What mi_prt's metadata says it needs, optional extras left out; names alone if it is run
    without installation.
    """
    try:
        lines = importlib.metadata.requires("mi_prt") or []
    except importlib.metadata.PackageNotFoundError:
        lines = [package for package in runtime.PACKAGES if package != "mi_prt"]
    requirements = [Requirement(line) for line in lines]
    return [
        need for need in requirements if need.marker is None or need.marker.evaluate({"extra": ""})
    ]


def _package(need: Requirement) -> Check:
    """Whether a required package is installed in a version within its bounds."""
    remedy = f"{sys.executable} -m pip install '{need}'"
    version = runtime.package_version(need.name)
    if version == "none":
        return Check(need.name, "fault", "not installed", remedy)
    if version not in need.specifier:
        return Check(need.name, "fault", f"{version}, but {need.specifier} is needed", remedy)
    return Check(need.name, "ok", version)


def _llvm(rays: dict) -> Check:
    """The LLVM that is used; judged by its name where the probe could not tell."""
    path = llvm.select_llvm()
    if rays and rays["llvm"] != "none":
        return Check("llvm", "ok", f"{rays['llvm']} ({path})")
    if rays:
        return Check("llvm", "warning", "none, CUDA is used", llvm.remedy())
    if path is None:
        return Check("llvm", "fault", "no usable library", llvm.remedy())
    library = llvm.Library(path, llvm.library_version(path))
    if library.usable and os.path.isfile(path):
        return Check("llvm", "ok", path)
    return Check("llvm", "fault", f"{path} (version {library.version or 'unknown'})", llvm.remedy())


def _other_llvm() -> Check:
    """LLVM libraries that are there but not used, as information."""
    used = os.path.realpath(llvm.select_llvm() or "")
    others = [library for library in llvm.find_libraries() if library.path != used]
    named = [
        f"{library.version or 'unknown'} ({library.path}){'' if library.usable else ' unusable'}"
        for library in others
    ]
    return Check("other llvm", "ok", ", ".join(named) or "none")


def _rays(rays: dict, complaint: str) -> Check:
    """Whether the probe traced its ray; the unit sphere is 4 away from where the ray starts."""
    reinstall = f"{sys.executable} -m pip install --force-reinstall mitsuba drjit"
    if not rays:
        return _fault("rays", complaint, reinstall)
    if abs(rays["distance"] - 4) > 1e-4:
        return Check(
            "rays",
            "fault",
            f"a ray hit at {rays['distance']} instead of 4 ({rays['variant']})",
            reinstall,
        )
    return Check("rays", "ok", f"traced and rendered in {rays['variant']}")


def _threads(rays: dict) -> Check:
    return Check("threads", "ok", f"{rays['threads']} on {os.cpu_count()} cores")


def _embree(rays: dict) -> Check:
    if not rays["embree"]:
        return Check(
            "embree",
            "warning",
            "Mitsuba was built without it: rays are slower on the CPU",
            f"{sys.executable} -m pip install --force-reinstall mitsuba",
        )
    return Check(
        "embree", "ok", "used" if rays["variant"].startswith("llvm") else "not used, OptiX is"
    )


def _cuda(rays: dict) -> Check:
    if not rays["gpu"]:
        return Check("cuda", "ok", "no GPU, LLVM is used")
    if rays["optix"]:
        return Check("cuda", "ok", "a GPU, used where it is asked for (--variant cuda_ad_rgb)")
    return Check(
        "cuda",
        "warning",
        "a GPU, but its driver's OptiX (libnvoptix.so.1) is missing, so only LLVM can be used",
        "install the complete driver; in a container set NVIDIA_DRIVER_CAPABILITIES=all",
    )
