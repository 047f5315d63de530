"""Render drones cut out (RGBA), to be put onto photographs for training `detector` and `verification`.

    python -m tools.training.render_cutouts OUT --worlds 100
    python -m tools.training.render_cutouts OUT --mesh MY.glb --size-m 0.55 --worlds 20

OUT receives PNGs, 320 px wide and high with straight alpha, and `index.jsonl`, whose lines name them as `file`. The
shipped networks learnt from a folder of the same form that Blender's Cycles had rendered.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.sim.renderer.airframe import DroneModel
from tools.training import worlds
from tools.training.dataset import R_BODY_CAMERA
from tools.training.render_drone_crops import add_mesh, drawn_models, own_drone

SIZE_PX, FINER = 320, 3
"""Rendered so many times as large, for soft edges."""
FILL = (0.75, 0.95)
"""Share of the picture's width that the drone's size takes."""
RANGES_M, HEIGHTS_M = (1.2, 12.0), (15.0, 40.0)


@dataclass(frozen=True, eq=False)
class CutoutJob:
    """The cut-outs of one world."""

    folder: Path
    seed: int
    count: int
    own: Sequence[DroneModel]
    """The drone that is shown, in several states; empty: many kinds are."""


def main() -> None:
    """Render what OUT lacks, and write its index."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument("--each", type=int, default=60, help="cut-outs of a world")
    add_mesh(parser)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    own = own_drone(parser, arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)
    jobs = [CutoutJob(arguments.out, seed, arguments.each, own) for seed in worlds.TRAINING[::-1][: arguments.worlds]]
    worlds.in_processes(_render, [job for job in jobs if not _file(job, job.count - 1).is_file()], arguments.processes)
    names = sorted(file.name for file in arguments.out.glob("*.png"))
    (arguments.out / "index.jsonl").write_text("".join(json.dumps({"file": name}) + "\n" for name in names))


def _file(job: CutoutJob, number: int) -> Path:
    return job.folder / f"{job.seed}_{number:04d}.png"


def _render(job: CutoutJob) -> None:
    from flockd.sim.world.world import World  # noqa: PLC0415 - numba starts in the worker

    rng = np.random.Generator(np.random.PCG64([job.seed, 2]))
    world = World.generate(job.seed, ground_relief_m=0.0, keep_out=None)
    models = drawn_models(job.own, rng)
    for number in range(job.count):
        shape = models[int(rng.integers(len(models)))]
        image = cut_out(world, shape[int(rng.integers(len(shape)))], rng)
        cv2.imwrite(str(_file(job, number)), image[..., [2, 1, 0, 3]])


def cut_out(world: object, drone: DroneModel, rng: np.random.Generator) -> NDArray[np.uint8]:
    """(320, 320, 4) RGBA of a drone from anywhere, alpha straight."""
    from flockd.sim.renderer.renderer import Renderer  # noqa: PLC0415

    side = FINER * SIZE_PX
    range_m = float(np.exp(rng.uniform(*np.log(RANGES_M))))
    focal = side * rng.uniform(*FILL) * range_m / drone.size_m
    matrix = np.array([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    pitch = np.arcsin(rng.uniform(-1.0, 1.0)) if rng.random() < 0.2 else rng.uniform(-0.9, 0.9)
    R_ned_camera = worlds.attitude(rng.uniform(-np.pi, np.pi), np.array([rng.normal(0, 0.15), pitch])) @ R_BODY_CAMERA
    place = np.array([0.0, 0.0, -rng.uniform(*HEIGHTS_M)])
    view = Renderer(world, [drone]).render(  # type: ignore[arg-type]
        matrix, (side, side), R_ned_camera, place - range_m * R_ned_camera[:, 2],
        drone_rotations=worlds.drawn_attitude(rng)[None], drone_positions=place[None], shown=[0],
    )  # fmt: skip
    mine = (view.ids == 1).astype(np.float32)[:, :, None]
    both = np.concatenate([view.rgb * mine, 255.0 * mine], 2)
    small = cv2.resize(both, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
    colour = 255.0 * small[..., :3] / np.maximum(small[..., 3:], 1.0)
    cut: NDArray[np.uint8] = np.clip(np.rint(np.concatenate([colour, small[..., 3:]], 2)), 0, 255).astype(np.uint8)
    return cut


if __name__ == "__main__":
    main()
