"""The companion of a flight by sight: the same scenario with exact relative states, without rendering."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from flockd.core.messages import BoolArray, FloatArray, MissionOrder, MissionStatus, Neighbour
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import HORIZON_S, Passing
from flockd.flight.geometry import build_rig, rotation_from_euler
from flockd.flight.mission import Moment, Navigator
from flockd.flight.mission.navigator import Lookout, middle_of
from flockd.flight.obstacles import Avoidance, LocalMap, nothing_found
from flockd.flight.safety.surroundings import limits_towards
from flockd.flight.tracking import Measurement, Tracker
from flockd.sim.flock.control_loop import Commands, ControlLoop
from flockd.sim.scenario import DetectionsConfig, ScenarioConfig
from flockd.sim.vehicles.vehicles import REFERENCE_DEG, UNDISTURBED, Disturbances, Vehicles
from flockd.sim.world.obstacle_worlds import obstacles_of
from flockd.sim.world.obstacles import true_ranges


class ExactFlock:
    """The flocking law and each drone's mission on the states of all drones, and exact ranges to obstacles.

    The states are exact, or tracked from made-up detections where the scenario has `detections`.
    """

    def __init__(self, scenario: ScenarioConfig, *, passes: bool = True) -> None:
        """``passes``: drones keep clear of those that would come too near, as pilots ask for; else the law alone."""
        drone, self._passes = scenario.drone, passes
        self._law, self._step_s = FlockingLaw(drone.flocking), drone.step_s
        self._by_hand = [vehicle.by_hand for vehicle in scenario.vehicles]
        self._pilots = [navigator_of(scenario, i) for i in range(len(self._by_hand))]
        self._course_rad = np.full(len(self._pilots), start_yaw(scenario))
        self._yaw_rad = self._course_rad.copy()
        """Asked for: as the course, but for what the lookout turns."""
        self._scenario, self._rig = scenario, build_rig(drone.rig)
        self._maps = [LocalMap(drone.obstacles) for _ in self._pilots]
        self._lookouts = [Lookout(self._rig) for _ in self._pilots]
        self._before: FloatArray | None = None
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

        `orders` are operators' of now, by drone. In the view of a camera that is switched off (`disturbed`), a drone
        detects no other.
        """
        own, orders = velocities if own is None else own, orders or {}
        commands = Commands.of(len(positions))
        commands.yaw_rad[:] = self._course_rad
        missions, ranges, known = commands.missions, commands.obstacles, commands.neighbours
        for i, pilot in enumerate(self._pilots):
            here, moving, yaw_rad = positions[i, :2], own[i, :2], float(self._yaw_rad[i])
            faults = self._scenario.lost_cameras(i, time_s) if self._tracked else frozenset[str]()
            gone = disturbed.cameras_off_of(i) | faults
            known[i] = self._neighbours(i, time_s, positions, velocities, yaw_rad, gone)
            free = nothing_found(time_s, self._rig, gone, yaw_rad)
            way = None if self._before is None else here - self._before[i, :2]
            commands.seen_m[i] = self._maps[i].step(time_s, free, way, 0.0).seen_m
            if self._obstacles.solids:
                ranges[i] = true_ranges(self._obstacles, time_s, positions[i])
            if self._by_hand[i]:
                missions[i] = fly_by_hand(pilot, i, time_s, here, commands)
                continue
            seen = [one for one in known[i] if one.confirmed]
            places = np.reshape([one.position for one in seen], (len(seen), 3))
            others = np.reshape([one.velocity for one in seen], (len(seen), 3))[:, :2]
            ages_s = np.array([one.age_s for one in seen]) if self._tracked else math.inf
            moment = Moment(time_s, here, middle_of(places[:, :2]), np.array(REFERENCE_DEG), order=orders.get(i))
            guidance = pilot.step(moment)
            desired, around = pilot.status(guidance).desired, ranges[i]
            if around is not None and self._avoids:
                flown_as = self._avoidances[i].command(self._law, moving, places, others, desired, around, ages_s)
            elif self._passes:
                tracks, limits = [one.track for one in seen], limits_towards(known[i], here, self._gate, HORIZON_S)
                flown_as = self._passings[i].command(
                    moving, places, others, desired, self._step_s, tracks, limits, ages_s
                )
            else:
                flown_as = self._law.command(moving, places[:, :2], others, desired, self._step_s, ages_s)
            commands.velocity[i], commands.acceleration[i] = flown_as
            commands.desired[i], missions[i] = desired, pilot.status(guidance)
            if guidance.course_rad is not None:
                self._course_rad[i] = guidance.course_rad
            course_rad, wanted = float(self._course_rad[i]), commands.velocity[i]
            commands.yaw_rad[i] = self._lookouts[i].heading(time_s, course_rad, wanted, gone)
            if guidance.height_m is not None:
                commands.height_m[i] = guidance.height_m
        self._yaw_rad, self._before = commands.yaw_rad, positions.copy()
        return commands

    def _neighbours(
        self, i: int, time_s: float, positions: FloatArray, velocities: FloatArray, yaw_rad: float, gone: frozenset[str]
    ) -> tuple[Neighbour, ...]:
        if self._tracked:
            return self._tracked[i].step(time_s, positions, velocities, yaw_rad, gone)
        offsets = positions[:, :2] - positions[i, :2]
        seen = np.hypot(offsets[:, 0], offsets[:, 1]) <= self._law.parameters.observation_distance_m
        seen[i] = False
        if gone:
            R_ned_body = rotation_from_euler(0.0, 0.0, yaw_rad)
            seen &= self._rig.shows((positions - positions[i]) @ R_ned_body, without=gone)
        return tuple(
            Neighbour(
                int(j) + 1, positions[j] - positions[i], velocities[j], position_sigma_m=0.0, velocity_sigma_m_s=0.0,
                age_s=0.0, unseen_s=0.0, hits=1, confirmed=True,
            )
            for j in np.flatnonzero(seen)
        )  # fmt: skip


