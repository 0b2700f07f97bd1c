"""The command line: mi-prt doctor | info | precompute | relight | compare."""

import json
import sys
import time
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Optional

import typer

from .errors import PrtError, SettingsError
from .evaluate.report import finite

app = typer.Typer(
    name="mi-prt",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help=(
        "Precomputed radiance transfer for Mitsuba 3: precompute how light moves through a scene,"
        " then relight it in milliseconds.\n\nExample: mi-prt precompute scenes/teapot.xml -o"
        " teapot.prt && mi-prt relight teapot.prt -o teapot.png --rotate y:45"
    ),
)

_SAMPLES = "With --points samples"

LOG_SECONDS = 20  # between lines of progress where there is no terminal

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")
]
Threads = Annotated[
    Optional[int], typer.Option("--threads", metavar="N", help="CPU threads; default: all cores.")
]
Define = Annotated[
    Optional[list[str]],
    typer.Option("-D", metavar="NAME=VALUE", help="Value for a <default> parameter of the XML."),
]
Environment = Annotated[
    Optional[Path],
    typer.Option(
        "--envmap", metavar="EXR", help="Environment map; default: the scene's own light."
    ),
]
Lights = Annotated[
    Optional[list[str]],
    typer.Option(
        "--light",
        metavar="SPEC",
        help=(
            "point:x,y,z:r,g,b (W/sr), spot:x,y,z:dx,dy,dz:r,g,b[:CUTOFF[:BEAM]] (W/sr, degrees),"
            " area:x,y,z:ux,uy,uz:vx,vy,vz:r,g,b[:SAMPLES] (centre, edges, W/(m² sr)),"
            " directional:dx,dy,dz:r,g,b (direction of travel, W/m²), envmap:FILE or"
            " envmap:FILE:y:30, or scene (its own light); one number is grey. May be repeated:"
            " lights add up, also to --envmap."
        ),
    ),
]
Component = Annotated[
    str,
    typer.Option(
        "--component", metavar="total|direct|indirect", help="Of light, with --points samples."
    ),
]
Direct = Annotated[
    str,
    typer.Option(
        "--direct",
        metavar="points|pixels",
        help="Direct light at the points, or by shadow rays at pixels; with --points samples.",
    ),
]
Nearest = Annotated[
    int, typer.Option("--nearest", metavar="K", help="Directions that stand for a local light.")
]
Rotate = Annotated[
    Optional[str],
    typer.Option(
        "--rotate", metavar="AXIS:DEGREES", help="Turn distant light about x, y, z or a,b,c."
    ),
]
OtherScene = Annotated[
    Optional[Path],
    typer.Option("--scene", metavar="SCENE", help="The asset's scene, if it is elsewhere by now."),
]
Sensor = Annotated[int, typer.Option("--sensor", help="Index of the scene's sensor.")]
Size = Annotated[
    Optional[str], typer.Option("--size", metavar="WxH", help="Image size; default: the sensor's.")
]
Directions = Annotated[
    str,
    typer.Option(
        "--directions",
        metavar="LATTICE",
        help="cubemap:N (6·N·N directions), latlong:WxH or halton:N.",
    ),
]
Basis = Annotated[
    str,
    typer.Option(
        "--basis",
        metavar="KIND",
        help="pca, sh, haar (best wavelets of each point), haar-shared or none.",
    ),
]
Coefficients = Annotated[
    Optional[str],
    typer.Option(
        "--coefficients",
        metavar="D|auto",
        help="Components of the basis; default: 48 (sh: 49), or the rank if lower.",
    ),
]
Variance = Annotated[
    Optional[float],
    typer.Option(
        "--variance",
        metavar="SHARE",
        help="Of the transport, that --coefficients auto captures [0.95].",
    ),
]
EdgeLength = Annotated[
    str,
    typer.Option(
        "--edge-length", metavar="auto|METRES", help="Coarse faces are tessellated down to this."
    ),
]
Rays = Annotated[
    int,
    typer.Option(
        "--rays-per-direction", metavar="R", help="Rays in each cell; 4 antialias shadows."
    ),
]
Bounces = Annotated[
    Optional[str],
    typer.Option(
        "--bounces",
        metavar="B|auto",
        help="Reflections of light [auto: until 0.1 % is left; haar and none: 0].",
    ),
]
Indirect = Annotated[
    str,
    typer.Option(
        "--indirect",
        metavar="solve|paths",
        help="Reflections from point to point, or by unbiased path tracing.",
    ),
]
Paths = Annotated[
    str,
    typer.Option(
        "--paths-per-point",
        metavar="N|auto",
        help="Rays for reflections; auto: noise of about 1 % of the transport.",
    ),
]
Denoise = Annotated[
    bool,
    typer.Option(
        "--denoise/--no-denoise", help="Take noise that can be told out of reflected light."
    ),
]
Seed = Annotated[int, typer.Option("--seed", help="Same seed, same result.")]
PointKind = Annotated[
    str,
    typer.Option(
        "--points",
        metavar="vertices|samples",
        help="vertices for distant light, samples for lights that move inside the scene.",
    ),
]
Count = Annotated[
    int, typer.Option("--count", metavar="N", help="Samples.", rich_help_panel=_SAMPLES)
]
ClusterSize = Annotated[
    int,
    typer.Option(
        "--cluster-size",
        metavar="N",
        help="Samples in a cluster, on average.",
        rich_help_panel=_SAMPLES,
    ),
]
DepthDirections = Annotated[
    int,
    typer.Option(
        "--depth-directions",
        metavar="N",
        help="Of each sample's depth buffer.",
        rich_help_panel=_SAMPLES,
    ),
]
DepthCoefficients = Annotated[
    int,
    typer.Option(
        "--depth-coefficients",
        metavar="D",
        help="Components of depth buffers on a cluster.",
        rich_help_panel=_SAMPLES,
    ),
]
ExampleLights = Annotated[
    int,
    typer.Option(
        "--example-lights",
        metavar="N",
        help="Lights that the basis of direct light is made from.",
        rich_help_panel=_SAMPLES,
    ),
]
TransferCoefficients = Annotated[
    int,
    typer.Option(
        "--transfer-coefficients",
        metavar="D",
        help="Components of direct light on a cluster.",
        rich_help_panel=_SAMPLES,
    ),
]
TransferError = Annotated[
    float,
    typer.Option(
        "--transfer-error",
        metavar="SHARE",
        help="Of indirect light, that may be lost by leaving small things out.",
        rich_help_panel=_SAMPLES,
    ),
]
Quantize = Annotated[
    str,
    typer.Option(
        "--quantize",
        metavar="16|none",
        help="Integers of 16 bits, or float32.",
        rich_help_panel=_SAMPLES,
    ),
]


