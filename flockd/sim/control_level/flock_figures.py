"""Figures of many flights while they fly: distances from step to step, and order and union at the end of a flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flockd.core.messages import FloatArray, ObstacleRanges
from flockd.flight.geometry import closest_approach
from flockd.sim.control_level.near import Near
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.world.obstacle_worlds import clearances, obstacles_of
from flockd.sim.world.obstacles import true_ranges

TAIL_S = 10.0
"""The end of a flight, over which order and union are means, as in a report."""
SAFE_M = 1.0
"""Nearer than this a pair counts against `safety`, as in `flockd.flight.flocking.metrics`."""


class Nearest(NamedTuple):
    """Of each drone of some flights, (flights, n): m to the nearest other drone, infinite for one that is alone."""

    level_since: FloatArray
    """Since the last step, level, each drone taken to have flown straight."""
    since: FloatArray
    level_now: FloatArray
    now: FloatArray
    unsafe: FloatArray
    """How many are nearer than `SAFE_M` now."""


def nearest_distances(near: Near, before: FloatArray, now: FloatArray) -> Nearest:
    """Between the states (6, flights, n) of two steps; `near` is of those `now`."""
    shape = now.shape[1:]
    ways = now[:3] - before[:3]
    ways -= ways.mean(axis=2, keepdims=True)  # moves no two drones towards each other
    flown_m = np.sqrt((ways**2).sum(axis=0))
    places, ways = (part.reshape(3, -1).T for part in (now[:3], ways))
    who = np.arange(len(places))
    level_m, closest = near.nearest(1)
    now_m = np.hypot(level_m, places[closest, 2] - places[who, 2])
    # One that was nearer since than the nearest is now has gone both drones' ways from there at most.
    reach_m = np.maximum(now_m, SAFE_M) + (flown_m + flown_m.max(axis=1, keepdims=True)).ravel()
    owners, others = near.pairs(who, reach_m)
    end = places[others] - places[owners]
    begin = end - (ways[others] - ways[owners])
    apart_m = np.linalg.norm(end, axis=1)

    def least(distances: FloatArray) -> FloatArray:
        found = np.full(len(who), np.inf)
        np.minimum.at(found, owners, distances)
        return found.reshape(shape)

    unsafe = np.bincount(owners[apart_m < SAFE_M], minlength=len(who)).reshape(shape)
    return Nearest(
        least(closest_approach(begin[:, :2], end[:, :2])), least(closest_approach(begin, end)),
        level_m.reshape(shape), least(apart_m), unsafe.astype(float),
    )  # fmt: skip


def unions(near: Near, shape: tuple[int, int], reach_m: float) -> FloatArray:
    """`flockd.flight.flocking.metrics.union` of each of (flights, n), within `reach_m` of each other."""
    flights, n = shape
    who = np.arange(flights * n)
    pairs = near.pairs(who, np.full(len(who), reach_m))
    graph = coo_array((np.ones(len(pairs[0]), dtype=bool), pairs), shape=(len(who), len(who)))
    firsts = np.unique(connected_components(graph, directed=False)[1], return_index=True)[1]
    return (n - np.bincount(firsts // n, minlength=flights)) / (n - 1) if n > 1 else np.ones(flights)


def orders(velocity: FloatArray) -> FloatArray:
    """`flockd.flight.flocking.metrics.order` of each flight, (flights,): `velocity` (2, flights, n) m/s.

    The sum of all pairs' cosines is (|sum of directions|^2 - sum of their squared lengths) / 2.
    """
    n = velocity.shape[2]
    if n < 2:
        return np.ones(velocity.shape[1])
    speeds = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2)
    directions = np.divide(velocity, speeds, out=np.zeros_like(velocity), where=speeds > 0)
    together = (directions.sum(axis=2) ** 2).sum(axis=0)
    return np.asarray((together - (speeds > 0).sum(axis=1)) / (n * (n - 1)))


class FlightFigures:
    """Collects the figures of a batch of flights, one step after the other."""

    def __init__(self, flights: int, drones: int, times: FloatArray, step_s: float, radius_m: float) -> None:
        self._n, self._radius_m = drones, radius_m
        self._tail = times > times[-1] + step_s - TAIL_S - 1e-6
        self._late = times >= TAIL_S
        self._times = times
        self._least = np.full(flights, np.inf)
        self._least_level = np.full(flights, np.inf)
        self._least_late = np.full(flights, np.inf)
        self._least_tail = np.full(flights, np.inf)
        self._unsafe = np.zeros(flights)
        self._touching = np.zeros((flights, drones), dtype=bool)
        self._contacts = np.zeros(flights, dtype=np.int64)
        self._first_s = np.full(flights, np.inf)
        self._order, self._union, self._mean_nearest, self._extent = (np.zeros(flights) for _ in range(4))

    def needs_union(self, step: int) -> bool:
        """Whether `add_tail` has to be called in this step."""
        return bool(self._tail[step])

    def add(self, step: int, found: Nearest) -> None:
        """Distances of one step and since the one before."""
        last = max(step - 1, 0)
        least = found.since.min(axis=1)
        touching = found.since < 2 * self._radius_m
        self._contacts += (touching & ~self._touching).sum(axis=1)
        self._first_s = np.where(touching.any(axis=1), np.minimum(self._first_s, self._times[last]), self._first_s)
        self._touching = touching
        np.minimum(self._least, least, out=self._least)
        np.minimum(self._least_level, found.level_since.min(axis=1), out=self._least_level)
        for of_window, begins in (self._least_late, self._late), (self._least_tail, self._tail):
            if begins[step]:
                np.minimum(of_window, least if begins[last] else found.now.min(axis=1), out=of_window)
        if self._tail[step]:
            self._mean_nearest += found.level_now.mean(axis=1)
        self._unsafe += found.unsafe.sum(axis=1) / 2

    def add_tail(self, states: FloatArray, union: FloatArray) -> None:
        """`states` (6, flights, n) and the unions of a step of the tail."""
        self._order += orders(states[3:5])
        self._union += union
        places = states[:2] - states[:2].mean(axis=2, keepdims=True)
        self._extent += np.sqrt((places**2).sum(axis=0).mean(axis=1))

    def of_flight(self, flight: int) -> dict[str, float | int | None]:
        """The figures of one flight; None where there is nothing to say."""
        steps, tail, pairs = len(self._times), int(self._tail.sum()), self._n * (self._n - 1) / 2
        return {
            "min_distance_m": _finite(self._least[flight]),
            "min_distance_after_10s_m": _finite(self._least_late[flight]),
            "min_distance_tail_m": _finite(self._least_tail[flight]),
            "min_level_distance_m": _finite(self._least_level[flight]),
            "order_tail": float(self._order[flight] / tail),
            "union_tail": float(self._union[flight] / tail),
            "safety": 1.0 - float(self._unsafe[flight] / pairs / steps) if pairs else 1.0,
            "drone_collisions": int(self._contacts[flight]),
            "first_collision_s": _finite(self._first_s[flight]),
            "mean_nearest_tail_m": _finite(self._mean_nearest[flight] / tail),
            "rms_radius_tail_m": float(self._extent[flight] / tail),
        }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


FIGURES = "collisions", "min_clearance_m", "time_within_1m_s"
NEAR_M = 1.0
"""Nearer than this counts for `time_within_1m_s`, as in a report."""


class ManyObstacles:
    """Those of all flights of a batch, and what came of them so far: `flockd.review.report.summary.obstacle_figures`.

    Raises UsageError where obstacles do not fit into their world.
    """

    def __init__(self, scenarios: Sequence[ScenarioConfig]) -> None:
        scenario, f, n = scenarios[0], len(scenarios), len(scenarios[0].vehicles)
        self._worlds = [obstacles_of(one) for one in scenarios]
        self._step_s, self._radius_m = scenario.drone.step_s, scenario.vehicle.radius_m
        self._before: FloatArray | None = None
        self._touching = np.zeros((f, n), dtype=bool)
        self._contacts, self._near = np.zeros(f, np.int64), np.zeros(f, np.int64)
        self._least_m = np.full(f, np.inf)

    def look(self, flight: int, time_s: float, place: FloatArray) -> ObstacleRanges | None:
        """Exact ranges from a `place` (3,) NED; None where the flight has no obstacles."""
        world = self._worlds[flight]
        return true_ranges(world, time_s, place) if world.solids else None

    def measure(self, states: FloatArray, *, ends: bool) -> None:
        """Takes how near the drones came since the last step's `states` (6, flights, n); `ends`: this is the last."""
        if self._before is not None:
            self._take(self._before, states)
        if ends:
            self._take(states, states)
        self._before = states.copy()

    def _take(self, before: FloatArray, now: FloatArray) -> None:
        times = np.array([0.0, self._step_s if now is not before else 0.0])
        both = np.stack([before, now]).transpose(2, 0, 3, 1)
        ways = zip(self._worlds, both[..., :3], both[..., 3:], strict=True)
        free_m = np.array([clearances(world, times, places, flown)[0] for world, places, flown in ways])
        free_m -= self._radius_m
        touching = free_m < 0
        self._contacts += (touching & ~self._touching).sum(axis=1)
        self._touching = touching
        self._near += (free_m < NEAR_M).sum(axis=1)
        np.minimum(self._least_m, free_m.min(axis=1), out=self._least_m)

    def of_flight(self, flight: int) -> dict[str, float | int | None]:
        """The figures of one flight; None where it has no obstacles."""
        if not self._worlds[flight].solids:
            return dict.fromkeys(FIGURES)
        found = int(self._contacts[flight]), float(self._least_m[flight]), float(self._near[flight] * self._step_s)
        return dict(zip(FIGURES, found, strict=True))
