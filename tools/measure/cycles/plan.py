"""What stands where in each moment: ground, trees, houses, sun, the own drone and its neighbours, from a seed alone.

Pure, numpy alone: Blender's Python reads it too. World axes are NED, the drone's FRD, metres and radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEP_S = 0.5
RANGES_M = (1.5, 15.0)
HEIGHTS_M = (2.5, 8.0)
"""Of the own drone above the ground."""
MOST_DRONES = 5
CLEAR_M = 3.5
"""Of trees and houses around each drone's way."""
EXTENT_M = 90.0
"""Trees and houses stand so far out."""
GROUNDS = ("meadow", "dry grass", "bare earth", "gravel")
PAINTS = ("its own", "white", "dark")
_APART_M = 1.2
_LEAST_HEIGHT_M = 1.0
_MOST_ELEVATION = math.radians(25.0)


@dataclass(frozen=True)
class Pose:
    """A drone at one instant."""

    position: tuple[float, float, float]
    """NED, metres."""
    roll_pitch_yaw: tuple[float, float, float]
    """Radians."""

    @property
    def rotation(self) -> Array:
        """(3, 3) R_ned_body."""
        return rotation(*self.roll_pitch_yaw)


@dataclass(frozen=True)
class Neighbour:
    """A drone that is looked at, before and after the step."""

    airframe: str
    paint: str
    seed: int
    poses: tuple[Pose, Pose]


@dataclass(frozen=True)
class Standing:
    """A tree, a bush or a house."""

    kind: str
    """``broadleaf``, ``conifer``, ``bush`` or ``house``."""
    north_east: tuple[float, float]
    size_m: float
    """Height; of a house half its width."""
    turn: float
    seed: int


@dataclass(frozen=True)
class Moment:
    """All that one pair of frame sets shows."""

    number: int
    seed: int
    ground: str
    relief: tuple[tuple[float, float, float, float], ...]
    """Waves of the ground: height (m), waves a metre to the north and to the east, phase."""
    sun_elevation: float
    sun_azimuth: float
    clouds: float
    """Share of the sky."""
    haze: float
    """Aerosols, 1 for a clear day."""
    own: tuple[Pose, Pose]
    neighbours: tuple[Neighbour, ...]
    standing: tuple[Standing, ...]


def moment(seed: int, number: int, airframes: tuple[str, ...]) -> Moment:
    """The ``number``-th moment of a seed; each comes out the same whichever others are made."""
    rng = np.random.Generator(np.random.PCG64([seed, number]))
    waves = 4
    relief = tuple(
        (float(h), float(k * math.cos(a)), float(k * math.sin(a)), float(p))
        for h, k, a, p in zip(
            rng.choice([0.02, 0.1, 0.2]) * rng.uniform(0.2, 1.0, waves),
            1.0 / rng.uniform(8.0, 50.0, waves),
            rng.uniform(0.0, 2.0 * math.pi, waves),
            rng.uniform(0.0, 2.0 * math.pi, waves),
            strict=True,
        )
    )
    own = _own(rng, relief)
    ways = [own]
    neighbours = []
    for _ in range(int(rng.integers(1, MOST_DRONES + 1))):
        poses = _neighbour(rng, own, ways, relief)
        ways.append(poses)
        neighbours.append(
            Neighbour(
                str(rng.choice(airframes)),
                str(rng.choice(PAINTS, p=[0.5, 0.25, 0.25])),
                int(rng.integers(1 << 30)),
                poses,
            )
        )
    return Moment(
        number=number,
        seed=seed,
        ground=str(rng.choice(GROUNDS, p=[0.4, 0.25, 0.2, 0.15])),
        relief=relief,
        sun_elevation=math.radians(rng.uniform(12.0, 65.0)),
        sun_azimuth=rng.uniform(0.0, 2.0 * math.pi),
        clouds=float(rng.choice([0.0, rng.uniform(0.2, 0.7), 0.95], p=[0.3, 0.45, 0.25])),
        haze=float(rng.uniform(0.5, 3.0)),
        own=own,
        neighbours=tuple(neighbours),
        standing=tuple(_standing(rng, ways)),
    )


def ground_height(relief: tuple[tuple[float, float, float, float], ...], north: Array, east: Array) -> Array:
    """Height of the ground, up positive, metres."""
    height: Array = np.zeros_like(np.asarray(north, np.float64))
    for amplitude, along_north, along_east, phase in relief:
        height = height + amplitude * np.sin(2.0 * math.pi * (along_north * north + along_east * east) + phase)
    return height


def painted(colours: Array, paint: str) -> Array:
    """(m, 3) linear colours of a drone of another paint, one of `PAINTS`; what is light stays lighter."""
    if paint == "white":
        colours = 0.65 + 0.3 * (colours - colours.mean(axis=0))
    if paint == "dark":
        colours = 0.02 + 0.1 * colours
    return np.clip(colours, 0.01, 0.9)


