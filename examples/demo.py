"""The main job: precompute a scene, relight it under a turning sky, draw in two ways, compare with
Mitsuba; a room by day, at dusk and at night from one asset; and a lamp that moves.

Usage: python examples/demo.py [--out out/demo] [--frames 24]
"""

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image

import mi_prt
from mi_prt.evaluate import ground_truth
from mi_prt.lighting.from_mitsuba import scene_light
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.output.film import light_path
from mi_prt.output.moving import animate
from mi_prt.render.display import display, exposure
from mi_prt.render.image import render_image, resized
from mi_prt.render.image_file import write_displayed
from mi_prt.render.picture import Picture
from mi_prt.scene.scene import open_scene

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT / "scenes" / "still_life.xml"
DAY_ROOM = ROOT / "scenes" / "day_room.xml"
ROOM = ROOT / "scenes" / "room.xml"
LAMPS = ("ceiling_lamp", "floor_lamp", "desk_lamp")
HOURS = {  # its own light: what shines, and how bright it is
    "day": ["scene:sky"],
    "dusk": ["scene:sky*0.05", *(f"scene:{lamp}" for lamp in LAMPS)],
    "night": ["scene:ceiling_lamp*0.1", "scene:floor_lamp", "scene:desk_lamp"],
}
WALK = "1.6,1.7,1.6 -0.6,1.7,1.5 0.1,1.6,0.2 0.1,1.6,-1.4 -1.6,1.7,-1.8"  # through the doorway
FRAME_SIZE = (400, 300)
ROOM_SIZE = (320, 200)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "demo", help="folder for the results"
    )
    parser.add_argument("--frames", type=int, default=24, help="frames of the turning sky")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()

    say(f"1. precompute the transport of {SCENE.name} (once)")
    asset = mi_prt.precompute(SCENE, coefficients=128, rays_per_direction=4)
    asset.save(arguments.out / "still_life.prt")
    found = asset.transports["distant"].report
    say(
        f"   {len(asset.points):,} points, {found['rays']:,} rays, {found['bounces']} reflections,"
        f" {found['captured_variance']:.2%} of the variance"
    )

    say("2. turn the sky around it")
    sky = arguments.out / "turning_sky.gif"
    turning_sky(asset, sky, arguments.frames)

    say("3. draw it by rasterization")
    raster = arguments.out / "raster.png"
    mi_prt.relight_to_file(asset, raster, renderer="raster", size=(640, 480))

    say("4. compare it with Mitsuba's path tracer")
    report = mi_prt.compare(asset, arguments.out / "report", size=(640, 480), spp=256)
    errors = report["image"]
    say(
        f"   image: relative RMSE {errors['relative_rmse']:.2%} (reference noise"
        f" {errors['reference_noise']:.2%}), bias {errors['bias']:+.2%}, PSNR {errors['psnr']:.1f}"
        f" dB, FLIP {errors['flip']:.3f}"
    )
    say(f"5. {DAY_ROOM.name} by day, at dusk and at night, from one asset")
    hours = arguments.out / "hours.png"
    day_to_night(hours)
    say(f"6. carry a lamp through the two rooms of {ROOM.name}")
    walk = arguments.out / "walk.gif"
    carried_lamp(walk, arguments.frames)
    say(f"done in {time.perf_counter() - started:.0f} s")
    for what, path in (
        ("asset", arguments.out / "still_life.prt"),
        ("turning sky", sky),
        ("raster image", raster),
        ("comparison, side by side", arguments.out / "report" / "side_by_side.png"),
        ("report page", arguments.out / "report" / "index.html"),
        ("day, dusk and night; below, Mitsuba", hours),
        ("carried lamp", walk),
    ):
        say(f"  {what}: {path}")


def turning_sky(asset, path, frames):
    """Write an animation of the asset under its scene's own light turning about the vertical."""
    scene = open_scene(SCENE)
    own = scene_light(scene)
    prepared = asset.prepare_light(own)
    pictures, relighting, factor = [], [], None
    for frame in range(frames):
        degrees = 360 * frame / frames
        begun = time.perf_counter()
        radiance = asset.relight(prepared.rotated("y", degrees))
        relighting.append(time.perf_counter() - begun)
        factor = factor or exposure(radiance)
        turned = lit_scene(scene, own.rotated("y", degrees))
        with resized(turned.sensors()[0], FRAME_SIZE) as sensor:
            shown = display(render_image(asset, turned, sensor, spp=16), factor)
        pictures.append(Image.fromarray((shown * 255 + 0.5).astype("uint8")))
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=80, loop=0)
    say(
        f"   turn, project and relight {len(asset.points):,} points:"
        f" {1e3 * sorted(relighting)[frames // 2]:.1f} ms a frame"
    )


def day_to_night(path):
    """Write pictures of a room under its sky and lamps, relit above, path-traced below."""
    begun = time.perf_counter()
    asset = mi_prt.precompute(DAY_ROOM, count=15_000, paths_per_point=256, lamp_rays=1024)
    say(
        f"   {len(asset.points):,} {asset.settings['points']}, transports"
        f" {', '.join(asset.transports)}, {time.perf_counter() - begun:.0f} s"
    )
    scene, rows = open_scene(DAY_ROOM), [[], []]
    for hour, light in HOURS.items():
        picture = Picture(asset, scene, asset.resolved(light, scene=scene))
        begun = time.perf_counter()
        irradiance = picture.irradiance()
        seconds = time.perf_counter() - begun
        with picture.drawn(size=ROOM_SIZE, spp=32) as draw:
            images = [draw(irradiance)]
        lit = lit_scene(scene, picture.light, modelled=True)
        with resized(lit.sensors()[0], ROOM_SIZE) as sensor:
            images.append(ground_truth.image(lit, sensor, 64, 0, -1).mean)
        for row, image in zip(rows, images):
            row.append(display(image, picture.exposure()))
        say(f"   {hour}: relit in {1e3 * seconds:.0f} ms")
    write_displayed(path, np.concatenate([np.concatenate(row, axis=1) for row in rows]))


def carried_lamp(path, frames):
    """Write an animation of a point light on its way from one room to the other, direct and
    reflected light.
    """
    begun = time.perf_counter()
    asset = mi_prt.precompute(
        ROOM,
        points="samples",
        transports="local",
        count=12_000,
        cluster_size=300,
        depth_directions=1024,
    )
    say(
        f"   {len(asset.points):,} samples, {len(asset.transports['local'].clusters)} clusters,"
        f" {time.perf_counter() - begun:.1f} s"
    )
    way = light_path(WALK)
    lamp = mi_prt.PointLight(way.positions(1)[0], (3.2, 2.9, 2.5))
    told = animate(asset, path, way, frames, fps=12, light=lamp, size=(480, 300), renderer="raster")
    say(
        f"   direct light and all reflections: {1e3 * told['seconds']['relight'] / frames:.1f} ms a"
        " frame"
    )


def say(text):
    print(text, flush=True)


if __name__ == "__main__":
    main()
