"""The commands, one function each."""

import time
from pathlib import Path
from typing import Annotated

import typer

from ..errors import SettingsError
from . import options as take
from .options import (
    LIGHTS_HELP,
    Component,
    Define,
    Direct,
    Environment,
    Environments,
    Exposure,
    Floor,
    Force,
    Frames,
    FramesPerSecond,
    Json,
    Lights,
    Nearest,
    OtherScene,
    Rotate,
    Seed,
    Sensors,
    Size,
    Threads,
    Variant,
    Viewpoint,
    flowing,
    with_settings,
)
from .show import note, print_json, print_nested, progress_bar, table

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


def _print_version(wanted: bool):
    if wanted:
        from .. import __version__

        print(f"mi-prt {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
):
    """Options of the program itself."""


@app.command(epilog="Example: mi-prt doctor --json")
@flowing
def doctor(as_json: Json = False):
    """Check this machine: LLVM, Mitsuba, Embree, raster platform; with the remedy for each
    fault.
    """
    from ..system import doctor as examination

    checks = examination.examine()
    if as_json:
        print_json(examination.as_dict(checks))
    else:
        colours = {"ok": "green", "warning": "yellow", "fault": "red"}
        rows = [(f"[{colours[c.status]}]{c.status}[/]", c.name, c.value, c.remedy) for c in checks]
        table([(*row[:3], row[3] or "") for row in rows])
    if any(check.status == "fault" for check in checks):
        raise typer.Exit(1)


@app.command(epilog="Example: mi-prt info scenes/still_life.xml --directions cubemap:16 --json")
@with_settings
@flowing
def info(
    path: Annotated[Path, typer.Argument(help="A scene (XML), a mesh or an asset.")],
    settings: dict,
    define: Define = None,
    variant: Variant = None,
    floor: Floor = False,
    as_json: Json = False,
):
    """Say what a scene requires and what precomputing it will cost, or what an asset holds."""
    from ..precompute.info import info as run

    take.use(None, variant)
    _show(run(path, take.parameters_of(define, floor), **settings), as_json)


@app.command(
    epilog=(
        "Examples: mi-prt precompute scenes/teapot.xml -o teapot.prt --coefficients 96 -D"
        " spp=16\n\nmi-prt precompute scenes/day_room.xml -o room.prt   (its sky and its lamps)\n\n"
        "mi-prt precompute scenes/meshes/teapot.ply -o teapot.prt --floor   (.ply, .obj, .glb,"
        " .stl)\n\n"
        "mi-prt precompute scenes/teapot.xml -o teapot.prt --coefficients auto --variance 0.98"
        " --max-memory 2G --resume\n\nmi-prt precompute scenes/room.xml -o room.prt --transports"
        " own,local --points samples --count 45000"
    )
)
@with_settings
@flowing
def precompute(
    scene: Annotated[Path, typer.Argument(help="A Mitsuba XML file or a mesh.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="The asset to write.")
    ],
    settings: dict,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue an interrupted run of this file, if there is one."),
    ] = False,
    max_memory: Annotated[
        str | None,
        typer.Option(
            "--max-memory", metavar="BYTES", help="Such as 3G; default: half of what is free."
        ),
    ] = None,
    force: Force = False,
    threads: Threads = None,
    variant: Variant = None,
    define: Define = None,
    floor: Floor = False,
    as_json: Json = False,
):
    """Precompute a scene's transport into one file.

    What the scene's emitters call for is built: transport of distant light for a sky, exact columns
    for its own lamps; transport for lamps that move is built when it is asked for. What is computed
    on the way is kept in FILE.partial until FILE is whole: a run that is interrupted or killed can
    be continued with --resume, and gives the same file.
    """
    from ..precompute.precompute import measure
    from ..system.files import check_writable

    check_writable(output)
    take.use(threads, variant)
    started = time.perf_counter()
    with progress_bar(kept=f"{output}.partial") as progress:
        asset, cost = measure(
            scene,
            take.parameters_of(define, floor),
            progress,
            output,
            resume,
            max_memory,
            force,
            **settings,
        )
    cost["seconds"]["total"] = round(time.perf_counter() - started, 4)
    for entry in asset.scene["left_out"]:
        shapes = f" ({', '.join(entry['shapes'][:5])})" if entry["shapes"] else ""
        note(f"not modelled: {entry['what']}{shapes}")
    held = {kind: _short(transport.summary()) for kind, transport in asset.transports.items()}
    result = {
        "points": len(asset.points),
        "kind_of_points": asset.settings["points"],
        "transports": held,
        "bytes": output.stat().st_size,
        **cost,
    }
    _show(result if as_json else {"wrote": str(output)} | result, as_json)


