"""Which worlds and which drones are for what.

Training, validation and test worlds never meet; flights use seeds below all of them. Families are rows of
``flockd.sim.renderer.drone_models``: the unseen ones are left out of training, to test on drones that no network knows.
Shapes are those of ``tools.training.drone_generator``: training worlds have them besides the families.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from flockd.sim.scenario import ObstaclesConfig

Job = TypeVar("Job")
FLIGHTS = range(0, 1_000_000)
TRAINING = range(1_000_000, 2_000_000)
VALIDATION = range(2_000_000, 3_000_000)
TEST = range(3_000_000, 4_000_000)

FAMILIES = range(12)
UNSEEN_FAMILIES = range(12, 14)
SHAPES = range(400)
SHAPES_SHARE = 1 / 2
"""Share of the generator's shapes among the drones of training worlds, and among those that a training draws."""


def drawn_obstacles(seed: int, share: float) -> ObstaclesConfig | None:
    """What stands in the middle of a world to be flown around: nothing in all but ``share`` of the worlds."""
    rng = np.random.default_rng([seed, 5])
    if rng.random() >= share:
        return None
    extent_m, gap_m = float(rng.uniform(25.0, 45.0)), float(rng.uniform(1.2, 2.0))
    if rng.random() < 0.6:
        trees = float(np.exp(rng.uniform(np.log(50.0), np.log(400.0))))
        return ObstaclesConfig(kind="forest", extent_m=extent_m, min_gap_m=gap_m, trees_per_hectare=trees)
    houses = float(rng.uniform(4.0, 10.0))
    return ObstaclesConfig(kind="village", extent_m=extent_m, min_gap_m=gap_m, houses_per_hectare=houses)


def in_processes(render: Callable[[Job], None], jobs: Sequence[Job], processes: int | None) -> None:
    """Render each job's world in a process of its own; prints how many are done."""
    os.environ["NUMBA_NUM_THREADS"] = "1"
    begin = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for done, _ in enumerate(pool.imap_unordered(render, jobs), start=1):
            print(f"{done}/{len(jobs)} worlds, {time.monotonic() - begin:.0f} s", flush=True)