@app.command(epilog="Example: mi-prt doctor --json")
def doctor(as_json: Json = False):
    """Check this machine: LLVM, Mitsuba, Embree, raster platform; with the remedy for each
    fault.
    """
    from .system import doctor as examination

    checks = examination.examine()
    if as_json:
        _print_json(examination.as_dict(checks))
    else:
        colours = {"ok": "green", "warning": "yellow", "fault": "red"}
        _table(
            [
                (f"[{colours[c.status]}]{c.status}[/]", c.name, c.value, c.remedy or "")
                for c in checks
            ]
        )
    if any(check.status == "fault" for check in checks):
        raise typer.Exit(1)


@app.command(epilog="Example: mi-prt info scenes/still_life.xml --directions cubemap:16 --json")
def info(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(help="A scene (XML) or an asset.")],
    points: PointKind = "vertices",
    directions: Directions = "cubemap:32",
    basis: Basis = "pca",
    coefficients: Coefficients = None,
    variance: Variance = None,
    edge_length: EdgeLength = "auto",
    rays_per_direction: Rays = 1,
    bounces: Bounces = None,
    indirect: Indirect = "solve",
    paths_per_point: Paths = "auto",
    denoise: Denoise = True,
    count: Count = 45_000,
    cluster_size: ClusterSize = 1000,
    depth_directions: DepthDirections = 2016,
    depth_coefficients: DepthCoefficients = 50,
    example_lights: ExampleLights = 1000,
    transfer_coefficients: TransferCoefficients = 32,
    transfer_error: TransferError = 0.02,
    quantize: Quantize = "16",
    define: Define = None,
    as_json: Json = False,
):
    """Say what a scene requires and what precomputing it will cost, or what an asset holds."""
    from .precompute import info as description

    if path.is_file() and _is_hdf5(path):
        from .asset.opening import load

        found = description.describe_asset(load(path))
    else:
        found = description.describe(
            path, _parameters(define), points, **_settings(context, points)
        )
    _print_json(found) if as_json else _print_nested(found)


