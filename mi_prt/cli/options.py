"""Options of the command line; those of a precomputation are made from its settings."""

import inspect
import re
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import SettingsError
from ..lighting.part import LIGHTS
from ..output.film import FPS, FRAMES
from ..precompute.options import Flag
from ..precompute.settings import OPTIONS

_PANELS = {
    "general": "What is precomputed",
    "vertices": "Points: vertices",
    "samples": "Points: samples",
    "distant": "Transport: distant light",
    "own": "Transport: the scene's own lamps",
    "local": "Transport: lamps that move",
}


def _unmarked(text):
    """Text in which a bracket before a letter is no markup."""
    return re.sub(r"\[(?=[a-z])", r"\\[", text)


Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")
]
Threads = Annotated[
    int | None, typer.Option("--threads", metavar="N", help="CPU threads; default: all cores.")
]
Variant = Annotated[
    str | None,
    typer.Option(
        "--variant",
        metavar="NAME",
        help="What Mitsuba computes on: llvm_ad_rgb, the default, or cuda_ad_rgb (docs/cuda.md).",
    ),
]
Define = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        metavar="NAME=VALUE",
        help="Value for a <default> parameter of the XML; of a mesh normals=flat, up=z, grey=0.5.",
    ),
]
Floor = Annotated[bool, typer.Option("--floor", help="Put a grey floor under a mesh.")]
Environment = Annotated[
    Path | None,
    typer.Option(
        "--envmap",
        metavar="MAP",
        help="Environment map (+y is up): .exr, .hdr, .pfm, .png and others; default: the scene's"
        " own light.",
    ),
]
Environments = Annotated[
    list[Path] | None,
    typer.Option(
        "--envmap",
        metavar="MAP",
        help="Environment map (+y is up), or a folder of them; may be repeated: each gives a file,"
        " see -o. Default: the scene's own light.",
    ),
]
Lights = Annotated[
    list[str] | None,
    typer.Option(
        "--light",
        metavar="SPEC",
        help="A light, see below. May be repeated: lights add up, also to --envmap.",
    ),
]
Component = Annotated[
    str, typer.Option("--component", metavar="total|direct|indirect", help="Of light.")
]
Direct = Annotated[
    str,
    typer.Option(
        "--direct",
        metavar="points|pixels",
        help="Direct light of lamps at the points, or by shadow rays at pixels.",
    ),
]
Exposure = Annotated[
    str,
    typer.Option(
        "--exposure",
        metavar="EV|auto",
        help="Of displayed pictures: 0 shows radiance 1 as white, one more twice the light; auto:"
        " mid grey on average, for a film that of its first frame.",
    ),
]
Nearest = Annotated[
    int | None,
    typer.Option(
        "--nearest",
        metavar="K",
        help="Directions in equal shares that stand for a lamp where only distant transport is"
        " there; by default the three around it, weighted to keep its direction.",
    ),
]
Rotate = Annotated[
    str | None,
    typer.Option(
        "--rotate", metavar="AXIS:DEGREES", help="Turn distant light about x, y, z or a,b,c."
    ),
]
OtherScene = Annotated[
    Path | None,
    typer.Option("--scene", metavar="SCENE", help="The asset's scene, if it is elsewhere by now."),
]
Sensors = Annotated[
    str | None,
    typer.Option(
        "--sensor", metavar="N|all", help="Index of the scene's sensor [0], or all, see -o."
    ),
]
Viewpoint = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="FROM:TO[:FOV[:UP]]",
        help="A camera of your own, such as 0,2,6:0,0.5,0:45; FOV in degrees, UP x, y or z.",
    ),
]
Size = Annotated[
    str | None, typer.Option("--size", metavar="WxH", help="Image size; default: the sensor's.")
]
Frames = Annotated[
    int | None, typer.Option("--frames", metavar="N", help=f"Of the film [{FRAMES}].")
]
FramesPerSecond = Annotated[
    int | None, typer.Option("--fps", metavar="N", help=f"Frames of the film in a second [{FPS}].")
]
Force = Annotated[
    bool, typer.Option("--force", help="Replace a file that was not written by mi-prt.")
]
Seed = Annotated[int, typer.Option("--seed", help="Same seed, same result.")]

