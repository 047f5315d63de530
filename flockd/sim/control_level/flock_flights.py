"""Flies many flights of one scenario at once, without images: the law, the missions and the vehicles alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.flocking import FlockingLaw, level_offsets, lookahead_s
from flockd.sim.control_level.flight_code import FlightCode, Known
from flockd.sim.control_level.flock_figures import FIGURES, FlightFigures, ManyObstacles, nearest_distances, unions
from flockd.sim.control_level.many_missions import ManyMissions
from flockd.sim.control_level.near import Near
from flockd.sim.control_level.perceived_flock import Perception, Seen
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.perceived import PerceivedErrors
from flockd.sim.vehicles.vehicles import Motion, limit_norms

Figures = dict[str, float | int | bool | None]
_PAIRS = 1_000_000
"""Most pairs of drones of flights that are flown side by side, but for one flight alone: they take 0.3 GB."""
_SURE = 0.8
"""The k nearest are known once the k-th is nearer than this times how far was looked."""


def fly_flocks(
    scenarios: Sequence[ScenarioConfig],
    *,
    errors: PerceivedErrors | None = None,
    gated: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
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
        progress: called with (flights done, flights in all).

    Raises UsageError for what cannot be flown without images, and for obstacles that do not fit into their world.
    """
    found: dict[int, Figures] = {}
    for numbers in _alike(scenarios):
        flights = FlockFlights([scenarios[number] for number in numbers], errors, gated=gated)
        for step in range(flights.steps):
            flights.step(step)
        found |= zip(numbers, flights.figures(), strict=True)
        progress(len(found), len(scenarios))
    return [found[number] for number in range(len(scenarios))]


