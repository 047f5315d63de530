"""The companion of a flight by sight: the same scenario with exact relative states, without rendering."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flockd.core.messages import FloatArray, MissionOrder, MissionStatus, Neighbour, ObstacleRanges
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import Passing
from flockd.flight.geometry import build_rig, rotation_from_euler
from flockd.flight.mission import Moment, Navigator
from flockd.flight.mission.navigator import middle_of
from flockd.flight.obstacles import Avoidance
from flockd.flight.safety.surroundings import limits_towards
from flockd.sim.flock.control_loop import Commands, ControlLoop
from flockd.sim.flock.made_up_detections import TrackedNeighbours
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.vehicles import REFERENCE_DEG, UNDISTURBED, Disturbances, Vehicles
from flockd.sim.world.obstacle_worlds import obstacles_of
from flockd.sim.world.obstacles import true_ranges

Orders = Mapping[int, Sequence[tuple[float, MissionOrder]]]
"""What operators ordered of a flight's drones, by the drone's number from 0, and when, s; in order of time."""


class ExactFlock:
    """The flocking law and each drone's mission on the states of all drones, and exact ranges to obstacles.

    The states are exact, or tracked from made-up detections where the scenario has `detections`.
    """

    def __init__(self, scenario: ScenarioConfig, orders: Orders | None = None, *, passes: bool = True) -> None:
        """``passes``: drones keep clear of those that would come too near, as pilots ask for; else the law alone."""
        drone, self._passes = scenario.drone, passes
        self._orders = {i: list(of_drone) for i, of_drone in (orders or {}).items()}
        self._new: Mapping[int, MissionOrder] = {}
        self._law, self._step_s = FlockingLaw(drone.flocking), drone.step_s
        self._pilots = [
            HandPilot(scenario, i) if vehicle.by_hand else Navigator(scenario.drone_of(i).mission, drone.safety.gate)
            for i, vehicle in enumerate(scenario.vehicles)
        ]
        self._yaw_rad = np.full(len(self._pilots), start_yaw(scenario))
        self._rig = build_rig(drone.rig)
        made_up, n = scenario.detections, len(self._pilots)
        self._tracked = [] if made_up is None else [TrackedNeighbours(scenario, made_up, i) for i in range(n)]
        self._obstacles = obstacles_of(scenario)
        self._gate = drone.safety.gate
        self._passings = [Passing(self._law, self._gate.vertical_separation_m) for _ in self._pilots]
        self._avoids = drone.obstacles.enabled
        self._avoidances = [Avoidance(drone.obstacles, drone.safety.gate, drone.step_s) for _ in self._pilots]

    def step(
        self,
        time_s: float,
        positions: FloatArray,
        velocities: FloatArray,
        orders: Mapping[int, MissionOrder] | None = None,
        disturbed: Disturbances = UNDISTURBED,
        own: FloatArray | None = None,
    ) -> Commands:
        """The commands for drones at (n, 3) m and (n, 3) m/s in NED; called in order of time.

        `own` (n, 3) m/s: what each takes for its own velocity; None: the exact one.

        `orders` are operators' of now, by drone, beside those that were given at the beginning. In the view of a camera
        that is off, as `disturbed` says, a drone knows of nobody.
        """
        self._new = orders or {}
        seen = [true_ranges(self._obstacles, time_s, place) if self._obstacles.solids else None for place in positions]
        known = [
            self._neighbours(i, time_s, positions, velocities, disturbed.cameras_off_of(i))
            for i in range(len(positions))
        ]
        own = velocities if own is None else own
        found = [self._of(i, time_s, positions, own, known[i], ranges) for i, ranges in enumerate(seen)]
        velocity, acceleration, yaw_rad, height_m, missions, desired = zip(*found, strict=True)
        self._yaw_rad = np.array(yaw_rad)
        return Commands(
            np.array(velocity), np.array(acceleration), self._yaw_rad, np.array(height_m), missions, np.array(desired),
            tuple(seen), tuple(known),
        )  # fmt: skip

    def _of(
        self, i: int, time_s: float, positions: FloatArray, velocities: FloatArray, known: tuple[Neighbour, ...],
        ranges: ObstacleRanges | None,
    ) -> tuple[FloatArray, FloatArray, float, float, MissionStatus, FloatArray]:  # fmt: skip
        here, moving = positions[:, :2], velocities[:, :2]
        pilot = self._pilots[i]
        if isinstance(pilot, HandPilot):
            flown = pilot.step(time_s, here[i])
            return flown.velocity, np.zeros(2), float(self._yaw_rad[i]), flown.height_m, flown.status, flown.velocity
        seen = [one for one in known if one.confirmed]
        places = np.reshape([one.position for one in seen], (len(seen), 3))
        others = np.reshape([one.velocity for one in seen], (len(seen), 3))[:, :2]
        ages_s = np.array([one.age_s for one in seen]) if self._tracked else math.inf
        order = self._newest_order(i, time_s)
        guidance = pilot.step(Moment(time_s, here[i], middle_of(places[:, :2]), np.array(REFERENCE_DEG), order=order))
        desired = pilot.pull(guidance)
        if ranges is None or not self._avoids:
            if self._passes:
                tracks = [one.track for one in seen]
                command, acceleration = self._passings[i].command(
                    moving[i], places, others, desired, self._step_s, tracks, limits_towards(known, self._gate), ages_s
                )
            else:
                command, acceleration = self._law.command(
                    moving[i], places[:, :2], others, desired, self._step_s, ages_s
                )
        else:
            command, acceleration = self._avoidances[i].command(
                self._law, moving[i], places, others, desired, ranges, ages_s
            )
        yaw_rad = float(self._yaw_rad[i]) if guidance.course_rad is None else guidance.course_rad
        height_m = np.nan if guidance.height_m is None else guidance.height_m
        return command, acceleration, yaw_rad, height_m, pilot.status(guidance), desired

    def _newest_order(self, i: int, time_s: float) -> MissionOrder | None:
        """The last one until now that was not flown yet."""
        waiting, newest = self._orders.get(i, []), self._new.get(i)
        while waiting and waiting[0][0] <= time_s:
            newest = waiting.pop(0)[1]
        return newest

    def _neighbours(
        self, i: int, time_s: float, positions: FloatArray, velocities: FloatArray, cameras_off: frozenset[str]
    ) -> tuple[Neighbour, ...]:
        if self._tracked:
            return self._tracked[i].step(time_s, positions, velocities, float(self._yaw_rad[i]), cameras_off)
        offsets = positions[:, :2] - positions[i, :2]
        seen = np.hypot(offsets[:, 0], offsets[:, 1]) <= self._law.parameters.observation_distance_m
        seen[i] = False
        if cameras_off:
            R_ned_body = rotation_from_euler(0.0, 0.0, float(self._yaw_rad[i]))
            seen &= ~self._rig.hidden((positions - positions[i]) @ R_ned_body, cameras_off)
        return tuple(
            Neighbour(
                int(j) + 1, positions[j] - positions[i], velocities[j], position_sigma_m=0.0, velocity_sigma_m_s=0.0,
                age_s=0.0, unseen_s=0.0, hits=1, confirmed=True,
            )
            for j in np.flatnonzero(seen)
        )  # fmt: skip


class FlownByHand(NamedTuple):
    """What a person wants of a drone."""

    velocity: FloatArray
    """(2,) m/s, north and east."""
    height_m: float
    """Up positive; NaN: as high as now."""
    status: MissionStatus


class HandPilot:
    """A person who flies one drone along its mission in Position mode, without flockd; sees nothing of the flock."""

    def __init__(self, scenario: ScenarioConfig, vehicle: int) -> None:
        drone = scenario.drone_of(vehicle)
        self._navigator = Navigator(drone.mission, drone.safety.gate)

    def step(self, time_s: float, position: FloatArray) -> FlownByHand:
        """At `position` (2,) m from the world's origin; called in order of time."""
        guidance = self._navigator.step(Moment(time_s, position, home_deg=np.array(REFERENCE_DEG)))
        height_m = np.nan if guidance.height_m is None else guidance.height_m
        return FlownByHand(guidance.velocity, height_m, self._navigator.status(guidance))