LIGHTS_HELP = "\n\n".join(
    [
        "Lights:",
        *(_unmarked(LIGHTS[kind].FORM) for kind in sorted(LIGHTS)),
        "Each with a factor if need be: *0.3 or *r,g,b. In the place of r,g,b one number is grey.",
        "",
    ]
)


def flowing(command):
    """A command whose help has no line breaks but those between paragraphs."""
    paragraphs = inspect.cleandoc(command.__doc__).split("\n\n")
    command.__doc__ = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    return command


def with_settings(command):
    """A command whose parameter `settings` is a dict of the settings that the user gave; each is an
    option of its own.
    """
    signature = inspect.signature(command)
    names = [option.name for option in OPTIONS]
    parameters = [p for p in signature.parameters.values() if p.name != "settings"]
    parameters += [_parameter(option) for option in OPTIONS]

    @wraps(command)
    def run(**arguments):
        settings = {name: arguments.pop(name) for name in names}
        given = {name: value for name, value in settings.items() if value is not None}
        return command(settings=given, **arguments)

    run.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportAttributeAccessIssue]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def _parameter(option):
    """A keyword parameter for Typer; None where the user does not give it."""
    flag = "--" + option.name.replace("_", "-")
    default = "" if option.default in (None, False) else f" [{_shown(option.default)}]"
    panel = _PANELS[option.group]
    rest: dict[str, Any] = {"help": _unmarked(option.help + default), "rich_help_panel": panel}
    if isinstance(option, Flag):
        kind = typer.Option(f"{flag}/--no-{flag[2:]}", show_default=False, **rest)
        annotation = Annotated[bool | None, kind]
    else:
        annotation = Annotated[str | None, typer.Option(flag, metavar=option.metavar, **rest)]
    return inspect.Parameter(
        option.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )


def _shown(value):
    if value is True:
        return "on"
    return f"{value:,}" if isinstance(value, int) else str(value)


# --- what the user passes ------------------------------------------------------------------------


def parameters_of(define, floor=False):
    """Values for `<default>` parameters, or of a mesh, from NAME=VALUE texts and --floor."""
    parameters = {"floor": "on"} if floor else {}
    for entry in define or []:
        name, equals, value = entry.partition("=")
        if not (name and equals):
            raise SettingsError(f"-D {entry} is not of the form NAME=VALUE")
        parameters[name] = value
    return parameters


def light_of(envmap, specs):
    """The sum of --envmap and all --light; None if there is neither."""
    from ..lighting.parse import parse_light

    lights = ([] if envmap is None else [envmap]) + [parse_light(spec) for spec in specs or []]
    return lights or None


def rotation_of(text):
    """Axis and degrees, or None."""
    from ..lighting.parse import parse_rotation

    return None if text is None else parse_rotation(text)


def sensors_of(sensor, camera) -> Any:
    """Sensors from --sensor and --camera: a sequence of int or Camera, or 'all'."""
    from ..scene.camera import Camera

    if camera is not None:
        if sensor is not None:
            raise SettingsError("--sensor and --camera both choose what is seen: give one of them")
        return (Camera.parse(camera),)
    if sensor in (None, "all"):
        return (0,) if sensor is None else sensor
    if not sensor.isdecimal():
        raise SettingsError(f"--sensor must be the index of a sensor, or all, got '{sensor}'")
    return (int(sensor),)


def size_of(text):
    """Width and height, or None."""
    if text is None:
        return None
    width, times, height = text.lower().partition("x")
    if not (times and width.isdigit() and height.isdigit()):
        raise SettingsError(f"--size {text} is not of the form WxH, for example 640x480")
    return int(width), int(height)


def use(threads, variant):
    """Use so many CPU threads and a variant of Mitsuba; None leaves them."""
    if variant is not None:
        from ..system.runtime import set_variant

        set_variant(variant)
    if threads is not None:
        from ..system.runtime import set_threads

        set_threads(threads)
