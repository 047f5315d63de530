"""Flies many flights of one scenario at once, without images: the law, the missions and the vehicles alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray, IntArray
from flockd.flight.flocking import FlockingLaw, level_offsets, lookahead_s
from flockd.flight.mission import Moment, Navigator
from flockd.flight.mission.places import place_of_waypoint
from flockd.sim.control_level.flight_code import FlightCode, Known
from flockd.sim.control_level.flock_figures import Figures, FlightFigures
from flockd.sim.control_level.near import Near
from flockd.sim.control_level.perceived_flock import Perception, Seen
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.perceived import PerceivedErrors
from flockd.sim.vehicles.vehicles import REFERENCE_DEG, Motion, limit_norms
from flockd.sim.world.obstacle_worlds import obstacles_of
from flockd.sim.world.obstacles import true_ranges

_HOME_DEG = np.array(REFERENCE_DEG)
_PAIRS = 1_000_000
"""Most pairs of drones of flights that are flown side by side, but for one flight alone: they take 0.3 GB."""


def fly_flocks(
    scenarios: Sequence[ScenarioConfig], *, errors: PerceivedErrors | None = None, gated: bool = False
) -> list[Figures]:
    """Flies each scenario once; the figures of each flight, in their order.

    Those that differ in nothing but seed, start positions and start velocities fly side by side. A flight is the same
    bit for bit whatever others are flown with it.

    Args:
        scenarios: with any number of vehicles (`flockd.sim.flock.start`). The seed rules gusts,
            obstacles and the errors of perception. Rig and sensors do not count.
        errors: of what the drones perceive of each other; None: they are given exact states. Ranges to obstacles are
            exact in any case.
        gated: whether each drone flies through its safety gate (`flockd.flight.safety.Gate`), on what it perceives.

    Raises UsageError for what cannot be flown without images, and for obstacles that do not fit into their world.
    """
    alike: dict[str, list[int]] = {}
    for number, scenario in enumerate(scenarios):
        missions = [(vehicle.mission, vehicle.by_hand) for vehicle in scenario.vehicles]
        key = f"{scenario.model_copy(update={'seed': 0, 'vehicles': ()})!r} {missions}"
        alike.setdefault(key, []).append(number)
    found: dict[int, Figures] = {}
    for numbers in alike.values():
        side_by_side = max(_PAIRS // len(scenarios[numbers[0]].vehicles) ** 2, 1)
        for begin in range(0, len(numbers), side_by_side):
            batch = numbers[begin : begin + side_by_side]
            flights = FlockFlights([scenarios[number] for number in batch], errors, gated=gated)
            for step in range(flights.steps):
                flights.step(step)
            found |= zip(batch, flights.figures(), strict=True)
    return [found[number] for number in range(len(scenarios))]


class FlockFlights:
    """A batch of flights that differ in seeds and starts only, all at the same time; see `fly_flocks`."""

    def __init__(
        self, scenarios: Sequence[ScenarioConfig], errors: PerceivedErrors | None = None, *, gated: bool = False
    ) -> None:
        scenario = scenarios[0]
        drone, seeds = scenario.drone, [one.seed for one in scenarios]
        f, n = self._shape = len(scenarios), len(scenario.vehicles)
        self._drone, self._law = drone, FlockingLaw(drone.flocking)
        self.steps = round(scenario.duration_s / drone.step_s)
        starts = [[*start.position_m, *start.velocity_m_s, 0.0] for one in scenarios for start in one.vehicles]
        self.states = np.ascontiguousarray(np.array(starts, dtype=float).T).reshape(6, f, n)
        """(6, flights, n) m and m/s: position and velocity, NED."""
        self._missions = Missions(scenario, f)
        self._perception = None if errors is None else Perception(errors, drone.step_s, seeds, n)
        worlds = [obstacles_of(one) for one in scenarios]
        self._worlds = worlds if drone.obstacles.enabled and scenario.world.obstacles is not None else []
        self._gated = gated
        self._code = FlightCode(drone, f * n) if gated or self._worlds else None
        self._motion = Motion(scenario.vehicle, seeds, n)
        self._figures = FlightFigures(scenario, worlds, self._missions.goal, self._missions.reached_m)
        p = drone.flocking
        self._reach_m = max(p.observation_distance_m, p.separation_distance_m)
        if errors is not None:
            self._reach_m = min(errors.range_limit_m, 2 * self._reach_m)
        self.sums = np.zeros((2, f, n))
        """u of Eq. 38 without u_vf, m/s^2, as last perceived."""
        self.commands = np.zeros((2, f, n))
        """Velocities that drones were asked to fly with in the last step, m/s."""
        self._middles = np.zeros((f * n, 2))
        self._own = np.zeros((f * n, 2))

    def step(self, step: int) -> None:
        """One step of all flights."""
        near, seen = self.perceive(step)
        begin_s, for_s = step * self._drone.step_s, self._drone.step_s
        desired, heights = self._missions.step(begin_s, _rows(self.states[:2]), self._middles)
        self._figures.add(self.states, near, self._missions.to_the_last)
        p = self._drone.flocking
        u = limit_norms(_rows(self.sums) + p.velocity * p.own_weight * desired, p.max_acceleration_m_s2)
        commands = limit_norms(self._own + u * lookahead_s(for_s), p.max_speed_m_s)
        known = [] if self._code is None else self._known(begin_s, seen)
        for i, (one, ranges) in enumerate(known):
            if self._code is not None and (self._gated or ranges is not None):
                commands[i] = self._code.ask(i, self._own[i], commands[i].copy(), desired[i], one, ranges)
        self.commands = np.ascontiguousarray(commands.T).reshape(2, *self._shape)

        def fly(now_s: float, for_s: float, velocities: FloatArray, heights_m: FloatArray) -> None:
            shaped = velocities.reshape(2, *self._shape), heights_m.reshape(self._shape)
            self._motion.fly(now_s, for_s, self.states, *shaped)

        if self._code is None or not self._gated:
            fly(begin_s, for_s, self.commands, heights)
        else:
            flat = self.states.reshape(6, -1), self.commands.reshape(2, -1)
            self._code.fly_gated(begin_s, *flat, heights, known, fly)

    def _known(self, time_s: float, seen: Seen) -> list[Known]:
        edges, n = np.searchsorted(seen.owners, np.arange(len(self._own) + 1)), self._shape[1]
        known = []
        for i in range(len(self._own)):
            world, place = self._worlds[i // n] if self._worlds else None, self.states[:3, i // n, i % n].copy()
            ranges = true_ranges(world, time_s, place) if world is not None and world.solids else None
            known.append((seen.of(slice(edges[i], edges[i + 1])), ranges))
        return known

    def perceive(self, step: int) -> tuple[Near, Seen]:
        """What each drone sees of the others now; what the law makes of it is in `sums`."""
        near, states, p = Near(self.states), _rows(self.states), self._drone.flocking
        who, reach_m = np.arange(len(states)), np.full(len(states), self._reach_m)
        if self._perception is None:
            if p.weight.kind == "nearest" and self._code is None and self._missions.goal is None:  # no one else counts
                counts_m = np.maximum(near.nearest(p.weight.nearest)[0], p.separation_distance_m)
                reach_m = np.minimum(reach_m, counts_m)
            owners, others = near.pairs(who, reach_m)
            places, velocities = states[others, :3] - states[owners, :3], states[others, 3:]
            self._own, ages_s = states[:, 3:5], np.full(len(owners), math.inf)
            seen, offsets = Seen(owners, places, velocities, ages_s, others), places[:, :2]
            middle_of = np.hypot(*offsets.T) <= p.observation_distance_m
        else:
            self._own = self._perception.own_velocities(states[:, 3:5], step)
            seen = self._perception.perceive(who, reach_m, near, states, step)
            offsets, middle_of = level_offsets(seen.offsets), np.ones(len(seen.owners), dtype=bool)
        still = np.zeros_like(self._own)
        u = self._law.accelerations(self._own, seen.owners, offsets, seen.velocities[:, :2], still, seen.ages_s)
        owners = seen.owners[middle_of]
        count = np.bincount(owners, minlength=len(states)) + 1
        middles = [np.bincount(owners, axis, len(states)) / count for axis in offsets[middle_of].T]
        self.sums, self._middles = u.T.reshape(2, *self._shape), np.column_stack(middles)
        return near, seen

    def figures(self) -> list[Figures]:
        """The figures of each flight."""
        return self._figures.of_flights()


class Missions:
    """What the drones of all flights want: a mission that goes by no place is asked once, waypoints for each drone."""

    def __init__(self, scenario: ScenarioConfig, flights: int) -> None:
        missions, n = [mission for mission, _ in scenario.missions], len(scenario.vehicles)
        for i, (_, by_hand) in enumerate(scenario.missions):
            if by_hand:
                raise UsageError(
                    f"vehicles[{i}] is flown by hand, which flights at control level do not have; delete `by_hand`"
                )
        self._flights, self._navigators = flights, list[tuple[Navigator, IntArray]]()
        self.goal: FloatArray | None = None
        """(2,) m: the last one of the largest group of drones that has any."""
        self.to_the_last = np.zeros(flights, dtype=bool)
        """Whether one of that group flies to it."""
        self.reached_m = max(mission.reached_m for mission in missions)
        largest = 0
        for mission in dict.fromkeys(missions):
            of_mission = [i for i in range(n) if missions[i] == mission]
            rows = (n * np.arange(flights)[:, None] + of_mission).ravel()
            is_led = mission.kind == "waypoints"
            held = mission.model_copy(update={"at_end": "hold"})  # no autopilot takes over
            for of_one in rows[:, None] if is_led else (rows,):
                self._navigators.append((Navigator(held, scenario.drone.safety.gate), of_one))
            if is_led and len(of_mission) > largest:
                largest, self._led = len(of_mission), rows
                self.goal = place_of_waypoint(mission.waypoints[-1], np.array(mission.origin_m), _HOME_DEG)

    def step(self, time_s: float, positions: FloatArray, middles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Desired velocities (drones, 2) m/s, times the pull, and heights (drones,) m, up positive, NaN: as now.

        `positions` (drones, 2) m; `middles` (drones, 2) m from each to the middle of those that it sees. Called in
        order of time.
        """
        desired, heights, goals = np.zeros(positions.shape), np.full(len(positions), np.nan), np.zeros(positions.shape)
        for navigator, rows in self._navigators:
            first = rows[0]
            guidance = navigator.step(Moment(time_s, positions[first], middles[first], _HOME_DEG))
            desired[rows] = navigator.pull(guidance)
            heights[rows] = np.nan if guidance.height_m is None else guidance.height_m
            goals[rows] = np.nan if guidance.goal is None else guidance.goal
        if self.goal is not None:
            self.to_the_last = (goals[self._led] == self.goal).all(axis=1).reshape(self._flights, -1).any(axis=1)
        return desired, heights


def _rows(values: FloatArray) -> FloatArray:
    """(drones, k) of (k, flights, n)."""
    return values.reshape(len(values), -1).T
