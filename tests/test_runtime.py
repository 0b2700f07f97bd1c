"""The machine layer: an unusable LLVM gives a typed error and never an abort, kernels are counted,
doctor survives.

Whatever depends on what Dr.Jit loads runs in a process of its own, because Dr.Jit chooses its LLVM
once per process.
"""

import json
import os
import subprocess
import sys
import time

import pytest

from mi_prt.errors import RuntimeSetupError, SettingsError
from mi_prt.system import doctor, llvm, opengl, runtime

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="the linker and /proc are Linux's")


def run_python(code: str, **variables: str) -> subprocess.CompletedProcess:
    """Run code in a new process without a GPU; variables replace those of this process, an empty
    one is removed.
    """
    env = os.environ | {"CUDA_VISIBLE_DEVICES": "", llvm.VARIABLE: ""} | variables
    env = {name: value for name, value in env.items() if value or name == "CUDA_VISIBLE_DEVICES"}
    return subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120
    )


@pytest.fixture
def fake_library(tmp_path):
    """Makes a file with a library's name and this machine's executable header, which is all that a
    search reads.
    """
    with open(sys.executable, "rb") as file:
        header = file.read(64)

    def make(name: str, content: bytes = header) -> str:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return str(path)

    return make


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("libLLVM-14.so.1", 14),
        ("libLLVM-14.0.6.so", 14),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-19.so", 19),
        ("libLLVM.22.dylib", 22),
        ("llvm-17/lib/libLLVM.so", 17),
        ("llvm-19/lib/libLLVM.so.1", 19),
        ("opt/llvm@18/lib/libLLVM.dylib", 18),
        ("Cellar/llvm/20.1.7/lib/libLLVM.dylib", 20),
        ("lib/libLLVM.so", None),
    ],
)
def test_version_is_told_from_the_name_or_folder(fake_library, path, version):
    assert llvm.library_version(fake_library(path)) == version


def test_version_is_told_from_the_target_of_a_link(fake_library, tmp_path):
    (tmp_path / "libLLVM.so").symlink_to(fake_library("libLLVM.so.19.1"))
    assert llvm.library_version(str(tmp_path / "libLLVM.so")) == 19


def test_search_ranks_tried_versions_first(fake_library, tmp_path):
    """17 to 22 were tried, 23 was not; one without a version comes before one that is surely too
    old.
    """
    for name in (
        "libLLVM-14.so.1",
        "libLLVM.so.19.1",
        "libLLVM-22.so",
        "libLLVM-17.so",
        "libLLVM.so.23.0",
        "libLLVM.so",
        "libLLVMCore.so.19",
        "libLLVM-19.so.txt",
    ):
        fake_library(name)
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    found = llvm.find_libraries([str(tmp_path)])
    assert [library.version for library in found] == [22, 19, 17, 23, None, 14]
    assert [library.usable for library in found] == [True] * 4 + [False] * 2


@linux_only
def test_search_skips_what_is_not_for_this_machine(fake_library, tmp_path):
    with open(sys.executable, "rb") as file:
        header = bytearray(file.read(64))
    header[18] ^= 0xFF  # the machine number
    fake_library("libLLVM-19.so", bytes(header))
    fake_library("libLLVM-22.so", b"INPUT(libLLVM.so.22.1)")
    assert llvm.find_libraries([str(tmp_path)]) == []