@app.command(
    epilog=LIGHTS_HELP
    + (
        "Examples: mi-prt relight teapot.prt -o teapot.png --envmap sky.exr --rotate y:90 --size"
        " 640x480\n\nmi-prt relight room.prt -o dusk.png --light 'scene:sky_1*0.05' --light"
        " scene:floor_lamp\n\nmi-prt relight room.prt -o lamp.png --light point:0,1.5,0:8,7,6"
        " --component indirect\n\nmi-prt relight teapot.prt -o 'out/{map}_{sensor}.png' --envmap"
        " skies --sensor all\n\nmi-prt relight teapot.prt -o near.png --camera 0,2,6:0,0.5,0:45"
        "\n\nmi-prt relight room.prt -o walk.mp4 --light point:0,1.5,0:8,7,6"
        " --light-path '-1,1.5,0 1,1.5,0 1,1.5,1' --renderer raster\n\nmi-prt relight teapot.prt"
        " -o day.mp4 --envmap sky.exr --turn y:360 --renderer raster"
    )
)
@flowing
def relight(
    asset_path: Annotated[Path, typer.Argument(metavar="FILE", help="An asset.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help=".exr, .png, .ply or .npz; of a film .mp4, .gif or frame-%03d.png; of several maps"
            " or sensors with {map} and {sensor} in its name",
        ),
    ],
    envmap: Environments = None,
    light: Lights = None,
    nearest: Nearest = None,
    rotate: Rotate = None,
    sensor: Sensors = None,
    camera: Viewpoint = None,
    size: Size = None,
    renderer: Annotated[
        str, typer.Option("--renderer", metavar="mitsuba|raster", help="How pictures are drawn.")
    ] = "mitsuba",
    spp: Annotated[int, typer.Option("--spp", help="Samples per pixel of mitsuba's image.")] = 64,
    component: Component = "total",
    direct: Direct = "points",
    light_path: Annotated[
        str | None,
        typer.Option(
            "--light-path",
            metavar="'x,y,z x,y,z …'",
            help="Move the first --light along these places; OUT is a film.",
        ),
    ] = None,
    turn: Annotated[
        str | None,
        typer.Option(
            "--turn",
            metavar="AXIS:DEGREES",
            help="Turn distant light by so much, in equal steps; OUT is a film.",
        ),
    ] = None,
    frames: Frames = None,
    fps: FramesPerSecond = None,
    exposure: Exposure = "auto",
    scene: OtherScene = None,
    force: Force = False,
    threads: Threads = None,
    variant: Variant = None,
    as_json: Json = False,
):
    """Relight an asset: an image, a mesh with vertex radiance, plain arrays, or a film of a light
    that moves.
    """
    from ..asset.asset import load
    from ..output.film import light_path as path_of
    from ..output.many import ALL, map_files, relight_many
    from ..output.moving import animate

    take.use(threads, variant)
    maps, sensors = map_files(envmap or []), take.sensors_of(sensor, camera)
    turned = take.rotation_of(rotate)
    asset = load(asset_path)
    shown = {
        "scene": scene,
        "size": take.size_of(size),
        "renderer": renderer,
        "spp": spp,
        "component": component,
        "direct": direct,
        "rotate": turned,
        "force": force,
        "exposure": exposure,
    }
    film = {k: v for k, v in (("frames", frames), ("fps", fps)) if v is not None}
    if light_path is not None or turn is not None:
        if len(maps) > 1 or sensors == ALL:
            raise SettingsError(
                "--light-path and --turn make one film: give one --envmap at most, and one --sensor"
            )
        path = None if light_path is None else path_of(light_path)
        chosen = take.light_of(maps[0] if maps else None, light)
        with progress_bar() as progress:
            result = animate(
                asset,
                output,
                path,
                light=chosen,
                sensor=sensors[0],
                turn=take.rotation_of(turn),
                progress=progress,
                **film,
                **shown,
            )
    elif film:
        raise SettingsError("--frames and --fps are of a film: give --light-path or --turn as well")
    else:
        lights = take.light_of(None, light)
        files = relight_many(asset, output, maps, sensors, lights, nearest=nearest, **shown)
        if len(files) > 1:
            _show({"files": files}, as_json)
            return
        output = files[0].pop("file")
        result = {k: v for k, v in files[0].items() if k not in ("map", "sensor")}
    _show(result if as_json else {"wrote": str(output)} | result, as_json)


@app.command(
    epilog=LIGHTS_HELP
    + (
        "Examples: mi-prt compare teapot.prt -o teapot-report --spp 512 --json\n\nmi-prt compare"
        " room.prt -o room-report --light point:0,1.5,0:8,7,6"
    )
)
@flowing
def compare(
    asset_path: Annotated[Path, typer.Argument(metavar="FILE", help="An asset.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the report.")
    ],
    envmap: Environment = None,
    light: Lights = None,
    nearest: Nearest = None,
    rotate: Rotate = None,
    sensor: Sensors = None,
    camera: Viewpoint = None,
    size: Size = None,
    spp: Annotated[int, typer.Option("--spp", help="Samples per pixel of the reference.")] = 256,
    reference: Annotated[
        str,
        typer.Option(
            "--reference",
            metavar="modelled|full",
            help="Truth with the materials that are modelled, or as the scene is written.",
        ),
    ] = "modelled",
    direct: Direct = "points",
    scene: OtherScene = None,
    seed: Seed = 0,
    force: Force = False,
    threads: Threads = None,
    variant: Variant = None,
    as_json: Json = False,
):
    """Compare an asset with Mitsuba's ground truth and write a report with pictures."""
    from ..asset.asset import load
    from ..evaluate.compare import compare as run

    take.use(threads, variant)
    sensors = take.sensors_of(sensor, camera)
    if sensors == "all":
        raise SettingsError("--sensor all is of relight: a report has one picture, give an index")
    asset = load(asset_path)
    with progress_bar() as progress:
        result = run(
            asset,
            output,
            take.light_of(envmap, light),
            rotate=take.rotation_of(rotate),
            scene=scene,
            sensor=sensors[0],
            size=take.size_of(size),
            spp=spp,
            reference=reference,
            seed=seed,
            progress=progress,
            nearest=nearest,
            direct=direct,
            force=force,
        )
    _show(result if as_json else {"wrote": str(output / "index.html")} | result, as_json)


def _show(found, as_json):
    print_json(found) if as_json else print_nested(found)


def _short(summary):
    """A transport's summary without its longest entries."""
    return {
        name: value
        for name, value in summary.items()
        if name != "storage" and not name.endswith("_per_component")
    }