class FlockFlights:
    """A batch of flights that differ in seeds and starts only, all at the same time; see `fly_flocks`."""

    def __init__(
        self, scenarios: Sequence[ScenarioConfig], errors: PerceivedErrors | None = None, *, gated: bool = False
    ) -> None:
        scenario = scenarios[0]
        drone, vehicle, seeds = scenario.drone, scenario.vehicle, [one.seed for one in scenarios]
        self._drone, self._shape = drone, (len(scenarios), len(scenario.vehicles))
        self.steps = round(scenario.duration_s / drone.step_s)
        self._times = np.arange(self.steps, dtype=float) * drone.step_s
        f, n = self._shape
        self.states = np.ascontiguousarray(np.stack([_start(one) for one in scenarios], axis=1))
        """(6, flights, n) m and m/s: position and velocity, NED."""
        self._law = FlockingLaw(drone.flocking)
        self._missions = ManyMissions(scenario, f)
        self._perception = None if errors is None else Perception(errors, drone.step_s, seeds, n)
        self._obstacles = None if scenario.world.obstacles is None else ManyObstacles(scenarios)
        self._gated, self._avoids = gated, self._obstacles is not None and drone.obstacles.enabled
        self._code = FlightCode(drone, f * n) if gated or self._avoids else None
        self._motion = Motion(vehicle, seeds, n)
        self._figures = FlightFigures(f, n, self._times, drone.step_s, vehicle.radius_m)
        self._arrival_s, self._away_m = np.full(f, np.nan), np.full(f, np.nan)
        p = drone.flocking
        self._reach_m = max(p.observation_distance_m, p.separation_distance_m)
        if errors is not None:
            self._reach_m = min(errors.range_limit_m, 2 * self._reach_m)
        self.sums = np.zeros((2, f, n))
        """u of Eq. 38 without u_vf, m/s^2, as last perceived."""
        self.commands = np.zeros((2, f, n))
        """Velocities that drones were asked to fly with in the last step, m/s."""
        self._middles = np.zeros((2, f, n))
        self._own = np.zeros((f * n, 2))
        self._before = self.states.copy()

    def step(self, step: int) -> None:
        """One step of all flights."""
        near, seen = self.perceive(step)
        self._measure(step, near)
        begin_s = float(self._times[step])
        desired, heights = self._missions.step(begin_s, self.states[:2], self._middles)
        self._note_goal(step)
        p = self._drone.flocking
        u = limit_norms(_rows(self.sums + p.velocity * p.own_weight * desired), p.max_acceleration_m_s2)
        commands = limit_norms(self._own + u * lookahead_s(self._drone.step_s), p.max_speed_m_s)
        if self._code is None:
            self._ask(commands)
            self._motion.fly(begin_s, self._drone.step_s, self.states, self.commands, heights)
            return
        known = self._known(begin_s, seen)
        wanted = _rows(desired)
        for i, one in enumerate(known):
            if self._gated or one.ranges is not None:
                commands[i] = self._code.ask(i, self._own[i], commands[i].copy(), wanted[i], one)
        self._ask(commands)
        if not self._gated:
            self._motion.fly(begin_s, self._drone.step_s, self.states, self.commands, heights)
            return
        states, asked = self.states.reshape(6, -1), self.commands.reshape(2, -1)

        def fly(now_s: float, for_s: float, velocities: FloatArray, heights_m: FloatArray) -> None:
            shaped = velocities.reshape(2, *self._shape), heights_m.reshape(self._shape)
            self._motion.fly(now_s, for_s, self.states, *shaped)

        self._code.fly_gated(begin_s, states, asked, heights.ravel(), known, fly)

    def _ask(self, commands: FloatArray) -> None:
        self.commands = np.ascontiguousarray(commands.T).reshape(2, *self._shape)

    def _known(self, time_s: float, seen: Seen) -> list[Known]:
        """What each drone knows, for its own code."""
        n = self._shape[1]
        edges = np.searchsorted(seen.owners, np.arange(len(self._own) + 1))
        numbers = np.array([]) if self._perception is not None else self._numbers
        known = []
        for i in range(len(self._own)):
            of_drone = slice(edges[i], edges[i + 1])
            one = seen.of(of_drone)
            ranges = None
            if self._obstacles is not None and self._avoids:
                ranges = self._obstacles.look(i // n, time_s, self.states[:3, i // n, i % n].copy())
            known.append(Known(one.offsets, one.velocities, one.ages_s, numbers[of_drone].tolist(), ranges))
        return known

    def perceive(self, step: int) -> tuple[Near, Seen]:
        """What each drone sees of the others now; what the law makes of it is in `sums`."""
        near, states = Near(self.states), _rows(self.states)
        if self._perception is None:
            seen, self._own = self._exact(near, states), states[:, 3:5]
            offsets, middle_of = seen.offsets[:, :2], np.hypot(*seen.offsets[:, :2].T)
            middle_of = middle_of <= self._drone.flocking.observation_distance_m
        else:
            self._own = self._perception.own_velocities(states[:, 3:5], step)
            seen = self._measured(self._perception, near, states, step)
            offsets, middle_of = level_offsets(seen.offsets), np.ones(len(seen.owners), dtype=bool)
        theirs, still = seen.velocities[:, :2], np.zeros_like(self._own)
        u = self._law.accelerations(self._own, seen.owners, offsets, theirs, still, seen.ages_s)
        owners = seen.owners[middle_of]
        count = np.bincount(owners, minlength=len(states)) + 1
        middles = [np.bincount(owners, axis, len(states)) / count for axis in offsets[middle_of].T]
        self.sums, self._middles = u.T.reshape(2, *self._shape), np.array(middles).reshape(2, *self._shape)
        return near, seen

    @property
    def _all_count(self) -> bool:
        """Whether a drone needs all whom it sees, not those alone who have weight in the law."""
        kind = self._drone.flocking.weight.kind
        return kind == "uniform" or self._missions.goal() is not None or self._code is not None

    def _exact(self, near: Near, states: FloatArray) -> Seen:
        who = np.arange(len(states))
        reach_m = np.full(len(states), self._reach_m)
        if not self._all_count:
            p = self._drone.flocking
            reach_m = np.minimum(reach_m, np.maximum(near.nearest(p.weight.nearest)[0], p.separation_distance_m))
        owners, self._numbers = near.pairs(who, reach_m)
        other = states[self._numbers]
        ages_s = np.full(len(owners), math.inf)
        return Seen(owners, other[:, :3] - states[owners, :3], other[:, 3:], ages_s)

    def _measured(self, perception: Perception, near: Near, states: FloatArray, step: int) -> Seen:
        """Looks farther and farther, until those who have weight are known."""
        p, limit_m = self._drone.flocking, self._reach_m
        who, reach_m, found = np.arange(len(states)), np.full(len(states), limit_m), []
        if not self._all_count:
            reach_m = np.minimum(limit_m, 2 * np.maximum(near.nearest(p.weight.nearest)[0], p.separation_distance_m))
        while len(who):
            seen = perception.perceive(who, reach_m, near, states, step)
            level_m = np.hypot(*seen.offsets[:, :2].T)
            looked_m = np.full(len(states), 0.0)
            looked_m[who] = reach_m
            sure = level_m <= np.minimum(_SURE * looked_m[seen.owners], p.observation_distance_m)
            enough = np.bincount(seen.owners[sure], minlength=len(states))[who] >= p.weight.nearest
            done = np.zeros(len(states), dtype=bool)
            done[who] = enough | (reach_m >= limit_m)
            found.append(seen.of(done[seen.owners]))
            who, reach_m = who[~done[who]], np.minimum(2 * reach_m[~done[who]], limit_m)
        return Seen.joined(found)

    def _measure(self, step: int, near: Near) -> None:
        """Takes the figures of a step."""
        if step == 0:
            self._before = self.states.copy()
        self._figures.add(step, nearest_distances(near, self._before, self.states))
        self._before = self.states.copy()
        if self._obstacles is not None:
            self._obstacles.measure(self.states, ends=step == self.steps - 1)
        if self._figures.needs_union(step):
            reach_m = self._drone.flocking.observation_distance_m
            self._figures.add_tail(self.states, unions(near, self._shape, reach_m))

    def _note_goal(self, step: int) -> None:
        """When each flock's true middle first was at the last goal, once that was the one to fly to."""
        goal = self._missions.goal()
        if goal is not None:
            place, last = goal
            self._away_m = np.hypot(*(self.states[:2].mean(axis=2) - place[:, None]))
            there = last & (self._away_m <= self._missions.reached_m) & np.isnan(self._arrival_s)
            self._arrival_s[there] = self._times[step]

    def figures(self) -> list[Figures]:
        """The figures of each flight."""
        flights, obstacles = range(self._shape[0]), self._obstacles
        of_obstacles = [dict.fromkeys(FIGURES) if obstacles is None else obstacles.of_flight(k) for k in flights]
        return [{**self._figures.of_flight(k), **self._of_goal(k), **of_obstacles[k]} for k in flights]

    def _of_goal(self, flight: int) -> Figures:
        if self._missions.goal() is None:
            return {"arrived": None, "arrival_time_s": None, "final_error_m": None}
        since_s, away_m = float(self._arrival_s[flight]), float(self._away_m[flight])
        return {
            "arrived": away_m <= self._missions.reached_m,
            "arrival_time_s": None if math.isnan(since_s) else since_s,
            "final_error_m": away_m,
        }


def _start(scenario: ScenarioConfig) -> FloatArray:
    """States (6, n) NED at the start."""
    rows = [[*vehicle.position_m, *vehicle.velocity_m_s, 0.0] for vehicle in scenario.vehicles]
    return np.array(rows, dtype=float).T


def _alike(scenarios: Sequence[ScenarioConfig]) -> list[list[int]]:
    """Numbers of scenarios that are flown side by side."""
    groups: list[tuple[object, list[int]]] = []
    for number, scenario in enumerate(scenarios):
        missions = [(vehicle.mission, vehicle.by_hand) for vehicle in scenario.vehicles]
        key = scenario.model_copy(update={"seed": 0, "vehicles": ()}), missions
        for known, numbers in groups:
            if known == key and (len(numbers) + 1) * len(scenario.vehicles) ** 2 <= _PAIRS:
                numbers.append(number)
                break
        else:
            groups.append((key, [number]))
    return [numbers for _, numbers in groups]


def _rows(values: FloatArray) -> FloatArray:
    """(drones, k) of (k, flights, n)."""
    return values.reshape(len(values), -1).T
