"""Draws the pictures of the documentation that come from flights and from the code.

    flockd sim --perception truth --out FLIGHT
    python -m tools.docs.docs_pictures flock FLIGHT docs/pictures/flock.gif       # the flock, animated
    flockd sim --duration 5 --drones 3 --out SHORT
    python -m tools.docs.docs_pictures seen SHORT docs/pictures/seen.webp         # what a drone sees
    python -m tools.docs.docs_pictures world config/forest.yaml docs/pictures/forest.webp      # what stands at the
    start
    python -m tools.docs.docs_pictures clip tests/review/replay/crossing.mcap docs/pictures/crossing.webm

    python -m tools.docs.docs_pictures above FLIGHT docs/pictures/circle.webp     # a short clip for the gallery

detected.webp is what `flockd detect` draws; the other pictures are drawn by hand.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from flockd.core.messages import FloatArray
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.filmstrip import load_plates
from flockd.review.report.flight_folder import KEY_FRAMES_NAME, LOG_NAME
from flockd.review.report.flight_video import write_video
from flockd.review.report.style import GRID, INK, MUTED, PAPER, colour_of
from flockd.sim.scenario import load_scenario

FRAME_MS = 50
SIZE_IN, DPI = (7.6, 3.23), 100
DEPTH_SHARE = 0.5
"""How much of a length on the ground away from the viewer is drawn upwards."""
TRAIL_STEPS = 24
ARM_M = 0.8
"""Arm of a drone as drawn, larger than it is."""
COLOURS = 48
CLIP_SCALE = 0.75
CLIP_PX, CLIP_FRAMES, CLIP_MS = 320, 80, 100
OBSTACLE = "#b9a98a"
WORLD_ROWS = slice(80, 480)
"""Rows of the images of a world, without much sky and ground."""


def main() -> None:
    """Reads the command line and draws."""
    parser = argparse.ArgumentParser(description="Draws the pictures of the documentation.")
    kinds = parser.add_subparsers(dest="kind", required=True)
    world = kinds.add_parser("world")
    world.add_argument("scenario", type=Path, help="of `flockd sim`")
    world.add_argument("out", type=Path)
    for kind in ("flock", "seen", "above"):
        of_flight = kinds.add_parser(kind)
        of_flight.add_argument("flight", type=Path, help="folder of a flight of `flockd sim`")
        of_flight.add_argument("out", type=Path)
    clip = kinds.add_parser("clip")
    clip.add_argument("recording", type=Path)
    clip.add_argument("out", type=Path)
    args = parser.parse_args()
    if args.kind == "flock":
        save_flock(FlightLog.load(args.flight / LOG_NAME), args.out)
    elif args.kind == "above":
        save_above(FlightLog.load(args.flight / LOG_NAME), args.out)
    elif args.kind == "seen":
        save_seen(args.flight / KEY_FRAMES_NAME, args.out)
    elif args.kind == "world":
        save_world(args.scenario, args.out)
    else:
        save_clip(args.recording, args.out)
    print(f"{args.out}: {args.out.stat().st_size / 1e3:.0f} kB")


def save_clip(recording_file: Path, path: Path) -> None:
    """A recording's video, small enough for a page."""
    write_video(path, Recording(recording_file), scale=CLIP_SCALE)


def save_world(scenario_file: Path, path: Path) -> None:
    """What the first drone of a scenario sees as it starts, from its left to its right."""
    from flockd.sim.cameras.camera_simulator import CameraSimulator  # noqa: PLC0415 - numba takes its time
    from flockd.sim.flock.exact_states import start_yaw  # noqa: PLC0415
    from flockd.sim.vehicles.vehicles import Vehicles  # noqa: PLC0415

    scenario = load_scenario(scenario_file)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=start_yaw(scenario), seed=scenario.seed)
    frames, _ = CameraSimulator(scenario).capture(0, 0, 0.0, vehicles)
    images = np.hstack([frames.frames[name].image for name in ("left", "front", "right")])
    middle = Image.fromarray(images[WORLD_ROWS])
    middle.resize((middle.width * 2 // 3, middle.height * 2 // 3), Image.Resampling.LANCZOS).save(path, quality=78)


def save_above(log: FlightLog, path: Path) -> None:
    """A short animated clip of a flight from above, north up, with obstacles and goals."""
    steps = np.unique(np.linspace(0, len(log.time_s) - 1, CLIP_FRAMES).astype(int))
    plan = log.position[..., :2]
    low, high = plan.reshape(-1, 2).min(axis=0), plan.reshape(-1, 2).max(axis=0)
    middle, reach_m = (low + high) / 2, 0.56 * float((high - low).max()) + 1.0
    scale = CLIP_PX / (2 * reach_m)

    def pixels(places: FloatArray) -> list[tuple[float, float]]:
        off = (places - middle) * scale
        return [(CLIP_PX / 2 + east, CLIP_PX / 2 - north) for north, east in off]

    frames = []
    for step in steps:
        image = Image.new("RGB", (CLIP_PX, CLIP_PX), PAPER)
        pen = ImageDraw.Draw(image)
        for north, east, length_m, width_m, heading, *_ in log.obstacles.tolist():
            if width_m == 0:
                ((u, v),) = pixels(np.array([[north, east]]))
                radius = max(length_m * scale, 1.0)
                pen.ellipse((u - radius, v - radius, u + radius, v + radius), fill=OBSTACLE)
            else:
                turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
                corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length_m, width_m] @ turn.T
                pen.polygon(pixels(corners + np.array([north, east])), fill=OBSTACLE)
        drones = plan.shape[1]
        for i in range(drones):
            trail = pixels(plan[max(0, step - 2 * TRAIL_STEPS) : step + 1, i])
            if len(trail) > 1:
                pen.line(trail, fill=colour_of(i, drones), width=1)
            u, v = trail[-1]
            pen.ellipse((u - 4, v - 4, u + 4, v + 4), fill=colour_of(i, drones))
        if np.isfinite(log.goal[step]).all():
            ((u, v),) = pixels(log.goal[step][None])
            pen.line((u - 5, v - 5, u + 5, v + 5), fill=INK, width=2)
            pen.line((u - 5, v + 5, u + 5, v - 5), fill=INK, width=2)
        pen.text((6, CLIP_PX - 16), f"{log.time_s[step]:.0f} s", fill=MUTED)
        frames.append(image)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=CLIP_MS, loop=0, quality=60, method=4)


