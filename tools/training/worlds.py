"""Seeds of worlds, drone families, attitudes and distractors of training, validation and test.

The seeds of training, validation and test do not overlap; flights use seeds below all of them. Families are rows of
``flockd.sim.renderer.drone_models``: the unseen ones are left out of training, to test on drones that no network knows.
Shapes are those of ``tools.training.drone_generator``: training worlds have them besides the families.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.geometry import rotation_from_euler
from flockd.sim.scenario import ObstaclesConfig
from tools.training.dataset import HEIGHT, WIDTH
from tools.training.distractors import Distractor, bag, balloon, bird, kite, mast

Array = NDArray[Any]
Job = TypeVar("Job")
FLIGHTS = range(0, 1_000_000)
TRAINING = range(1_000_000, 2_000_000)
VALIDATION = range(2_000_000, 3_000_000)
TEST = range(3_000_000, 4_000_000)

FAMILIES = range(12)
UNSEEN_FAMILIES = range(12, 14)
SHAPES = range(400)
HIDDEN_SHARE = 0.02
"""Hidden share of its outline below which a drone is whole."""
SHAPES_SHARE = 1 / 2
"""Share of the generator's shapes among the drones of training worlds, and among those that a training draws."""


def drawn_obstacles(seed: int, share: float) -> ObstaclesConfig | None:
    """A forest or a village in the middle of a world, with probability ``share``; else None."""
    rng = np.random.default_rng([seed, 5])
    if rng.random() >= share:
        return None
    extent_m, gap_m = float(rng.uniform(25.0, 45.0)), float(rng.uniform(1.2, 2.0))
    if rng.random() < 0.6:
        trees = float(np.exp(rng.uniform(np.log(50.0), np.log(400.0))))
        return ObstaclesConfig(kind="forest", extent_m=extent_m, min_gap_m=gap_m, trees_per_hectare=trees)
    houses = float(rng.uniform(4.0, 10.0))
    return ObstaclesConfig(kind="village", extent_m=extent_m, min_gap_m=gap_m, houses_per_hectare=houses)


def in_processes(render: Callable[[Job], None], jobs: Sequence[Job]) -> None:
    """Render each job's world in a process of its own; prints how many are done."""
    os.environ["NUMBA_NUM_THREADS"] = "1"
    begin = time.monotonic()
    with multiprocessing.get_context("spawn").Pool() as pool:
        for done, _ in enumerate(pool.imap_unordered(render, jobs), start=1):
            print(f"{done}/{len(jobs)} worlds, {time.monotonic() - begin:.0f} s", flush=True)


def attitude(yaw: float, tilt: NDArray[Any]) -> NDArray[np.float64]:
    """R_ned_body (3, 3) of a heading, and roll and pitch (2,); all rad."""
    roll, pitch = tilt
    return rotation_from_euler(roll, pitch, yaw)


def drawn_attitude(rng: np.random.Generator) -> NDArray[np.float64]:
    """R_ned_body (3, 3) of any heading, and the tilt of a multirotor in flight."""
    return attitude(rng.uniform(-np.pi, np.pi), rng.normal(0, np.radians(7), 2))