_OWN_MOTION_ERROR_M = 0.02
"""Standard deviation of a drone's motion in a step, each axis, of which the tracker is told. Where the scenario is
`ideal` the motion is exact."""

_FALSE_SPEED_M_S = 0.7
"""Standard deviation of a false neighbour's velocity, of which two or three detections tell little."""


class TrackedNeighbours:
    """The neighbours that one drone's tracker knows, from detections that are made up from the truth."""

    def __init__(self, scenario: ScenarioConfig, config: DetectionsConfig, drone: int) -> None:
        self._config, self._drone, self._step_s = config.filled, drone, scenario.drone.step_s
        self._scenario, self._rig = scenario, build_rig(scenario.drone.rig)
        self._tracker = Tracker(scenario.drone.tracking, scenario.drone.safety.gate)
        self._random = np.random.default_rng([scenario.seed, drone])
        self._errors = self._random.normal(size=(len(scenario.vehicles) - 1, 5))
        """Of each other drone, in standard deviations: of the range's logarithm and the bearing (3), and the normal
        number that decides whether it is missed."""
        self._position: FloatArray | None = None
        self._by_chance = np.random.default_rng([scenario.seed, drone, 1])
        self._false: Neighbour | None = None

    def step(
        self, time_s: float, positions: FloatArray, velocities: FloatArray, yaw_rad: float = 0.0,
        cameras_off: frozenset[str] = frozenset(),
    ) -> tuple[Neighbour, ...]:  # fmt: skip
        """The neighbours that the drone knows, with all drones at (n, 3) m and (n, 3) m/s NED; called once a step.

        Nobody is detected but in the view of a camera that has no fault and is on.
        """
        here = positions[self._drone]
        if self._position is not None:
            wrong_m = 0.0 if self._scenario.ideal else self._random.normal(0.0, _OWN_MOTION_ERROR_M, 3)
            self._tracker.predict(self._step_s, here - self._position + wrong_m, _OWN_MOTION_ERROR_M)
        self._position = here
        offsets = np.delete(positions, self._drone, axis=0) - here
        times_s = (self._config.error_time_s,) * 4 + (self._config.missed_time_s,)
        keep = np.array([math.exp(-self._step_s / time_s) if time_s else 0.0 for time_s in times_s])
        fresh = self._random.normal(size=self._errors.shape)
        self._errors = keep * self._errors + np.sqrt(1.0 - keep**2) * fresh
        made_up = (self._detection(*pair) for pair in zip(offsets, self._errors, strict=True))
        found = [detection for detection in made_up if detection is not None]
        gone = self._scenario.lost_cameras(self._drone, time_s) | cameras_off
        R_ned_body = rotation_from_euler(0.0, 0.0, yaw_rad)

        def shown(places: FloatArray, radius_m: float) -> BoolArray:
            return self._rig.shows(places @ R_ned_body, radius_m, gone)

        found = [one for one in found if shown(one.position[None], 0.0)[0]]
        self._tracker.update(time_s, found, velocities[self._drone], shown)
        self._false = self._false_neighbour(time_s, here)
        false = [] if self._false is None else [replace(self._false, position=self._false.position - here)]
        return *self._tracker.neighbours(), *false

    def _false_neighbour(self, time_s: float, here: FloatArray) -> Neighbour | None:
        """A confirmed false track, which begins and ends by chance; its position is in the world."""
        config, chance = self._config, self._by_chance.random()
        if self._false is not None:
            lasts = chance > self._step_s / config.false_time_s
            return replace(self._false, age_s=self._false.age_s + self._step_s) if lasts else None
        if chance > config.false_at_once * self._step_s / config.false_time_s:
            return None
        range_m = float(np.interp(self._by_chance.random(), (0.1, 0.5, 0.9), config.false_m))
        ahead = rotation_from_euler(0.0, 0.0, self._by_chance.uniform(-math.pi, math.pi)) @ [range_m, 0.0, 0.0]
        return Neighbour(
            -1 - round(time_s / self._step_s), here + ahead, np.zeros(3), range_m * config.range_error,
            _FALSE_SPEED_M_S, self._step_s, unseen_s=0.0, hits=2, confirmed=True,
        )  # fmt: skip

    def _detection(self, offset: FloatArray, errors: FloatArray) -> Measurement | None:
        config = self._config
        range_m = float(np.linalg.norm(offset))
        if errors[4] < ndtri(config.missed_at(range_m)):
            return None
        bearing = offset / range_m + config.bearing_error_rad * errors[1:4]
        bearing /= np.linalg.norm(bearing)
        across, along = config.bearing_error_rad**2, config.range_error**2
        covariance = across * np.eye(3) + (along - across) * np.outer(bearing, bearing)
        log_range = float(np.log(range_m) + config.range_error * errors[0])
        return Measurement(bearing, log_range, covariance, 0.6, 0.95)


