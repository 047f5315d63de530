"""Figures of many flights while they fly: distances from step to step, and order and union at the end of a flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import closest_approach
from flockd.review.report.summary import NEAR_M, TAIL_S
from flockd.sim.control_level.near import Near
from flockd.sim.flock.exact_states import step_times
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.world.obstacle_worlds import clearances
from flockd.sim.world.obstacles import Obstacles

Figures = dict[str, float | int | bool | None]
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

    def __init__(
        self, scenario: ScenarioConfig, worlds: Sequence[Obstacles], goal: FloatArray | None, reached_m: float
    ) -> None:
        """`worlds` of the flights; `goal` (2,) m, where their drones have one, is reached within `reached_m`."""
        self._scenario, self._worlds, self._goal, self._reached_m = scenario, worlds, goal, reached_m
        self._times = step_times(scenario)
        self._tail = self._times > self._times[-1] + scenario.drone.step_s - TAIL_S - 1e-6
        self._before: FloatArray | None = None
        self._touching = np.zeros((len(worlds), len(scenario.vehicles)), dtype=bool)
        self._steps: list[dict[str, FloatArray]] = []
        """Of each step (flights,) values by name."""
        self._flown: list[FloatArray] = []
        """States, where there are obstacles."""

    def add(self, states: FloatArray, near: Near, to_the_last: BoolArray) -> None:
        """The next step begins at `states` (6, flights, n); `to_the_last`: whose flock is on the way to its goal."""
        found = nearest_distances(near, states if self._before is None else self._before, states)
        touching = found.since < 2 * self._scenario.vehicle.radius_m
        middles = states[:2].mean(axis=2, keepdims=True)
        of_step = {
            "level_since": found.level_since.min(axis=1), "since": found.since.min(axis=1),
            "now": found.now.min(axis=1), "level_now": found.level_now.mean(axis=1), "unsafe": found.unsafe.sum(axis=1),
            "contacts": (touching & ~self._touching).sum(axis=1),
            "to_the_last": to_the_last, "order": orders(states[3:5]),
            "extent": np.sqrt(((states[:2] - middles) ** 2).sum(axis=0).mean(axis=1)),
        }  # fmt: skip
        if self._tail[len(self._steps)]:
            reach_m = self._scenario.drone.flocking.observation_distance_m
            of_step["union"] = unions(near, touching.shape, reach_m)
        if self._goal is not None:
            of_step["away"] = np.hypot(*(middles[:, :, 0] - self._goal[:, None]))
        if any(world.solids for world in self._worlds):
            self._flown.append(states.copy())
        self._steps.append(of_step)
        self._before, self._touching = states.copy(), touching

    def of_flights(self) -> list[Figures]:
        """The figures of each flight; None where there is nothing to say."""
        return [
            {**self._of_flock(k), **self._of_goal(k), **self._of_obstacles(k, world)}
            for k, world in enumerate(self._worlds)
        ]

    def _values(self, name: str, flight: int) -> FloatArray:
        """One flight's, of each step that has them."""
        return np.array([of_step[name][flight] for of_step in self._steps if name in of_step])

    def _of_flock(self, flight: int) -> Figures:
        def values(name: str) -> FloatArray:
            return self._values(name, flight)

        def tail_mean(name: str) -> float:
            of_tail: list[float] = values(name)[-int(self._tail.sum()) :].tolist()
            return sum(of_tail) / len(of_tail)

        def least_in(window: BoolArray) -> float | None:
            """From the first step of a window on, whose distances since the one before are outside of it."""
            begins = np.flatnonzero(window)[:1]
            within = window.copy()
            within[begins] = False
            return _least([*values("since")[within], *values("now")[begins]])

        n = self._touching.shape[1]
        pairs = n * (n - 1) / 2
        return {
            "min_distance_m": _least(values("since")),
            "min_distance_after_10s_m": least_in(self._times >= TAIL_S),
            "min_distance_tail_m": least_in(self._tail),
            "min_level_distance_m": _least(values("level_since")),
            "order_tail": tail_mean("order"),
            "union_tail": tail_mean("union"),
            "safety": 1.0 - sum(values("unsafe")) / 2 / pairs / len(self._steps) if pairs else 1.0,
            "drone_collisions": int(values("contacts").sum()),
            "mean_nearest_tail_m": tail_mean("level_now") if pairs else None,
            "rms_radius_tail_m": tail_mean("extent"),
        }

    def _of_goal(self, flight: int) -> Figures:
        """Whether and when the flock's true middle was at the last goal, once that was the one to fly to."""
        if self._goal is None:
            return dict.fromkeys(("arrived", "arrival_time_s", "final_error_m"))
        away_m, elsewhere = self._values("away", flight), np.flatnonzero(self._values("to_the_last", flight) == 0)
        there = np.flatnonzero(away_m <= self._reached_m)
        there = there[there > (elsewhere[-1] if len(elsewhere) else -1)]
        return {
            "arrived": bool(away_m[-1] <= self._reached_m),
            "arrival_time_s": float(self._times[there[0]]) if len(there) else None,
            "final_error_m": float(away_m[-1]),
        }

    def _of_obstacles(self, flight: int, world: Obstacles) -> Figures:
        """As `flockd.review.report.summary.obstacle_figures`."""
        if not world.solids:
            return dict.fromkeys(("collisions", "min_clearance_m", "time_within_1m_s"))
        flown = np.array(self._flown)[:, :, flight].transpose(1, 0, 2)
        places, velocities = np.moveaxis(flown[:3], 0, -1), np.moveaxis(flown[3:], 0, -1)
        free_m = clearances(world, self._times, places, velocities) - self._scenario.vehicle.radius_m
        touching = np.vstack([np.zeros(free_m.shape[1], dtype=bool), free_m < 0])
        return {
            "collisions": int((touching[1:] & ~touching[:-1]).sum()),
            "min_clearance_m": float(free_m.min()),
            "time_within_1m_s": float((free_m < NEAR_M).sum() * self._scenario.drone.step_s),
        }


def _least(values: Sequence[float] | FloatArray) -> float | None:
    """None without any, or where all are infinite: of one drone alone."""
    least = min(values, default=math.inf)
    return float(least) if math.isfinite(least) else None