@app.command(
    epilog=(
        "Examples: mi-prt precompute scenes/teapot.xml -o teapot.prt --coefficients 96 -D"
        " spp=16\n\nmi-prt precompute scenes/cornell_sky.xml -o cornell.prt --bounces 3"
        " --paths-per-point 512\n\nmi-prt precompute scenes/teapot.xml -o teapot.prt --coefficients"
        " auto --variance 0.98 --max-memory 2G --resume\n\nmi-prt precompute scenes/room.xml -o"
        " room.prt --points samples --count 45000"
    )
)
def precompute(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(help="A Mitsuba XML file.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="The asset to write.")
    ],
    points: PointKind = "vertices",
    directions: Directions = "cubemap:32",
    basis: Basis = "pca",
    coefficients: Coefficients = None,
    variance: Variance = None,
    edge_length: EdgeLength = "auto",
    rays_per_direction: Rays = 1,
    bounces: Bounces = None,
    indirect: Indirect = "solve",
    paths_per_point: Paths = "auto",
    denoise: Denoise = True,
    count: Count = 45_000,
    cluster_size: ClusterSize = 1000,
    depth_directions: DepthDirections = 2016,
    depth_coefficients: DepthCoefficients = 50,
    example_lights: ExampleLights = 1000,
    transfer_coefficients: TransferCoefficients = 32,
    transfer_error: TransferError = 0.02,
    quantize: Quantize = "16",
    seed: Seed = 0,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue an interrupted run of this file, if there is one."),
    ] = False,
    max_memory: Annotated[
        Optional[str],
        typer.Option(
            "--max-memory", metavar="BYTES", help="Such as 3G; default: half of what is free."
        ),
    ] = None,
    threads: Threads = None,
    define: Define = None,
    as_json: Json = False,
):
    """Precompute a scene's transport into one file.

    What is computed on the way is kept in FILE.partial until FILE is whole: a run that is
    interrupted or killed can be continued with --resume, and gives the same file.
    """
    from .precompute.precompute import measure
    from .system.files import check_writable

    check_writable(output)
    _set_threads(threads)
    started = time.perf_counter()
    with _progress(kept=f"{output}.partial") as progress:
        asset, cost = measure(
            scene,
            _parameters(define),
            progress,
            output,
            resume,
            max_memory,
            points,
            **_settings(context, points),
        )
    cost["seconds"]["total"] = round(time.perf_counter() - started, 4)
    for entry in asset.scene["left_out"]:
        _note(
            f"not modelled: {entry['what']}"
            + (f" ({', '.join(entry['shapes'][:5])})" if entry["shapes"] else "")
        )
    result = {
        "points": len(asset.points),
        **_summary(asset),
        "bytes": output.stat().st_size,
        **cost,
    }
    _print_json(result) if as_json else _print_nested({"wrote": str(output)} | result)


