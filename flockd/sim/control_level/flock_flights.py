"""Flies many flights of one scenario at once, without images: the law, the missions and the vehicles alone."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np

from flockd.core.config.perceived import PerceivedErrors
from flockd.core.config.scenario import ScenarioConfig
from flockd.core.messages import FloatArray, IntArray
from flockd.flight.flocking import lookahead_s
from flockd.sim.control_level import flock_figures, law_sums, motion, perceived_sums
from flockd.sim.control_level.cells import CELLS_A_DRONE, sort_flights
from flockd.sim.control_level.flight_code import FlightCode, Seen
from flockd.sim.control_level.flock_figures import FlightFigures
from flockd.sim.control_level.many_missions import ManyMissions
from flockd.sim.control_level.many_obstacles import FIGURES, ManyObstacles
from flockd.sim.wind import GustField

Figures = dict[str, float | int | bool | None]
_Errors = tuple[FloatArray, FloatArray, IntArray]
_LEAST_DRONES = 250
"""Least drones of a thread: fewer are computed sooner than handed over."""


def fly_flocks(
    scenarios: Sequence[ScenarioConfig],
    *,
    errors: PerceivedErrors | None = None,
    gated: bool = False,
    threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Figures]:
    """Flies each scenario once; the figures of each flight, in their order.

    Those that differ in nothing but seed, start positions and start velocities fly side by side. A flight is the same
    bit for bit whatever others are flown with it, in however many threads.

    Args:
        scenarios: with any number of vehicles (`flockd.sim.start`). The seed rules gusts,
            obstacles and the errors of perception. Rig and sensors do not count.
        errors: of what the drones perceive of each other; None: they are given exact states. Ranges to obstacles are
            exact in any case.
        gated: whether each drone flies through its safety gate (`flockd.flight.safety.Gate`), on what it perceives.
        threads: to compute in what is not the flight code of single drones, its gate and its avoidance.
        progress: called with (flights done, flights in all).

    Raises UsageError for what cannot be flown without images, and for obstacles that do not fit into their world.
    """
    found: dict[int, Figures] = {}
    for numbers in _alike(scenarios):
        flights = FlockFlights([scenarios[number] for number in numbers], errors, gated=gated)
        with ExitStack() as stack:
            pool = stack.enter_context(ThreadPoolExecutor(threads)) if threads > 1 else None
            for step in range(flights.steps):
                flights.step(step, pool, threads)
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
        self._law = law_sums.law_figures(drone.flocking)
        self._missions = ManyMissions(scenario, f)
        self._errors: _Errors | None = None
        if errors is not None:
            tables = perceived_sums.by_distance(errors), perceived_sums.constants(errors, drone.step_s)
            self._errors = (*tables, np.array(seeds, dtype=np.int64))
        self._gated = gated
        self._obstacles = None if scenario.world.obstacles is None else ManyObstacles(scenarios)
        self._avoids = self._obstacles is not None and drone.obstacles.enabled
        self._code = FlightCode(drone, vehicle, f * n) if gated or self._avoids else None
        of_step = motion.Substeps.of(vehicle, drone.step_s)
        self._substeps = self._code.substeps if gated and self._code is not None else of_step
        self._blown = np.zeros((2, f * n))
        self._gusts = np.stack([GustField.of(vehicle, seed).waves for seed in seeds])
        self._figures = FlightFigures(f, n, self._times, drone.step_s, vehicle.radius_m)
        self._arrival_s, self._away_m = np.full(f, np.nan), np.full(f, np.nan)
        self._by_slot = np.empty((6, f, n))
        self._grids = np.empty((f, 5))
        self._starts = np.zeros((f, max(CELLS_A_DRONE * n, 16) + 1), np.int64)
        self._order = np.empty((f, n), np.int64)
        self.sums = np.zeros((2, f, n))
        """u of Eq. 38 without u_vf, m/s^2, as last perceived."""
        self.commands = np.zeros((2, f, n))
        """Velocities that drones were asked to fly with in the last step, m/s."""
        self._middles, self._own = (np.zeros((2, f, n)) for _ in range(2))
        self._room = perceived_sums.Room.of(n)
        self._before = self.states.copy()
        self._ways, self._farthest, self._nearest = np.empty((3, f, n)), np.empty(f), np.empty((5, f, n))

    def step(self, step: int, pool: ThreadPoolExecutor | None, threads: int) -> None:
        """One step of all flights."""
        f, n = self._shape
        drones = _parts(f * n, threads, _LEAST_DRONES)
        self.perceive(step, pool, threads)
        self._measure(step, pool, threads)
        begin_s = float(self._times[step])
        desired, height_m = self._missions.step(begin_s, self.states[:2], self._middles)
        self._note_goal(step)
        climbs = bool(np.isfinite(height_m).any())
        states, heights = self.states.reshape(6, -1), height_m.reshape(-1)
        own = states[3:5] if self._errors is None else self._own.reshape(2, -1)
        commands = self.commands.reshape(2, -1)

        def ask(a: int, b: int) -> None:
            p = self._drone.flocking
            motion.commands(
                a, b, self.sums.reshape(2, -1), desired.reshape(2, -1), p.velocity * p.own_weight, own,
                lookahead_s(self._drone.step_s), p.max_acceleration_m_s2, p.max_speed_m_s, commands,
            )  # fmt: skip

        def fly(a: int, b: int) -> None:
            motion.fly(a, b, begin_s, states, self._blown, commands, self._gusts, self._substeps)
            if climbs:
                motion.climb(a, b, states, heights, self._substeps)

        _run(pool, drones, ask)
        if self._code is not None:
            self._fly_by_code(self._code, step, desired.reshape(2, -1), own.copy(), heights)
        if not self._gated:
            _run(pool, drones, fly)

    def _fly_by_code(
        self, code: FlightCode, step: int, desired: FloatArray, own: FloatArray, heights: FloatArray
    ) -> None:
        """Lets each drone's own code turn its command aside from obstacles, and its gate, if any, fly it."""
        f, n = self._shape
        states, commands = self.states.reshape(6, -1), self.commands.reshape(2, -1)
        began = self.states.copy()
        time_s = float(self._times[step])
        for i in range(f * n):
            flight, slot = divmod(i, n)
            drone = flight * n + int(self._order[flight, slot])
            ranges = None
            if self._obstacles is not None and self._avoids:
                ranges = self._obstacles.look(flight, time_s, began[:3, flight, drone - flight * n])
            if ranges is None and not self._gated:
                continue
            seen = self._seen(step, flight, slot, began)
            if ranges is not None:
                commands[:, drone] = code.around(drone, own[:, drone], seen, desired[:, drone], ranges)
            else:
                commands[:, drone] = code.clear(drone, own[:, drone], commands[:, drone].copy(), seen)
            if self._gated:
                code.fly_gated(drone, time_s, states, self._blown, commands, heights, self._gusts, seen, ranges)

    def _seen(self, step: int, flight: int, slot: int, states: FloatArray) -> Seen:
        """What the drone of a slot knows of the others, of the flights' `states` as the step begins."""
        drone = int(self._order[flight, slot])
        if self._errors is None:
            others = np.delete(states[:, flight].T, drone, axis=0)
            numbers = [other for other in range(states.shape[2]) if other != drone]
            return Seen(others[:, :3] - states[:3, flight, drone], others[:, 3:], numbers=numbers)
        cells = self._by_slot, self._grids[flight], self._starts[flight], self._order
        table, figures, seeds = self._errors
        reach = perceived_sums.farthest(figures, self._law)
        count = perceived_sums.perceive(
            flight, slot, *cells, table, figures, seeds[flight], step, reach, *self._room
        )  # fmt: skip
        known = self._room.seen[:count]
        return Seen(known[:, [0, 1, 4]], np.column_stack([known[:, 2:4], known[:, 5]]), known[:, 6])

    def perceive(self, step: int, pool: ThreadPoolExecutor | None = None, threads: int = 1) -> None:
        """What each drone sees of the others now, and what the law makes of it: `sums`."""
        f, n = self._shape
        flights = _parts(f, threads, least=max(_LEAST_DRONES // n, 1))
        cells = self._grids, self._starts, self._order, self._by_slot
        _run(pool, flights, lambda a, b: sort_flights(a, b, self.states, *cells))
        _run(pool, _parts(f * n, threads, _LEAST_DRONES), lambda a, b: self._perceive(a, b, step))

    def _perceive(self, a: int, b: int, step: int) -> None:
        cells = self._by_slot, self._grids, self._starts, self._order
        weight = self._drone.flocking.weight
        if self._errors is not None:
            nearest = weight.nearest if weight.kind == "nearest" else 0
            perceived_sums.perceived_sums(
                a, b, *cells, self._law, nearest, *self._errors, step, self._missions.goal() is not None, self.sums,
                self._middles, self._own,
            )  # fmt: skip
            return
        if weight.kind == "uniform" or self._missions.goal() is not None:
            law_sums.uniform_sums(a, b, *cells, self._law, self.sums, self._middles)
        if weight.kind == "nearest":
            law_sums.nearest_sums(a, b, self.states, *cells, self._law, weight.nearest, self.sums)

    def _measure(self, step: int, pool: ThreadPoolExecutor | None, threads: int) -> None:
        """Takes the figures of a step."""
        f, n = self._shape
        if step == 0:
            self._before[:] = self.states
        of_ways = self._before, self.states, self._order, self._ways, self._farthest
        flights = _parts(f, threads, least=max(_LEAST_DRONES // n, 1))
        _run(pool, flights, lambda a, b: flock_figures.find_ways(a, b, *of_ways))
        self._before[:] = self.states
        cells = self._by_slot, self._grids, self._starts
        ways = self._order, self._ways, self._farthest, self._nearest
        parts = _parts(f * n, threads, _LEAST_DRONES)
        _run(pool, parts, lambda a, b: flock_figures.nearest_distances(a, b, *cells, *ways))
        self._figures.add(step, self._nearest)
        if self._obstacles is not None:
            self._obstacles.measure(self.states, ends=step == self.steps - 1)
        if self._figures.needs_union(step):
            unions, reach = np.empty(f), self._drone.flocking.observation_distance_m
            _run(pool, flights, lambda a, b: flock_figures.unions(a, b, *cells, reach, unions))
            self._figures.add_tail(self.states, unions)

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
    """Numbers of scenarios that can be flown side by side."""
    groups: list[tuple[object, list[int]]] = []
    for number, scenario in enumerate(scenarios):
        missions = [(vehicle.mission, vehicle.by_hand) for vehicle in scenario.vehicles]
        key = scenario.model_copy(update={"seed": 0, "vehicles": ()}), missions
        for known, numbers in groups:
            if known == key:
                numbers.append(number)
                break
        else:
            groups.append((key, [number]))
    return [numbers for _, numbers in groups]


def _parts(count: int, threads: int, least: int) -> list[tuple[int, int]]:
    """Divides 0 to `count` into as many parts as there are threads, of `least` or more each."""
    parts = max(min(threads, count // least), 1)
    edges = [count * k // parts for k in range(parts + 1)]
    return list(itertools.pairwise(edges))


def _run(pool: ThreadPoolExecutor | None, parts: list[tuple[int, int]], work: Callable[[int, int], None]) -> None:
    """Calls `work` with each part."""
    if pool is None or len(parts) == 1:
        for part in parts:
            work(*part)
        return
    for future in [pool.submit(work, *part) for part in parts]:
        future.result()