def save_flock(log: FlightLog, path: Path) -> None:
    """An animated GIF of a flight, seen obliquely from the east: north is to the right, west is up."""
    frames = [_flock_frame(log, step) for step in range(len(log.time_s))]
    palette = frames[len(frames) // 2].quantize(COLOURS, dither=Image.Dither.NONE)
    quantised = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    quantised[0].save(path, save_all=True, append_images=quantised[1:], duration=FRAME_MS, loop=0, optimize=True)


def _flock_frame(log: FlightLog, step: int) -> Image.Image:
    figure = Figure(figsize=SIZE_IN, dpi=DPI, facecolor=PAPER)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set(xlim=(-14.0, 54.0), ylim=(-15.5, 13.4))
    _draw_ground(axes)
    position = log.position
    first = max(0, step - TRAIL_STEPS)
    # From the far side to the near one, so that near drones cover far ones.
    for drone in np.argsort(position[step, :, 1]):
        colour = colour_of(int(drone), position.shape[1])
        path = position[: step + 1, drone]
        on_ground = path * [1.0, 1.0, 0.0]
        axes.plot(*_on_screen(on_ground).T, color=colour, alpha=0.22, linewidth=0.9)
        axes.plot(*_on_screen(path[first:]).T, color=colour, linewidth=1.6)
        axes.plot(*_on_screen(np.stack([path[-1], on_ground[-1]])).T, color=MUTED, linewidth=0.6)
        axes.plot(*_on_screen(on_ground[-1:]).T, "o", color=MUTED, markersize=2.5)
        _draw_drone(axes, path[-1], log.attitude[step, drone], colour)
    axes.text(-12.6, 11.6, f"t = {log.time_s[step]:5.1f} s", color=INK, fontsize=11, fontweight="bold", va="center")
    axes.text(-12.6, 9.6, "grid: 10 m, north to the right", color=MUTED, fontsize=8.5, va="center")
    return _image(figure)


def _on_screen(ned: FloatArray) -> FloatArray:
    """(n, 2) of (n, 3) metres NED: north right, west and up upwards."""
    return np.stack([ned[:, 0], -DEPTH_SHARE * ned[:, 1] - ned[:, 2]], axis=1)


def _draw_ground(axes: Axes) -> None:
    for north in range(-10, 51, 10):
        line = np.array([[north, -10.0, 0.0], [north, 30.0, 0.0]])
        axes.plot(*_on_screen(line).T, color=GRID, linewidth=0.8, zorder=0)
    for east in range(-10, 31, 10):
        line = np.array([[-10.0, east, 0.0], [50.0, east, 0.0]])
        axes.plot(*_on_screen(line).T, color=GRID, linewidth=0.8, zorder=0)


def _draw_drone(axes: Axes, position: FloatArray, R_ned_body: FloatArray, colour: str) -> None:
    angles = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    motors = ARM_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1) @ R_ned_body.T + position
    for one, other in ((0, 2), (1, 3)):
        axes.plot(*_on_screen(motors[[one, other]]).T, color=INK, linewidth=1.6, zorder=5)
    circle = np.linspace(0.0, 2.0 * np.pi, 13)
    ring = 0.42 * np.stack([np.cos(circle), np.sin(circle), np.zeros(13)], axis=1) @ R_ned_body.T
    for motor in motors:
        axes.fill(*_on_screen(ring + motor).T, facecolor=colour, edgecolor=INK, linewidth=0.5, zorder=6)


def save_seen(key_frames: Path, path: Path) -> None:
    """The last key frame of a flight: images with detections, depth, optical flow."""
    path.write_bytes(load_plates(key_frames)[-1].webp)


def _image(figure: Figure) -> Image.Image:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=figure.dpi)
    return Image.open(buffer).convert("RGB")


if __name__ == "__main__":
    main()
