"""A drone flies among boxes with a rig that is not as configured: what its autopilot says, and the pairs it sees."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flockd.core.messages import FloatArray, VehicleState
from flockd.flight.geometry import (
    PointPairs,
    Rig,
    RigCamera,
    RigidTransform,
    rotation_from_euler,
    rotation_from_vector,
    vector_from_rotation,
)
from flockd.ground.calibration.camera_motion import scaled_focal
from tests.flight.geometry.synthetic_world import Flaws, boxes_around, four_camera_rig, seen_twice

STEP_S = 0.5
FLAWS = Flaws(flow_sigma_px=0.3, depth_sigma=0.1, object_bias=0.1, outliers=0.03)


@dataclass(frozen=True)
class Way:
    """How a drone flies."""

    attitude: Callable[[float], FloatArray]
    position: Callable[[float], FloatArray]

    def pose(self, time_s: float) -> RigidTransform:
        return RigidTransform(self.attitude(time_s), self.position(time_s))


def lively(random: np.random.Generator) -> Way:
    """A circle of 10 m at 1 m/s, nose ahead, that leans and sways by some degrees at 0.1-0.9 Hz."""
    hz, phase = random.uniform(0.1, 0.9, (3, 6)), random.uniform(0.0, 2 * np.pi, (3, 6))

    def attitude(t: float) -> FloatArray:
        roll, pitch, yaw = math.radians(1.5) * np.sin(2 * np.pi * hz * t + phase).sum(axis=1)
        return rotation_from_euler(roll, pitch, yaw + 0.1 * t)

    return Way(attitude, lambda t: np.array([10 * math.sin(0.1 * t), 10 - 10 * math.cos(0.1 * t), -4.5]))


STRAIGHT = Way(lambda t: np.eye(3), lambda t: np.array([t, 0.0, -4.5]))
"""At 1 m/s, and never turns."""


class Autopilot:
    """The truth with errors that drift, attitude 0.2 degrees in 30 s, velocity 0.1 m/s in 10 s, and with jitter."""

    def __init__(self, way: Way, random: np.random.Generator, jitter_deg: float = 0.0) -> None:
        self._way, self._random, self._jitter_rad = way, random, math.radians(jitter_deg)
        self._turned, self._moved = (sigma * random.normal(size=3) for sigma in (math.radians(0.2), 0.1))

    def state(self, t: float) -> VehicleState:
        self._turned = self._drift(self._turned, math.radians(0.2), 30.0)
        self._moved = self._drift(self._moved, 0.1, 10.0)
        before, after = self._way.pose(t - 1e-3), self._way.pose(t + 1e-3)
        return VehicleState(
            t,
            rotation_from_vector(self._turned + self._jitter()) @ self._way.attitude(t),
            4.5,
            (after.translation - before.translation) / 2e-3 + self._moved,
            turn_rate=vector_from_rotation(before.rotation.T @ after.rotation) / 2e-3,
        )

    def _jitter(self) -> FloatArray:
        return self._jitter_rad * self._random.normal(size=3) if self._jitter_rad else np.zeros(3)

    def _drift(self, error: FloatArray, sigma: float, time_s: float) -> FloatArray:
        keep = math.exp(-STEP_S / time_s)
        return keep * error + math.sqrt(1 - keep**2) * sigma * self._random.normal(size=3)


@dataclass(frozen=True)
class Wrong:
    """What of a rig is not as configured: turns in body axes, rad, factors of focal lengths, and late time stamps."""

    turns: dict[str, FloatArray]
    focal: dict[str, float]
    late_s: float = 0.0

    @classmethod
    def turned(cls, turns: Mapping[str, Sequence[float]]) -> Wrong:
        """In nothing but how these are mounted."""
        names = CONFIGURED.cameras
        return cls({name: np.array(turns.get(name, (0.0, 0.0, 0.0))) for name in names}, dict.fromkeys(names, 1.0))

    @classmethod
    def by(cls, deg: float, focal: float, late_s: float, random: np.random.Generator) -> Wrong:
        """Each camera about an axis and with a focal length of its own."""
        axes = {name: random.normal(size=3) for name in CONFIGURED.cameras}
        return cls(
            {name: math.radians(deg) * axis / np.linalg.norm(axis) for name, axis in axes.items()},
            {name: 1.0 + focal * float(random.choice([-1, 1])) for name in axes},
            late_s,
        )

    def rig(self) -> Rig:
        turned = {
            name: RigidTransform(
                rotation_from_vector(self.turns[name]) @ one.T_body_camera.rotation, one.T_body_camera.translation
            )
            for name, one in CONFIGURED.cameras.items()
        }
        focal = {name: math.log(factor) for name, factor in self.focal.items()}
        lenses = {name: scaled_focal(one.camera, focal[name]) for name, one in CONFIGURED.cameras.items()}
        return Rig({name: RigCamera(name, lenses[name], mount) for name, mount in turned.items()})


CONFIGURED = four_camera_rig()
AS_CONFIGURED = Wrong.turned({})


def looks(
    way: Way,
    wrong: Wrong,
    random: np.random.Generator,
    steps: int = 120,
    jitter_deg: float = 0.0,
    said: Way | None = None,
    readout_s: float = 0.0,
) -> Iterator[tuple[VehicleState, VehicleState, PointPairs]]:
    """So many pairs of half a second; `said`: the way that the autopilot tells, if another."""
    true, world = wrong.rig(), boxes_around(random, 20)
    autopilot, before = Autopilot(said or way, random, jitter_deg), None
    for number in range(steps + 1):
        t = number * STEP_S
        state, pose = autopilot.state(t), way.pose(t - wrong.late_s)
        if before is not None:
            pairs = seen_twice(world, true, (before[1], pose), FLAWS, random, stride=24)
            rates = before[0].turn_rate, state.turn_rate
            pairs = read_out(pairs, true, rates, readout_s) if readout_s else pairs
            yield before[0], state, lifted_as_configured(pairs, true)
        before = state, pose


def lifted_as_configured(pairs: PointPairs, true: Rig) -> PointPairs:
    """The same pixels and ranges where the configuration puts them."""
    previous = pairs.previous.copy()
    for name, one in CONFIGURED.cameras.items():
        mine = pairs.camera_names == name
        range_m = np.linalg.norm(previous[mine] - true.cameras[name].T_body_camera.translation, axis=1)
        previous[mine] = one.T_body_camera.apply(one.camera.unproject(pairs.pixels_previous[mine], range_m))
    return replace(pairs, previous=previous)


def read_out(
    pairs: PointPairs, rig: Rig, rates: tuple[FloatArray | None, FloatArray | None], readout_s: float
) -> PointPairs:
    """The pixels where columns, read from left to right, see them while the camera turns; small turns."""
    moved = []
    for pixels, rate in zip((pairs.pixels_previous, pairs.pixels_current), rates, strict=True):
        assert rate is not None
        there = pixels.copy()
        for name, one in rig.cameras.items():
            mine = pairs.camera_names == name
            rays = one.camera.rays(pixels[mine])
            passing = -np.cross(one.T_body_camera.rotation.T @ rate, rays)
            read_s = (pixels[mine, 0] / one.camera.size[0] - 0.5) * readout_s
            there[mine] += np.einsum("nij,nj->ni", one.camera.jacobian(rays), passing) * read_s[:, None]
        moved.append(there)
    return replace(pairs, pixels_previous=moved[0], pixels_current=moved[1])
