"""Every small scene of a folder from end to end: what is wrong shows as a ratio or as an error.

Usage: python benchmarks/cases.py [FOLDER] [--only NAME ...] [--size 80x60] [--spp 64]

For each XML file `info`, `precompute` and `compare --reference full` run, each file in a process of
its own. Prints a Markdown table: the mean of the image over that of Mitsuba's path tracer, the
error beyond the truth's noise, the bias at the points, seconds, and warnings or the one-line error.
An error without a type of its own is shown as TRACEBACK.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIMIT = 300  # seconds of a command


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "tests" / "cases")
    parser.add_argument("--only", nargs="*", default=[], help="Names of files without .xml.")
    parser.add_argument("--size", default="80x60")
    parser.add_argument("--spp", default="64")
    arguments = parser.parse_args()
    names = sorted(arguments.folder.rglob("*.xml"))
    if arguments.only:
        names = [path for path in names if path.stem in arguments.only]
    print("| input | ratio of means | RMSE beyond noise | bias at points | s | said |")
    print("|---|---:|---:|---:|---:|---|")
    for path in names:
        row = _row(path, arguments)
        print(f"| {path.stem} | " + " | ".join(row) + " |", flush=True)


def _row(path, arguments):
    """Cells of a scene's row."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        asset, report = Path(folder) / "a.prt", Path(folder) / "report"
        steps = (
            ("info", path),
            ("precompute", path, "-o", asset),
            ("compare", asset, "-o", report, "--reference", "full", "--size", arguments.size)
            + ("--spp", arguments.spp),
        )
        found, said = {}, []
        for step in steps:
            code, found, words = _run(*step)
            said += [word for word in words if word not in said]
            if code:
                said.append(f"{step[0]}: exit {code}")
                break
    seconds = f"{time.perf_counter() - started:.0f}"
    words = "; ".join(said).replace("|", "\\|")
    if "image" not in found:
        return "", "", "", seconds, words
    image, points = found["image"], found["points"]
    numbers = (1 + image["bias"], image["relative_rmse_beyond_noise"], points["bias"])
    return *(f"{number:.3f}" for number in numbers), seconds, words


def _run(*arguments):
    """Exit code of a command, its JSON, and what it said: warnings and errors, one line each."""
    command = [sys.executable, "-m", "mi_prt", *map(str, arguments), "--json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, cwd=ROOT)
    except subprocess.TimeoutExpired:
        return "none", {}, [f"not done after {LIMIT} s"]
    if "Traceback (most recent call last)" in done.stderr:
        return done.returncode, {}, [f"TRACEBACK {done.stderr.strip().splitlines()[-1]}"]
    said = [line for line in done.stderr.splitlines() if line.startswith("mi-prt: ")]
    words = [line.removeprefix("mi-prt: ") for line in said if "/" not in line.split(" ")[-1]]
    found = json.loads(done.stdout) if done.stdout.strip() and not done.returncode else {}
    return done.returncode, found, words


if __name__ == "__main__":
    main()