@app.command(
    epilog=(
        "Examples: mi-prt relight teapot.prt -o teapot.png --envmap sky.exr --rotate y:90 --size"
        " 640x480\n\nmi-prt relight teapot.prt -o lamps.png --light scene --light"
        " point:3,4,2:60,50,40 --light envmap:sky.exr:y:90\n\nmi-prt relight room.prt -o lamp.png"
        " --light point:0,1.5,0:8,7,6 --component indirect\n\nmi-prt relight room.prt -o walk.mp4"
        " --light point:0,1.5,0:8,7,6 --light-path '-1,1.5,0 1,1.5,0 1,1.5,1' --renderer raster"
    )
)
def relight(
    asset_path: Annotated[Path, typer.Argument(metavar="FILE", help="An asset.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help=".exr, .png, .ply or .npz; of a film .mp4, .gif or frame-%03d.png",
        ),
    ],
    envmap: Environment = None,
    light: Lights = None,
    nearest: Nearest = 1,
    rotate: Rotate = None,
    sensor: Sensor = 0,
    size: Size = None,
    renderer: Annotated[str, typer.Option("--renderer", metavar="mitsuba|raster")] = "mitsuba",
    spp: Annotated[int, typer.Option("--spp", help="Samples per pixel of mitsuba's image.")] = 64,
    component: Component = "total",
    direct: Direct = "points",
    light_path: Annotated[
        Optional[str],
        typer.Option(
            "--light-path",
            metavar="'x,y,z x,y,z …'",
            help="Move the first --light along these places; OUT is a film.",
        ),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", metavar="N", help="Of the film.")] = 48,
    fps: Annotated[int, typer.Option("--fps", help="Frames of the film in a second.")] = 25,
    scene: OtherScene = None,
    threads: Threads = None,
    as_json: Json = False,
):
    """Relight an asset: an image, a mesh with vertex radiance, plain arrays, or a film of a light
    that moves.
    """
    from .asset.opening import load
    from .output.relight import relight_to_file

    _set_threads(threads)
    chosen = _light(envmap, light)
    asset = load(asset_path)
    if light_path is not None:
        result = _film(
            asset,
            output,
            light_path,
            chosen,
            rotate,
            frames,
            fps,
            scene,
            sensor,
            _size(size),
            renderer,
            spp,
            component,
            direct,
        )
    else:
        result = relight_to_file(
            asset,
            output,
            chosen,
            _rotation(rotate),
            scene,
            sensor,
            _size(size),
            renderer,
            spp,
            nearest,
            component,
            direct,
        )
    _print_json(result) if as_json else _print_nested({"wrote": str(output)} | result)


@app.command(
    epilog=(
        "Examples: mi-prt compare teapot.prt -o teapot-report --spp 512 --json\n\n"
        "mi-prt compare room.prt -o room-report --light point:0,1.5,0:8,7,6"
    )
)
def compare(
    asset_path: Annotated[Path, typer.Argument(metavar="FILE", help="An asset.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the report.")
    ],
    envmap: Environment = None,
    light: Lights = None,
    nearest: Nearest = 1,
    rotate: Rotate = None,
    sensor: Sensor = 0,
    size: Size = None,
    spp: Annotated[int, typer.Option("--spp", help="Samples per pixel of the reference.")] = 256,
    reference: Annotated[str, typer.Option("--reference", metavar="modelled|full")] = "modelled",
    direct: Direct = "points",
    scene: OtherScene = None,
    seed: Seed = 0,
    threads: Threads = None,
    as_json: Json = False,
):
    """Compare an asset with Mitsuba's ground truth and write a report with pictures."""
    from .asset.opening import load
    from .evaluate.compare import compare as run

    _set_threads(threads)
    asset = load(asset_path)
    with _progress() as progress:
        result = run(
            asset,
            output,
            _light(envmap, light),
            _rotation(rotate),
            scene,
            sensor,
            _size(size),
            spp,
            reference,
            seed,
            progress,
            nearest,
            direct,
        )
    (
        _print_json(result)
        if as_json
        else _print_nested({"wrote": str(output / "index.html")} | result)
    )


def main(arguments=None):
    """Run the program; exit codes: 0 done, 2 bad usage or input, 130 interrupted, 1 anything
    else.
    """
    warnings.showwarning = lambda message, *_, **__: _note(str(message))
    try:
        from .system.runtime import quiet_mitsuba

        if not _only_help(sys.argv[1:] if arguments is None else arguments):
            quiet_mitsuba()
        app(arguments, standalone_mode=True)
    except PrtError as error:
        print(f"mi-prt: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except MemoryError:
        print(
            "mi-prt: out of memory: use fewer --directions or a longer --edge-length, or set"
            " --max-memory",
            file=sys.stderr,
        )
        sys.exit(1)


def _film(
    asset,
    output,
    places,
    light,
    rotate,
    frames,
    fps,
    scene,
    sensor,
    size,
    renderer,
    spp,
    component,
    direct,
):
    from .asset.meshless_asset import MeshlessAsset
    from .output.film import light_path
    from .output.relight_local import animate_local

    if not isinstance(asset, MeshlessAsset) or rotate is not None:
        raise SettingsError(
            "--light-path moves a light inside the scene: it takes an asset of --points samples,"
            " and no --rotate"
        )
    with _progress() as progress:
        path = light_path(places)
        return animate_local(
            asset,
            output,
            path,
            frames,
            fps,
            light,
            scene,
            sensor,
            size,
            renderer,
            spp,
            component,
            direct,
            progress,
        )


# --- what the user passes -------------------------------------------------------------------------


def _only_help(arguments):
    return not arguments or any(a in ("-h", "--help") for a in arguments)


def _parameters(define):
    parameters = {}
    for entry in define or []:
        name, equals, value = entry.partition("=")
        if not (name and equals):
            raise SettingsError(f"-D {entry} is not of the form NAME=VALUE")
        parameters[name] = value
    return parameters


def _count(option, text):
    """A whole number, 'auto' or None."""
    if text in (None, "auto"):
        return text
    try:
        return int(text)
    except ValueError:
        raise SettingsError(f"--{option} {text} is neither a whole number nor auto") from None


def _settings(context, points):
    """The settings of a kind of points, from all options of a command; those of the other kind must
    not be given.
    """
    from .precompute.precompute import POINTS
    from .precompute.settings import names_of

    if points not in POINTS:
        raise SettingsError(f"--points {points} is not known: use {' or '.join(POINTS)}")
    own = names_of(POINTS[points][0])
    every = {name for kind, _ in POINTS.values() for name in names_of(kind)}
    given = {
        name
        for name in every & set(context.params)
        if context.get_parameter_source(name).name == "COMMANDLINE"
    }
    foreign = sorted(given - set(own))
    if foreign:
        raise SettingsError(
            f"--{foreign[0].replace('_', '-')} means nothing with --points {points}: leave it out"
        )
    counts = {"coefficients", "bounces", "paths_per_point"}
    values = {name: context.params[name] for name in own if name in context.params}
    return {
        name: _count(name.replace("_", "-"), value) if name in counts else value
        for name, value in values.items()
    }


def _summary(asset):
    """What `precompute` tells of an asset."""
    from .asset.meshless_asset import MeshlessAsset

    names = ["bounces", "captured_variance", "relative_error"]
    if not isinstance(asset, MeshlessAsset):
        return {"directions": len(asset.directions), "coefficients": len(asset.basis)} | {
            name: asset.report[name] for name in names
        }
    left_aside = ("rays", "channels", "no_own_light")
    return {"clusters": len(asset.samples.roots)} | {
        name: value for name, value in asset.report.items() if name not in left_aside
    }


def _light(envmap, specs):
    """The sum of --envmap and all --light; None if there is neither."""
    from .lighting.parse import parse_light

    return ([] if envmap is None else [envmap]) + [
        parse_light(spec) for spec in specs or []
    ] or None


def _rotation(text):
    from .lighting.parse import parse_rotation

    return None if text is None else parse_rotation(text)


def _size(text):
    if text is None:
        return None
    width, times, height = text.lower().partition("x")
    if not (times and width.isdigit() and height.isdigit()):
        raise SettingsError(f"--size {text} is not of the form WxH, for example 640x480")
    return int(width), int(height)


def _set_threads(threads):
    if threads is not None:
        from .system.runtime import set_threads

        set_threads(threads)


def _is_hdf5(path):
    with open(path, "rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


# --- what the user sees ---------------------------------------------------------------------------


def _print_json(value):
    print(json.dumps(finite(value), allow_nan=False))


def _note(text):
    print(f"mi-prt: {text}", file=sys.stderr)


def _table(rows):
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def _print_nested(value, indent=""):
    for key, entry in value.items():
        if isinstance(entry, dict) and entry:
            print(f"{indent}{key}:")
            _print_nested(entry, indent + "  ")
        elif isinstance(entry, list) and entry and isinstance(entry[0], dict):
            print(f"{indent}{key}:")
            for item in entry:
                print(
                    f"{indent}  - "
                    + ", ".join(f"{k} {_plain(v)}" for k, v in item.items() if v not in (None, []))
                )
        else:
            print(f"{indent}{key}: {_plain(entry)}")


def _plain(entry):
    if isinstance(entry, float):
        return f"{entry:.6g}"
    if isinstance(entry, list):
        return ", ".join(_plain(x) for x in entry) or "none"
    if isinstance(entry, int) and not isinstance(entry, bool):
        return f"{entry:,}"
    return str(entry)


@contextmanager
def _progress(kept=None):
    """A callable(stage, done, total, detail) that draws progress with ETA on stderr, and where that
    is no terminal, prints it.

    Ctrl-C ends the program within the block, with a word on what was kept.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[detail]}"),
    )
    tasks = {}
    console = Console(stderr=True)
    printed = time.monotonic()
    with Progress(*columns, console=console) as bar:

        def progress(stage, done, total, detail=""):
            nonlocal printed
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, detail="")
            bar.update(tasks[stage], completed=done, total=total, detail=detail)
            if not console.is_terminal and time.monotonic() > printed + LOG_SECONDS:
                printed = time.monotonic()
                _note(f"{stage} {done}/{total} {detail}".rstrip())

        try:
            yield progress
        except KeyboardInterrupt:
            bar.stop()
            _note(
                "interrupted; nothing is left half-written"
                + (f", and --resume continues ({kept})" if kept else "")
            )
            sys.exit(130)
