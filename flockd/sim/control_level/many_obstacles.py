"""The obstacles of a batch of flights: each flight's own, how far off they are, and figures of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flockd.core.messages import FloatArray, ObstacleRanges
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.world.clearances import clearances
from flockd.sim.world.obstacle_worlds import obstacles_of
from flockd.sim.world.obstacles import true_ranges

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
