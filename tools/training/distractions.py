"""What else is in the air of a rendered scene: birds and other things that are no drones, and how they move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.sim.renderer.distractors import Distractor, Placed, bag, balloon, bird, kite, mast
from tools.training.dataset import HEIGHT, WIDTH
from tools.training.scenes import attitude

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Distraction:
    """A thing on its way."""

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

    def at(self, time_s: float) -> Placed:
        """As it is after some time."""
        amplitude, phase, rate = self.beat
        roll, pitch, yaw = self.turn * time_s
        return Placed(
            self.thing.flapped(amplitude * np.sin(phase + rate * time_s)),
            self.R_ned_body @ attitude(yaw, np.array([roll, pitch])),
            self.place + self.velocity * time_s,
        )


def drawn_distractions(
    count: int, position: Array, R_ned_camera: Array, focal: float, ground: float, rng: np.random.Generator
) -> list[Distraction]:
    """So many, all over the camera's picture; ``ground``: its height."""
    rays = np.column_stack(
        [
            rng.uniform(-WIDTH / 2, WIDTH / 2, count) / focal,
            rng.uniform(-HEIGHT / 2, HEIGHT / 4, count) / focal,
            np.ones(count),
        ]
    )
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return [drawn_distraction(position, ray, ground, rng) for ray in rays @ R_ned_camera.T]


def drawn_distraction(position: Array, ray: Array, ground: float, rng: np.random.Generator) -> Distraction:
    """One in the direction of a ray (3,), NED; six out of ten are birds."""
    place = position + ray * np.exp(rng.uniform(np.log(1.5), np.log(30.0)))
    place[2] = min(place[2], -(ground + 0.5))
    heading, still, level = rng.uniform(-np.pi, np.pi), np.zeros(3), (0.0, 0.0, 0.0)
    drift = np.append(rng.normal(0, 0.7, 2), rng.normal(0, 0.3))
    kind = rng.choice(["bird", "balloon", "kite", "bag", "mast"], p=[0.6, 0.1, 0.1, 0.1, 0.1])
    if kind == "bird":
        thing = bird(rng)
        velocity = rng.uniform(0, 9) * np.array([np.cos(heading), np.sin(heading), rng.normal(0, 0.15)])
        # Small birds beat fast, and now and then every bird glides.
        beat = (rng.choice([0.1, 0.8]) * rng.uniform(0.5, 1.0), rng.uniform(0, 2 * np.pi), 12.0 / thing.size_m**0.5)
        return Distraction(
            thing, place, velocity, attitude(heading, rng.normal(0, (0.45, 0.25))), rng.normal(0, 0.4, 3), beat
        )
    if kind == "balloon":
        return Distraction(
            balloon(rng), place, drift, attitude(heading, rng.normal(0, 0.15, 2)), rng.normal(0, 0.3, 3), level
        )
    if kind == "kite":
        lean = np.array([rng.normal(0, 0.3), rng.uniform(0.3, 1.3)])
        return Distraction(kite(rng), place, drift, attitude(heading, lean), rng.normal(0, 0.5, 3), level)
    if kind == "bag":
        return Distraction(
            bag(rng), place, 2 * drift, attitude(heading, rng.normal(0, 0.8, 2)), rng.normal(0, 1.5, 3), level
        )
    place[2] = -(ground + rng.uniform(2.5, 7.0))
    return Distraction(mast(rng, -place[2] - ground + 1.0), place, still, attitude(heading, np.zeros(2)), still, level)