def navigator_of(scenario: ScenarioConfig, vehicle: int) -> Navigator:
    """The navigator of a vehicle's mission, for its pilot or for a person who flies it without flockd."""
    drone = scenario.drone_of(vehicle)
    return Navigator(drone.mission, drone.safety.gate)


def at_home(time_s: float, place: FloatArray) -> Moment:
    """The moment of a drone at `place` (2,) m from the world's origin whose navigator knows of no others."""
    return Moment(time_s, place, home_deg=np.array(REFERENCE_DEG))


def fly_by_hand(person: Navigator, i: int, time_s: float, place: FloatArray, commands: Commands) -> MissionStatus:
    """Fills in the commands of drone `i`, which a person flies in Position mode, and returns how the mission goes.

    The person sees nothing of the flock. Called in order of time.
    """
    guidance = person.step(at_home(time_s, place))
    commands.velocity[i] = commands.desired[i] = guidance.velocity
    commands.height_m[i] = np.nan if guidance.height_m is None else guidance.height_m
    return person.status(guidance)


def start_yaw(scenario: ScenarioConfig) -> float:
    """The heading, rad, with which all drones begin: the first course of the scenario's own mission; else north."""
    start = np.mean([vehicle.position_m[:2] for vehicle in scenario.vehicles], axis=0)
    navigator = Navigator(scenario.drone.mission, scenario.drone.safety.gate)
    return navigator.step(at_home(0.0, start)).course_rad or 0.0


def vehicles_of(scenario: ScenarioConfig) -> Vehicles:
    """The vehicles of a flight as it begins."""
    return Vehicles(
        scenario.vehicles,
        scenario.vehicle,
        yaw_rad=start_yaw(scenario),
        seed=scenario.seed,
        sensors=None if scenario.ideal else scenario.sensors,
    )


def fly_exact_states(scenario: ScenarioConfig, *, gated: bool = True) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (S,) s, positions (S, N, 3) m and velocities (S, N, 3) m/s in NED, as each step begins.

    The paper's "UAV flocking based on ground truth cluster state": each vehicle gets what the flocking law commands on
    the true positions and velocities of all.
    """
    times = step_times(scenario)
    flock, loop = ExactFlock(scenario, passes=gated), ControlLoop(scenario, gated=gated)
    vehicles = vehicles_of(scenario)
    positions, velocities = [], []
    for time_s in times:
        positions.append(vehicles.position)
        velocities.append(vehicles.velocity)
        loop.fly(float(time_s), vehicles, flock.step(float(time_s), vehicles.position, vehicles.velocity))
    return times, np.array(positions), np.array(velocities)


def step_times(scenario: ScenarioConfig) -> FloatArray:
    """Times (S,) s at which the steps of a flight begin, from 0; its end is not among them."""
    step_s = scenario.drone.step_s
    return np.arange(round(scenario.duration_s / step_s), dtype=float) * step_s