def blades(hub: Array, radius_m: float, turn: float) -> Array:
    """(4, 3) corners of a propeller of two blades, tip to tip, in body FRD; ``turn`` from forward, radians."""
    along = np.array([math.cos(turn), math.sin(turn), 0.0])
    across = 0.06 * radius_m * np.array([-along[1], along[0], 0.0])
    return np.array([hub + s * radius_m * along + w * across for s, w in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3) R_ned_body: yaw, then pitch, then roll."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _own(rng: np.random.Generator, relief: Any) -> tuple[Pose, Pose]:
    origin = np.zeros(1)
    up = float(ground_height(relief, origin, origin)[0]) + rng.uniform(*HEIGHTS_M)
    heading, yaw = rng.uniform(0.0, 2.0 * math.pi, 2)
    step_m = rng.uniform(0.2, 1.0)
    moved = np.array([step_m * math.cos(heading), step_m * math.sin(heading), rng.uniform(-0.1, 0.1)])
    lean, turn = rng.normal(0.0, math.radians(5.0), 2), rng.normal(0.0, np.radians([2.0, 2.0, 4.0]))
    return _pose(np.array([0.0, 0.0, -up]), [*lean, yaw]), _pose(
        np.array([0.0, 0.0, -up]) + moved, [lean[0] + turn[0], lean[1] + turn[1], yaw + turn[2]]
    )


def _neighbour(rng: np.random.Generator, own: tuple[Pose, Pose], ways: Any, relief: Any) -> tuple[Pose, Pose]:
    """Flies about as the own drone does, clear of all others and of the ground."""
    flown = np.subtract(own[1].position, own[0].position)
    for _ in range(1000):
        range_m = math.exp(rng.uniform(*np.log(RANGES_M)))
        azimuth, elevation = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-_MOST_ELEVATION, _MOST_ELEVATION)
        level = range_m * math.cos(elevation)
        offset = [level * math.cos(azimuth), level * math.sin(azimuth), -range_m * math.sin(elevation)]
        place = np.add(own[0].position, offset)
        after = place + flown * rng.uniform(0.3, 1.2) + rng.normal(0.0, [0.25, 0.25, 0.08])
        ends = np.array([place, after])
        above = -ends[:, 2] - ground_height(relief, ends[:, 0], ends[:, 1])
        apart = min(
            float(np.linalg.norm(np.subtract(end, other.position)))
            for way in ways
            for end, other in zip(ends, way, strict=True)
        )
        if above.min() > _LEAST_HEIGHT_M and apart > _APART_M:
            lean, turn = rng.normal(0.0, math.radians(7.0), 2), rng.normal(0.0, np.radians([3.0, 3.0, 5.0]))
            yaw = rng.uniform(0.0, 2.0 * math.pi)
            return _pose(place, [*lean, yaw]), _pose(after, [lean[0] + turn[0], lean[1] + turn[1], yaw + turn[2]])
    raise ValueError("no room for a neighbour: this cannot be with five drones in 15 m")


def _standing(rng: np.random.Generator, ways: Any) -> list[Standing]:
    """Trees and bushes in groups and alone, houses; none where a drone flies."""
    flown = np.array([pose.position[:2] for way in ways for pose in way])
    found = []
    kinds = ["house"] * int(rng.integers(0, 5))
    kinds.extend(["bush"] * int(rng.integers(5, 40)))
    kinds.extend(rng.choice(["broadleaf", "conifer"], int(rng.integers(40, 90)), p=[0.7, 0.3]).tolist())
    for kind in kinds:
        out = EXTENT_M * math.sqrt(rng.uniform(0.004, 1.0))
        angle = rng.uniform(0.0, 2.0 * math.pi)
        place = np.array([out * math.cos(angle), out * math.sin(angle)])
        size = {"house": (4.0, 8.0), "bush": (0.5, 2.0)}.get(kind, (4.0, 14.0))
        size_m = rng.uniform(*size)
        reach = {"house": 2.2, "bush": 1.0}.get(kind, 0.4) * size_m
        if np.linalg.norm(flown - place, axis=1).min() > CLEAR_M + reach:
            found.append(
                Standing(
                    kind,
                    (float(place[0]), float(place[1])),
                    size_m,
                    rng.uniform(0.0, 2 * math.pi),
                    int(rng.integers(4)),
                )
            )
    return found


def _pose(position: Array, angles: Any) -> Pose:
    north, east, down = (float(value) for value in position)
    roll, pitch, yaw = (float(value) for value in angles)
    return Pose((north, east, down), (roll, pitch, yaw))
