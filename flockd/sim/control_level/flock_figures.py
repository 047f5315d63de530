"""Figures of many flights while they fly: distances from step to step, and order and union at the end of a flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import closest_approach
from flockd.review.report.summary import TAIL_S
from flockd.sim.control_level.perceived_flock import Near
from flockd.sim.flock.exact_states import step_times
from flockd.sim.scenario import ScenarioConfig

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
    owners, others = near.pairs(reach_m)
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
    pairs = near.pairs(reach_m)
    graph = coo_array((np.ones(len(pairs[0]), dtype=bool), pairs), shape=(flights * n, flights * n))
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

    def __init__(self, scenario: ScenarioConfig, flights: int) -> None:
        self._scenario = scenario
        self._times = step_times(scenario)
        self._tail = self._times > self._times[-1] + scenario.drone.step_s - TAIL_S - 1e-6
        self._before: FloatArray | None = None
        self._touching = np.zeros((flights, len(scenario.vehicles)), dtype=bool)
        self._steps: list[dict[str, FloatArray]] = []
        """Of each step (flights,) values by name."""

    def add(self, states: FloatArray, near: Near) -> None:
        """The next step begins at `states` (6, flights, n)."""
        found = nearest_distances(near, states if self._before is None else self._before, states)
        touching = found.since < 2 * self._scenario.vehicle.radius_m
        middles = states[:2].mean(axis=2, keepdims=True)
        of_step = {
            "level_since": found.level_since.min(axis=1), "since": found.since.min(axis=1),
            "now": found.now.min(axis=1), "level_now": found.level_now.mean(axis=1), "unsafe": found.unsafe.sum(axis=1),
            "contacts": (touching & ~self._touching).sum(axis=1),
            "order": orders(states[3:5]),
            "extent": np.sqrt(((states[:2] - middles) ** 2).sum(axis=0).mean(axis=1)),
        }  # fmt: skip
        if self._tail[len(self._steps)]:
            reach_m = self._scenario.drone.flocking.observation_distance_m
            of_step["union"] = unions(near, touching.shape, reach_m)
        self._steps.append(of_step)
        self._before, self._touching = states.copy(), touching

    def of_flights(self) -> list[Figures]:
        """The figures of each flight; None where there is nothing to say."""
        found = {name: np.array([one[name] for one in self._steps if name in one]).T for name in self._steps[-1]}
        return [self._of_flock({name: of[k] for name, of in found.items()}) for k in range(len(self._touching))]

    def _of_flock(self, values: Mapping[str, FloatArray]) -> Figures:
        """Of one flight. `values`: by name, one for each step that has it."""

        def tail_mean(name: str) -> float:
            of_tail: list[float] = values[name][-int(self._tail.sum()) :].tolist()
            return sum(of_tail) / len(of_tail)

        def least_in(window: BoolArray) -> float | None:
            """From the first step of a window on, whose distances since the one before are outside of it."""
            begins = np.flatnonzero(window)[:1]
            within = window.copy()
            within[begins] = False
            return _least([*values["since"][within], *values["now"][begins]])

        n = self._touching.shape[1]
        pairs = n * (n - 1) / 2
        return {
            "min_distance_m": _least(values["since"]),
            "min_distance_after_10s_m": least_in(self._times >= TAIL_S),
            "min_distance_tail_m": least_in(self._tail),
            "min_level_distance_m": _least(values["level_since"]),
            "order_tail": tail_mean("order"),
            "union_tail": tail_mean("union"),
            "safety": 1.0 - sum(values["unsafe"]) / 2 / pairs / len(self._steps) if pairs else 1.0,
            "drone_collisions": int(values["contacts"].sum()),
            "mean_nearest_tail_m": tail_mean("level_now") if pairs else None,
            "rms_radius_tail_m": tail_mean("extent"),
        }


def _least(values: Sequence[float] | FloatArray) -> float | None:
    """None without any, or where all are infinite: of one drone alone."""
    least = min(values, default=math.inf)
    return float(least) if math.isfinite(least) else None