def is_whole(
    corners: Array, view: Any, matrix: Array, drone: int, size_m: float, begin: Sequence[int] = (0, 0)
) -> bool:
    """Whether a drone is inside the camera's image and hardly hidden.

    ``corners`` (n, 3): of its mesh, camera axes, m; ``matrix`` (3, 3): the view's pinhole K; ``drone``: its id there;
    ``begin``: column and row of the image where the view begins.
    """
    if corners[:, 2].min() < 0.05:
        return False
    pixels = corners @ matrix.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    if (pixels + begin < 1).any() or (pixels + begin > (WIDTH - 1, HEIGHT - 1)).any():
        return False
    outline = np.zeros(view.ids.shape, np.uint8)  # as if a thread ran around it
    cv2.fillConvexPoly(outline, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    middle_m = (corners[:, 2].min() + corners[:, 2].max()) / 2
    before = (view.depth < middle_m - size_m / 2) | ((view.ids > 0) & (view.ids != drone))
    return bool(np.count_nonzero(before & (outline > 0)) < HIDDEN_SHARE * np.count_nonzero(outline))


@dataclass(frozen=True, eq=False)
class Distraction:
    """A distractor in motion."""

    thing: Distractor
    place: Array
    """(3,) NED m, at time 0."""
    velocity: Array
    """(3,) m/s"""
    R_ned_body: Array
    turn: Array
    """(3,) roll, pitch and yaw rate, rad/s."""
    beat: tuple[float, float, float]
    """Beat of the wings: amplitude and phase, rad, and rad/s."""

    def at(self, time_s: float) -> tuple[Distractor, Array, Array]:
        """Its mesh after some time, its attitude R_ned_body (3, 3), and its place (3,) NED m."""
        amplitude, phase, rate = self.beat
        roll, pitch, yaw = self.turn * time_s
        return (
            self.thing.flapped(amplitude * np.sin(phase + rate * time_s)),
            self.R_ned_body @ attitude(yaw, np.array([roll, pitch])),
            self.place + self.velocity * time_s,
        )


def drawn_distractions(
    count: int, position: Array, R_ned_camera: Array, focal: float, ground: float, rng: np.random.Generator
) -> list[Distraction]:
    """Distractors all over the camera's picture; ``ground``: height of the ground, m."""
    right, down = rng.uniform(-WIDTH / 2, WIDTH / 2, count), rng.uniform(-HEIGHT / 2, HEIGHT / 4, count)
    rays = np.column_stack([right / focal, down / focal, np.ones(count)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return [drawn_distraction(position, ray, ground, rng) for ray in rays @ R_ned_camera.T]


def drawn_distraction(position: Array, ray: Array, ground: float, rng: np.random.Generator) -> Distraction:
    """A distractor in the direction of a ray (3,), NED; six out of ten are birds."""
    place = position + ray * np.exp(rng.uniform(np.log(1.5), np.log(30.0)))
    place[2] = min(place[2], -(ground + 0.5))
    heading, still = rng.uniform(-np.pi, np.pi), np.zeros(3)
    velocity, beat = np.append(rng.normal(0, 0.7, 2), rng.normal(0, 0.3)), (0.0, 0.0, 0.0)
    kind = rng.choice(["bird", "balloon", "kite", "bag", "mast"], p=[0.6, 0.1, 0.1, 0.1, 0.1])
    if kind == "bird":
        thing = bird(rng)
        velocity = rng.uniform(0, 9) * np.array([np.cos(heading), np.sin(heading), rng.normal(0, 0.15)])
        # Small birds beat fast, and now and then every bird glides.
        beat = (rng.choice([0.1, 0.8]) * rng.uniform(0.5, 1.0), rng.uniform(0, 2 * np.pi), 12.0 / thing.size_m**0.5)
        tilt, turn = rng.normal(0, (0.45, 0.25)), rng.normal(0, 0.4, 3)
    elif kind == "balloon":
        thing, tilt, turn = balloon(rng), rng.normal(0, 0.15, 2), rng.normal(0, 0.3, 3)
    elif kind == "kite":
        tilt, thing = np.array([rng.normal(0, 0.3), rng.uniform(0.3, 1.3)]), kite(rng)
        turn = rng.normal(0, 0.5, 3)
    elif kind == "bag":
        thing, tilt, turn, velocity = bag(rng), rng.normal(0, 0.8, 2), rng.normal(0, 1.5, 3), 2 * velocity
    else:
        place[2] = -(ground + rng.uniform(2.5, 7.0))
        thing, tilt, turn, velocity = mast(rng, -place[2] - ground + 1.0), np.zeros(2), still, still
    return Distraction(thing, place, velocity, attitude(heading, tilt), turn, beat)
