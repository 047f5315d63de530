"""Flies many flights of one scenario at once, without images: the law, the missions and the vehicles alone."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np

from flockd.config.scenario import ScenarioConfig
from flockd.control_level import flock_figures, law_sums, motion
from flockd.control_level.cells import CELLS_A_DRONE, sort_flights
from flockd.control_level.flock_figures import FlightFigures
from flockd.control_level.many_missions import ManyMissions
from flockd.messages import FloatArray

Figures = dict[str, float | int | bool | None]
START_SPREAD_M = 0.5
_LEAST_DRONES = 250
"""Of a thread: fewer are computed sooner than handed over."""
_SMALLEST_SHARE = 0.25
"""Of the distance to the nearest other start: no start is moved farther, so that none comes near another."""


def fly_flocks(
    scenario: ScenarioConfig,
    seeds: Sequence[int],
    *,
    start_spread_m: float = START_SPREAD_M,
    height_m: float | None = None,
    threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Figures]:
    """Flies a scenario once with each seed; the figures of each flight, in the order of the seeds.

    A flight is the same bit for bit whatever other flights are in the batch and however many threads there are.

    Args:
        scenario: what to fly, with any number of vehicles (`flockd.sim.start.with_drones`). Its own seed, sensors,
            world and rig do not count, nor do the safety gate and obstacles.
        seeds: of the gusts, and of the start positions.
        start_spread_m: each drone starts up to so far from its place, drawn from the seed, and no farther than a
            quarter of the way to the next; 0: at the scenario's own places, as in `flockd sim`.
        height_m: at which all drones start; None: as the scenario says.
        threads: to compute in.
        progress: called with (steps done, steps in all).

    Raises UsageError for what cannot be flown without images.
    """
    flights = FlockFlights(scenario, seeds, start_spread_m=start_spread_m, height_m=height_m)
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(threads)) if threads > 1 else None
        for step in range(flights.steps):
            flights.step(step, pool, threads)
            progress(step + 1, flights.steps)
    return flights.figures()


class FlockFlights:
    """A batch of flights, all at the same time; see `fly_flocks`."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        seeds: Sequence[int],
        *,
        start_spread_m: float = START_SPREAD_M,
        height_m: float | None = None,
    ) -> None:
        drone, vehicle = scenario.drone, scenario.vehicle
        self._drone, self._shape = drone, (len(seeds), len(scenario.vehicles))
        self.steps = round(scenario.duration_s / drone.step_s)
        self._times = np.arange(self.steps) * drone.step_s
        f, n = self._shape
        self.states = np.empty((6, f, n))
        """Position and velocity, NED."""
        for k, seed in enumerate(seeds):
            self.states[:, k] = _starts(scenario, seed, start_spread_m, height_m)
        self._law = law_sums.law_figures(drone.flocking)
        self._missions = ManyMissions(scenario, f)
        self._substeps = motion.Substeps.of(vehicle, drone.step_s)
        self._gusts = [motion.Gusts(vehicle, n, seed) for seed in seeds] if vehicle.gust_m_s else []
        self._figures = FlightFigures(f, n, self._times, drone.step_s, vehicle.radius_m)
        self._goal_times = np.full(f, np.nan)
        self._by_slot = np.empty((6, f, n))
        self._grids = np.empty((f, 5))
        self._starts = np.zeros((f, max(CELLS_A_DRONE * n, 16) + 1), np.int64)
        self._order = np.empty((f, n), np.int64)
        self.sums = np.zeros((2, f, n))
        """u of Eq. 38 without u_vf, m/s^2, as last perceived."""
        self._middles, self._commands = np.zeros((2, f, n)), np.zeros((2, f, n))
        self._level, self._straight, self._unsafe = (np.empty((f, n)) for _ in range(3))

    def step(self, step: int, pool: ThreadPoolExecutor | None, threads: int) -> None:
        """One step of all flights."""
        f, n = self._shape
        drones = _parts(f * n, threads, _LEAST_DRONES)
        self.perceive(pool, threads)
        self._measure(step, pool, threads)
        desired, height_m = self._missions.step(float(self._times[step]), self.states[:2], self._middles)
        self._note_goal(step)
        gusts = self._next_gusts()
        climbs = bool(np.isfinite(height_m).any())
        states, flat = self.states.reshape(6, -1), height_m.reshape(-1)

        def fly(a: int, b: int) -> None:
            p = self._drone.flocking
            commands = self._commands.reshape(2, -1)
            motion.commands(
                a, b, self.sums.reshape(2, -1), desired.reshape(2, -1), p.velocity * p.own_weight, states[3:5],
                self._drone.step_s, p.max_acceleration_m_s2, p.max_speed_m_s, commands,
            )  # fmt: skip
            motion.fly(a, b, states, commands, gusts, self._substeps)
            if climbs:
                motion.climb(a, b, states, flat, self._substeps)

        _run(pool, drones, fly)

    def perceive(self, pool: ThreadPoolExecutor | None = None, threads: int = 1) -> None:
        """What each drone sees of the others now, and what the law makes of it: `sums`."""
        f, n = self._shape
        flights = _parts(f, threads, least=max(_LEAST_DRONES // n, 1))
        cells = self._grids, self._starts, self._order, self._by_slot
        _run(pool, flights, lambda a, b: sort_flights(a, b, self.states, *cells))
        _run(pool, _parts(f * n, threads, _LEAST_DRONES), self._perceive)

    def _perceive(self, a: int, b: int) -> None:
        cells = self._by_slot, self._grids, self._starts, self._order
        weight = self._drone.flocking.weight
        if weight.kind == "uniform" or self._missions.goal() is not None:
            law_sums.uniform_sums(a, b, *cells, self._law, self.sums, self._middles)
        if weight.kind == "nearest":
            law_sums.nearest_sums(a, b, self.states, *cells, self._law, weight.nearest, self.sums)

    def _measure(self, step: int, pool: ThreadPoolExecutor | None, threads: int) -> None:
        """Takes the figures of a step."""
        f, n = self._shape
        cells = self._by_slot, self._grids, self._starts
        found = self._level, self._straight, self._unsafe
        parts = _parts(f * n, threads, _LEAST_DRONES)
        _run(pool, parts, lambda a, b: flock_figures.nearest_distances(a, b, *cells, self._order, *found))
        self._figures.add(step, *found)
        if self._figures.needs_union(step):
            unions, reach = np.empty(f), self._drone.flocking.observation_distance_m
            parts = _parts(f, threads, least=max(_LEAST_DRONES // n, 1))
            _run(pool, parts, lambda a, b: flock_figures.unions(a, b, *cells, reach, unions))
            self._figures.add_tail(self.states, unions)

    def _next_gusts(self) -> FloatArray:
        """(substeps, 2, flights * n) m/s^2."""
        if not self._gusts:
            return np.empty((0, 2, 0))
        return np.concatenate([gusts.step(self._substeps) for gusts in self._gusts], axis=2)

    def _note_goal(self, step: int) -> None:
        """When each flock's true middle first was at the last goal, once that was the one to fly to."""
        goal = self._missions.goal()
        if goal is not None:
            place, last = goal
            self._away_m = np.hypot(*(self.states[:2].mean(axis=2) - place[:, None]))
            there = last & (self._away_m <= self._missions.reached_m) & np.isnan(self._goal_times)
            self._goal_times[there] = self._times[step]

    def figures(self) -> list[Figures]:
        """Of each flight."""
        return [{**self._figures.of_flight(k), **self._of_goal(k)} for k in range(self._shape[0])]

    def _of_goal(self, flight: int) -> Figures:
        if self._missions.goal() is None:
            return {"arrived": None, "time_s": None, "final_error_m": None}
        since_s, away_m = float(self._goal_times[flight]), float(self._away_m[flight])
        return {
            "arrived": away_m <= self._missions.reached_m,
            "time_s": None if math.isnan(since_s) else since_s,
            "final_error_m": away_m,
        }


def _starts(scenario: ScenarioConfig, seed: int, spread_m: float, height_m: float | None) -> FloatArray:
    """States (6, n) NED at the start."""
    places = np.array([vehicle.position_m for vehicle in scenario.vehicles], dtype=float)
    if height_m is not None:
        places[:, 2] = -height_m
    velocities = np.array([[*vehicle.velocity_m_s, 0.0] for vehicle in scenario.vehicles], dtype=float)
    random = np.random.default_rng([seed, 1])
    angle, radius = random.uniform(0.0, 2 * math.pi, len(places)), np.sqrt(random.uniform(0.0, 1.0, len(places)))
    most_m = np.minimum(spread_m, _SMALLEST_SHARE * _nearest(places[:, :2]))
    places[:, 0] += most_m * radius * np.cos(angle)
    places[:, 1] += most_m * radius * np.sin(angle)
    return np.vstack([places.T, velocities.T])


def _nearest(places: FloatArray) -> FloatArray:
    """(n,) m from each of (n, 2) places to the nearest other."""
    if len(places) < 2:
        return np.full(len(places), np.inf)
    away = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    return np.asarray(away.min(axis=1))


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
