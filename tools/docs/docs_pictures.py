"""Draws the pictures of the documentation that come from flights.

    flockd sim --duration 5 --drones 3 --out SHORT
    python -m tools.docs.docs_pictures seen SHORT docs/pictures/seen.webp         # what a drone sees
    python -m tools.docs.docs_pictures above FLIGHT docs/pictures/circle.webp     # a short clip for the gallery

Earlier versions of this program drew crossing.webm, flock.gif and the worlds; detected.webp is what `flockd detect`
draws; the other pictures are drawn by hand.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.filmstrip import load_plates
from flockd.review.report.flight_folder import KEY_FRAMES_NAME, LOG_NAME
from flockd.review.report.style import INK, MUTED, PAPER, colour_of

TRAIL_STEPS = 24
CLIP_PX, CLIP_FRAMES, CLIP_MS = 320, 80, 100
OBSTACLE = "#b9a98a"


def main() -> None:
    """Reads the command line and draws."""
    parser = argparse.ArgumentParser(description="Draws the pictures of the documentation.")
    kinds = parser.add_subparsers(dest="kind", required=True)
    for kind in ("seen", "above"):
        of_flight = kinds.add_parser(kind)
        of_flight.add_argument("flight", type=Path, help="folder of a flight of `flockd sim`")
        of_flight.add_argument("out", type=Path)
    args = parser.parse_args()
    if args.kind == "above":
        save_above(FlightLog.load(args.flight / LOG_NAME), args.out)
    else:  # the last key frame: images with detections, depth, optical flow
        args.out.write_bytes(load_plates(args.flight / KEY_FRAMES_NAME)[-1].webp)
    print(f"{args.out}: {args.out.stat().st_size / 1e3:.0f} kB")


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


if __name__ == "__main__":
    main()
