"""The obstacles of a batch of flights: each flight's own, how far off they are, and figures of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from flockd.core.config.scenario import ScenarioConfig
from flockd.core.messages import SECTORS, FloatArray
from flockd.sim.control_level.solid_distances import sector_ranges, solid_rows, way_clearances
from flockd.sim.worlds.obstacle_worlds import obstacles_of
from flockd.sim.worlds.obstacles import HEIGHT_BAND_M, POINTS_A_STEP, RANGE_LIMIT_M

FIGURES = "collisions", "min_clearance_m", "time_within_1m_s"
NEAR_M = 1.0
"""Nearer than this counts for `time_within_1m_s`, as in a report."""


Run = Callable[[Callable[[int, int], None]], None]
"""Calls a function for all drones of a batch: with numbers of drones, from the first to before the second."""


class ManyObstacles:
    """Those of all flights of a batch, and what came of them so far: `flockd.review.report.summary.obstacle_figures`.

    Raises UsageError where obstacles do not fit into their world.
    """

    def __init__(self, scenarios: Sequence[ScenarioConfig]) -> None:
        scenario, f, self._n = scenarios[0], len(scenarios), len(scenarios[0].vehicles)
        rows = [solid_rows(obstacles_of(one)) for one in scenarios]
        self._solids = np.concatenate(rows)
        self.first = np.array([0, *itertools.accumulate(len(one) for one in rows)])
        """(flights + 1,): where each flight's solids begin, of all."""
        self.ranges = np.full((f * self._n, SECTORS), np.inf)
        """Level metres from each drone to the nearest solid in each sector, inf without one, as last looked at."""
        self._step_s, self._radius_m = scenario.drone.step_s, scenario.vehicle.radius_m
        self._before: FloatArray | None = None
        self._touching = np.zeros((f, self._n), dtype=bool)
        self._contacts, self._near = np.zeros(f, np.int64), np.zeros(f, np.int64)
        self._least_m = np.full(f, np.inf)

    def look(self, states: FloatArray, run: Run) -> None:
        """Fills `ranges`; `states` (6, flights * n) NED."""
        band = np.array(HEIGHT_BAND_M)
        run(
            lambda a, b: sector_ranges(
                a, b, self._n, states, self._solids, self.first, band, RANGE_LIMIT_M, self.ranges
            )
        )

    def measure(self, states: FloatArray, run: Run, *, ends: bool) -> None:
        """Takes how near the drones came since the last step's `states` (6, flights * n); `ends`: this is the last."""
        if self._before is not None:
            self._take(self._before, states, self._step_s, run)
        if ends:
            self._take(states, states, 0.0, run)
        self._before = states.copy()

    def _take(self, before: FloatArray, now: FloatArray, step_s: float, run: Run) -> None:
        found = np.empty(len(self.ranges))
        run(
            lambda a, b: way_clearances(
                a, b, self._n, before, now, step_s, POINTS_A_STEP, self._solids, self.first, found
            )
        )
        free_m = found.reshape(self._touching.shape) - self._radius_m
        touching = free_m < 0
        self._contacts += (touching & ~self._touching).sum(axis=1)
        self._touching = touching
        self._near += (free_m < NEAR_M).sum(axis=1)
        np.minimum(self._least_m, free_m.min(axis=1), out=self._least_m)

    def of_flight(self, flight: int) -> dict[str, float | int | None]:
        """The figures of one flight; None where it has no obstacles."""
        if self.first[flight] == self.first[flight + 1]:
            return dict.fromkeys(FIGURES)
        found = int(self._contacts[flight]), float(self._least_m[flight]), float(self._near[flight] * self._step_s)
        return dict(zip(FIGURES, found, strict=True))