def test_search_is_fast_enough_for_each_import():
    """It takes 3 to 6 ms here; the best of five leaves out what else the machine does."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        llvm.find_libraries()
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.03


@pytest.mark.parametrize("chosen", ["", "/chosen/libLLVM-14.so"])
def test_importing_mi_prt_selects_unless_the_user_has(fake_library, tmp_path, chosen):
    fake_library("libLLVM-14.so")
    best = fake_library("libLLVM-22.so")
    run = run_python(
        "import os, mi_prt; print(os.environ['DRJIT_LIBLLVM_PATH'])",
        LD_LIBRARY_PATH=str(tmp_path),
        DRJIT_LIBLLVM_PATH=chosen,
    )
    assert run.stdout.strip() == (chosen or best), run.stderr


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("libLLVM-14.so", b"", "LLVM 14, but 17 or newer is needed"),
        ("libLLVM-16.so.1", b"", "LLVM 16, but 17 or newer is needed"),
        ("libLLVM-19.so", b"damaged", "could not load"),
        ("libLLVM-19.so", None, "no such file"),
    ],
)
def test_unusable_llvm_gives_a_typed_error_in_one_line(fake_library, tmp_path, name, content, said):
    path = fake_library(name, content) if content is not None else str(tmp_path / name)
    run = run_python(
        "from mi_prt.system.runtime import mitsuba; mitsuba()", DRJIT_LIBLLVM_PATH=path
    )
    assert run.returncode == 1  # an abort would be negative
    message = run.stderr.splitlines()[-1]
    assert message.startswith("mi_prt.errors.RuntimeSetupError: ")
    # the offender, the limit, the remedy
    assert path in message and said in message and "; " in message


def test_drjit_imported_first_without_a_usable_llvm_is_told_apart(fake_library, tmp_path):
    usable = fake_library("libLLVM-22.so")
    code = (
        "import os, drjit; del os.environ['DRJIT_LIBLLVM_PATH']\n"
        "from mi_prt.system.runtime import mitsuba; mitsuba()"
    )
    run = run_python(
        code, DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"), LD_LIBRARY_PATH=str(tmp_path)
    )
    message = run.stderr.splitlines()[-1]
    assert run.returncode == 1 and message.startswith("mi_prt.errors.RuntimeSetupError: ")
    assert "imported before mi_prt" in message and usable in message


def test_another_variant_is_refused_by_name():
    run = run_python(
        "from mi_prt.system.runtime import mitsuba\n"
        "import mitsuba as mi; mi.set_variant('scalar_rgb'); mitsuba()",
        **_usable_llvm(),
    )
    message = run.stderr.splitlines()[-1]
    assert run.returncode == 1 and message.startswith("mi_prt.errors.RuntimeSetupError: ")
    assert "scalar_rgb" in message and "llvm_ad_rgb" in message and "cuda_ad_rgb" in message


def test_llvm_is_the_default_whatever_there_is():
    """Also where a GPU can be used, as this program is told here; another variant is asked for."""
    run = run_python(
        "from mi_prt.system import runtime\nruntime.cuda_usable = lambda: True\n"
        "print(runtime.mitsuba().variant())",
        **_usable_llvm(),
    )
    assert run.stdout == "llvm_ad_rgb\n", run.stderr


def test_a_variant_that_cannot_be_had_is_refused(monkeypatch):
    monkeypatch.setattr(runtime, "cuda_usable", lambda: False)
    with pytest.raises(RuntimeSetupError, match="cuda_ad_rgb needs a GPU .* use llvm_ad_rgb"):
        runtime.set_variant("cuda_ad_rgb")
    with pytest.raises(SettingsError, match="'scalar_rgb' is not known: use llvm_ad_rgb or"):
        runtime.set_variant("scalar_rgb")


def test_a_variant_on_the_command_line(capsys):
    """Each command that computes takes it, before anything is opened."""
    from mi_prt.cli import main

    for command in ("info", "precompute", "relight", "compare"):
        output = [] if command == "info" else ["-o", "none/x.npz"]
        with pytest.raises(SystemExit) as exit:
            main([command, "none.xml", *output, "--variant", "metal"])
        assert exit.value.code == 2
        if command != "precompute":  # which looks at its output first
            assert "variant 'metal' is not known" in capsys.readouterr().err


def test_a_usable_variant_is_kept_and_messages_go_to_stderr():
    """A result on stdout is parsed by programs, so not one message of Mitsuba may appear there."""
    run = run_python(
        "from mi_prt.system.runtime import mitsuba, quiet_mitsuba\n"
        "mi = mitsuba(); quiet_mitsuba(); print(mi.variant(), mitsuba().variant())\n"
        "mi.Log(mi.LogLevel.Warn, 'told'); mi.Log(mi.LogLevel.Info, 'not told')",
        **_usable_llvm(),
    )
    assert run.stdout == "llvm_ad_rgb llvm_ad_rgb\n", run.stderr
    assert "told" in run.stderr and "not told" not in run.stderr


def test_kernels_are_counted_once_per_program_not_per_launch():
    """A literal is part of the program and an opaque value is not: only new literals compile
    anew.
    """
    mi = runtime.mitsuba()
    import drjit as dr

    def evaluate(factor):
        dr.eval(dr.sin(dr.arange(mi.Float, 100)) * factor)

    # whatever making opaque values compiles is not to be counted
    evaluate(dr.opaque(mi.Float, 1.0))
    with runtime.count_kernels() as all_blocks:
        with runtime.count_kernels() as first:
            evaluate(0.70131)
        with runtime.count_kernels() as repeated:
            evaluate(0.70131)
        with runtime.count_kernels() as literals:
            for factor in (0.70132, 0.70133, 0.70134):
                evaluate(factor)
        with runtime.count_kernels() as opaque:
            for factor in (0.1, 0.2, 0.3):
                evaluate(dr.opaque(mi.Float, factor))
    evaluate(0.70135)  # after the blocks: changes nothing
    assert (first.compiled, first.launched) == (1, 1)
    assert (repeated.compiled, repeated.launched) == (0, 1)
    assert (literals.compiled, literals.launched) == (3, 3)
    assert (opaque.compiled, opaque.launched) == (0, 3)
    assert (all_blocks.compiled, all_blocks.launched) == (4, 8)
    assert 0 <= all_blocks.from_disk <= all_blocks.compiled


def test_threads_are_set_and_read_back():
    before = runtime.thread_count()
    try:
        runtime.set_threads(1)
        assert runtime.thread_count() == 1
    finally:
        runtime.set_threads(before)


@pytest.mark.parametrize("count", [0, -1, True, 2.0, "2", 10**6])
def test_senseless_thread_counts_are_refused(count):
    with pytest.raises(SettingsError, match="threads must be an integer from 1 to"):
        runtime.set_threads(count)


@linux_only
def test_peak_memory_counts_this_process_alone():
    """The child allocates 64 MiB; the parent's 256 MiB, which getrusage would report, must not
    show.
    """
    parent = bytearray(b"\1" * (256 << 20))
    run = run_python(
        "from mi_prt.system.runtime import peak_memory_bytes as peak\nbefore = peak(); block ="
        " bytearray(b'\\1' * 1024) * (64 << 10); print(before, peak() - before)"
    )
    before, grown = map(int, run.stdout.split())
    assert before < len(parent)
    assert 60 << 20 < grown < 80 << 20


def test_versions_name_all_that_a_result_depends_on():
    found = runtime.versions()
    assert set(found) == {*runtime.PACKAGES, "python", "llvm"}
    assert all(
        found[name][0].isdigit() for name in ("mitsuba", "drjit", "numpy", "scipy", "python")
    )


@pytest.mark.parametrize("name", ["glx", "pyglet"])
def test_platform_that_needs_a_screen_is_refused(monkeypatch, name):
    monkeypatch.setenv("PYOPENGL_PLATFORM", name)
    with pytest.raises(RuntimeSetupError, match=name):
        opengl.raster_platform()


def test_missing_platforms_are_named_with_a_remedy(monkeypatch):
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(opengl, "_installed", lambda name: False)
    with pytest.raises(RuntimeSetupError, match="neither OSMesa nor EGL.*install"):
        opengl.raster_platform()


def test_opengl_imported_before_for_a_screen_is_told_apart():
    run = run_python(
        "import os; os.environ['PYOPENGL_PLATFORM'] = 'glx'; import OpenGL.platform\n"
        "del os.environ['PYOPENGL_PLATFORM']\n"
        "from mi_prt.system.opengl import raster_platform; raster_platform()"
    )
    assert "PyOpenGL was imported before mi_prt and took GLXPlatform" in run.stderr


def test_doctor_finds_this_machine_in_order():
    checks = doctor.examine()
    names = [check.name for check in checks]
    assert len(set(names)) == len(names)
    assert {
        "python",
        "mitsuba",
        "drjit",
        "llvm",
        "rays",
        "threads",
        "embree",
        "cuda",
        "raster",
    } <= set(names)
    report = json.loads(json.dumps(doctor.as_dict(checks)))
    assert report["ok"], [check for check in checks if check.status == "fault"]
    assert all(set(check) == {"name", "status", "value", "remedy"} for check in report["checks"])


def test_doctor_survives_an_unusable_llvm_and_names_the_remedy(fake_library, monkeypatch):
    path = fake_library("libLLVM-14.so")
    monkeypatch.setenv(llvm.VARIABLE, path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    checks = {check.name: check for check in doctor.examine()}
    assert checks["llvm"].status == checks["rays"].status == "fault"
    assert path in checks["llvm"].value and "14" in checks["llvm"].value
    assert all(check.remedy for check in checks.values() if check.status == "fault")
    assert not doctor.as_dict(list(checks.values()))["ok"]


def test_doctor_reports_a_probe_that_ends_its_process(monkeypatch):
    """What LLVM does when it cannot compile: a line on stderr, then SIGABRT (6)."""
    monkeypatch.setattr(
        doctor, "_RAYS_PROBE", "import os; os.write(2, b'LLVM ERROR: no\\nmore\\n'); os.abort()"
    )
    check = doctor.check_rays()
    assert (
        check.status == "fault"
        and check.value == "ended by signal 6: LLVM ERROR: no"
        and check.remedy
    )


def _usable_llvm() -> dict[str, str]:
    """The choice of this process, for a test that must run with it."""
    path = llvm.select_llvm()
    return {llvm.VARIABLE: path} if path else {}
