"""With one thread nothing waits for a worker that is not there: all that reads or writes images,
in a process of its own with a time limit, which would else hang.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR

ROOT = Path(__file__).resolve().parent.parent
SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><film type="hdrfilm">
    <integer name="width" value="16"/><integer name="height" value="12"/>
  </film>
    <transform name="to_world"><lookat origin="0,0.5,0.2" target="0,0,0" up="0,1,0"/></transform>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
      <string name="filename" value="floor.exr"/></texture></bsdf>
  </shape>
  <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
</scene>"""
PROGRAM = """
import os, sys
import mi_prt
from mi_prt.cli import main
from mi_prt.system.runtime import mitsuba, set_threads, thread_count

common = ["--threads", "1"]
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [0])
set_threads(1)  # what Dr.Jit takes of one core


def run(*arguments):
    try:
        main([*arguments, *common])
    except SystemExit as exit:
        assert not exit.code, (arguments, exit.code)


run("precompute", "scene.xml", "-o", "a.prt", "--directions", "cubemap:4", "--edge-length", "1")
run("relight", "a.prt", "-o", "a.exr", "--spp", "1")
run("relight", "a.prt", "-o", "a.png", "--spp", "1")
run("relight", "a.prt", "-o", "b.exr", "--spp", "1", "--envmap", "sky.exr")
run("relight", "a.prt", "-o", "c.exr", "--spp", "1", "--envmap", "misnamed.hdr")
run("compare", "a.prt", "-o", "report", "--spp", "2", "--size", "8x6")
mi = mitsuba()
mi.render(mi.load_dict({"type": "scene", "s": {"type": "sphere"}, "sensor": {"type": "perspective"},
                        "integrator": {"type": "path"}}), spp=1)
print("threads", thread_count())
"""


def test_images_with_a_single_thread(tmp_path):
    """Scene with .exr textures, .exr output, `compare`, maps, also an .exr under another name; by
    `--threads 1`, and on one core. One thread it is before and after.
    """
    (tmp_path / "scene.xml").write_text(SCENE)
    for name in ("sky.exr", "floor.exr"):
        OpenEXR.File({}, {"RGB": np.full((40, 80, 3), 0.5, np.float32)}).write(str(tmp_path / name))
    (tmp_path / "misnamed.hdr").write_bytes((tmp_path / "sky.exr").read_bytes())
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("threads 1\n")


def test_overlapping_readers_keep_their_worker():
    """Two threads read at once; the first to end does not take the worker from the other, the last
    one does.
    """
    from mi_prt.system.runtime import set_threads, thread_count
    from mi_prt.system.workers import a_worker_at_least

    before = thread_count()
    try:
        set_threads(1)
        one, other = a_worker_at_least(), a_worker_at_least()
        one.__enter__()
        other.__enter__()
        one.__exit__(None, None, None)
        assert thread_count() == 2
        other.__exit__(None, None, None)
        assert thread_count() == 1
    finally:
        set_threads(before)
