"""Two drones that meet head-on, in the closed loop: detections with errors, tracker, law, gate at 20 Hz, vehicles.

Every detection is made up from the truth; the rest is what flies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from flockd.core.config.envelope import PROVEN_M_S
from flockd.core.config.safety import GateParameters
from flockd.core.config.scenario import StartConfig, VehicleConfig
from flockd.core.messages import FloatArray, Neighbour, Wanted
from flockd.flight.flocking import FlockingLaw, level_offsets
from flockd.flight.safety import Action, Gate, Permission, Request
from flockd.flight.safety.surroundings import surroundings
from flockd.flight.tracking import Measurement, Tracker, TrackingParameters
from flockd.sim.vehicles import Vehicles

STEP_S, TICK_S = 0.5, 0.05
STEP_TAKES_S = 0.3
START_M, SEEN_M = 30.0, 20.0
RANGE_ERROR, BEARING_ERROR_RAD, MISSED = 0.05, 0.005, 0.05
GATE = GateParameters(fence_radius_m=None)


@dataclass(frozen=True, eq=False)
class Step:
    """What one step of the pilot gave, and when its frames were taken."""

    time_s: float
    place: FloatArray
    wanted: Wanted
    neighbours: tuple[Neighbour, ...]


@dataclass(eq=False)
class Drone:
    """One drone's code, and the result of its last finished step."""

    desired: FloatArray
    random: np.random.Generator
    tracker: Tracker = field(default_factory=lambda: Tracker(TrackingParameters()))
    gate: Gate = field(default_factory=lambda: Gate(GATE))
    place: FloatArray | None = None
    known: Step | None = None
    coming: Step | None = None

    def step(self, time_s: float, place: FloatArray, velocity: FloatArray, offset: FloatArray) -> None:
        """A step that begins now and is known `STEP_TAKES_S` later."""
        if self.place is not None:
            self.tracker.predict(STEP_S, place - self.place, 0.02)
        self.place = place
        self.tracker.update(time_s, self._detections(offset), velocity)
        neighbours = self.tracker.neighbours()
        seen = [one for one in neighbours if one.confirmed]
        offsets = np.array([one.position for one in seen]).reshape(-1, 3)
        command, u = FlockingLaw().command(
            velocity[:2],
            level_offsets(offsets),
            np.array([one.velocity[:2] for one in seen]).reshape(-1, 2),
            self.desired,
            STEP_S,
        )
        self.coming = Step(time_s, place, Wanted(command, u, 0.0), neighbours)

    def setpoint(self, now_s: float, place: FloatArray, velocity: FloatArray) -> FloatArray:
        """What its gate sends now."""
        if self.coming is not None and now_s >= self.coming.time_s + STEP_TAKES_S - 1e-9:
            self.known, self.coming = self.coming, None
        if self.known is None:
            return self.desired
        around = surroundings(
            self.known.neighbours,
            now_s - self.known.time_s,
            moved=place - self.known.place,
            position=place[:2],
            velocity=velocity,
            yaw_rad=0.0,
            height_m=5.0,
            obstacles=np.empty((0, 2)),
        )
        request = Request(Permission(Action.FLY, now_s), self.known.wanted, self.known.time_s, 5.0, around)
        sent = self.gate.step(now_s, request).setpoint
        assert sent is not None
        return sent.velocity

    def _detections(self, offset: FloatArray) -> list[Measurement]:
        range_m = float(np.linalg.norm(offset))
        if range_m > SEEN_M or self.random.random() < MISSED:
            return []
        bearing = offset / range_m + self.random.normal(0.0, BEARING_ERROR_RAD, 3)
        bearing /= np.linalg.norm(bearing)
        across, along = BEARING_ERROR_RAD**2, RANGE_ERROR**2
        covariance = across * np.eye(3) + (along - across) * np.outer(bearing, bearing)
        log_range = math.log(range_m) + RANGE_ERROR * self.random.normal()
        return [Measurement(bearing, log_range, covariance, 0.6, 0.95)]


def nearest_m(seed: int, speed_m_s: float) -> float:
    """How near two drones come that fly towards each other, at every instant."""
    side_m = 0.05 * (seed % 5 - 2)
    starts = [
        StartConfig(position_m=(-START_M / 2, side_m / 2, -5.0), velocity_m_s=(speed_m_s, 0.0)),
        StartConfig(position_m=(START_M / 2, -side_m / 2, -5.0), velocity_m_s=(-speed_m_s, 0.0)),
    ]
    vehicles = Vehicles(starts, VehicleConfig(), seed=seed)
    drones = [
        Drone(np.array([way * speed_m_s, 0.0]), np.random.default_rng([seed, i])) for i, way in enumerate((1.0, -1.0))
    ]
    nearest = math.inf
    for tick in range(round((START_M / speed_m_s + 6.0) / TICK_S)):
        now_s = tick * TICK_S
        if tick % round(STEP_S / TICK_S) == 0:
            for i, drone in enumerate(drones):
                offset = vehicles.position[1 - i] - vehicles.position[i]
                drone.step(now_s, vehicles.position[i], vehicles.velocity[i], offset)
        setpoints = [d.setpoint(now_s, vehicles.position[i], vehicles.velocity[i]) for i, d in enumerate(drones)]
        vehicles.step(np.array(setpoints), np.zeros(2), TICK_S)
        nearest = min(nearest, float(np.linalg.norm(vehicles.position[0] - vehicles.position[1])))
    return nearest


SPEEDS_M_S = 1.5, 2.0, 3.0


def test_the_envelope_of_real_drones_is_what_flies_here() -> None:
    assert max(SPEEDS_M_S) == FlockingLaw().parameters.max_speed_m_s == PROVEN_M_S["flocking", "max_speed_m_s"]
    assert GATE.max_speed_m_s == PROVEN_M_S["safety", "gate", "max_speed_m_s"]


@pytest.mark.parametrize("speed_m_s", SPEEDS_M_S)
def test_drones_that_meet_head_on_stay_apart(speed_m_s: float) -> None:
    """At least 1 m apart at every instant, with 5 % of range error, 5 % missed and a step every half second."""
    assert min(nearest_m(seed, speed_m_s) for seed in range(12)) >= 1.0