def start_yaw(scenario: ScenarioConfig) -> float:
    """The heading with which all begin: the course of the scenario's own mission; else north."""
    mission = scenario.drone.mission
    start = np.mean([vehicle.position_m[:2] for vehicle in scenario.vehicles], axis=0)
    moment = Moment(0.0, start, home_deg=np.array(REFERENCE_DEG))
    return Navigator(mission, scenario.drone.safety.gate).step(moment).course_rad or 0.0


def vehicles_of(scenario: ScenarioConfig) -> Vehicles:
    """The vehicles of a flight as it begins."""
    return Vehicles(
        scenario.vehicles,
        scenario.vehicle,
        yaw_rad=start_yaw(scenario),
        seed=scenario.seed,
        sensors=None if scenario.ideal else scenario.sensors,
    )


def fly_exact_states(
    scenario: ScenarioConfig, *, gated: bool = True, orders: Orders | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (S,) s, positions (S, N, 3) m and velocities (S, N, 3) m/s in NED, as each step begins.

    `orders` are flown at the first step after them.

    The paper's "UAV flocking based on ground truth cluster state": each vehicle gets what the flocking law commands on
    the true positions and velocities of all.
    """
    times = step_times(scenario)
    flock, loop = ExactFlock(scenario, orders, passes=gated), ControlLoop(scenario, gated=gated)
    vehicles = vehicles_of(scenario)
    positions, velocities = [], []
    for time_s in times:
        positions.append(vehicles.position)
        velocities.append(vehicles.velocity)
        loop.fly(float(time_s), vehicles, flock.step(float(time_s), vehicles.position, vehicles.velocity))
    return times, np.array(positions), np.array(velocities)


def exact_states_at(
    times: FloatArray, scenario: ScenarioConfig, orders: Orders | None = None
) -> tuple[FloatArray, FloatArray]:
    """Positions (S, N, 3) m and velocities (S, N, 3) m/s of `fly_exact_states`, interpolated at ``times`` (S,) s."""
    steps_s, position, velocity = fly_exact_states(scenario, orders=orders)
    flat = [values.reshape(len(steps_s), -1) for values in (position, velocity)]
    at = [np.stack([np.interp(times, steps_s, column) for column in values.T], axis=1) for values in flat]
    shape = (len(times), *position.shape[1:])
    return at[0].reshape(shape), at[1].reshape(shape)


def step_times(scenario: ScenarioConfig) -> FloatArray:
    """When the steps of a flight begin, (S,) s: 0, step, ... up to but without its end."""
    step_s = scenario.drone.step_s
    return np.arange(round(scenario.duration_s / step_s), dtype=float) * step_s
