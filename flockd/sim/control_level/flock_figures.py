"""Figures of many flights while they fly: distances from step to step, and order and union at the end of a flight."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from flockd.core.messages import FloatArray
from flockd.flight.geometry import share_at_closest
from flockd.sim.control_level.cells import row_of, slice_of_row

TAIL_S = 10.0
"""The end of a flight, over which order and union are means, as in a report."""
SAFE_M = 1.0
"""Nearer than this a pair counts against `safety`, as in `flockd.flight.flocking.metrics`."""


_share_at_closest = njit(nogil=True, cache=True, error_model="numpy")(share_at_closest)


@njit(nogil=True, cache=True, error_model="numpy")
def find_ways(first: int, last: int, before: Any, now: Any, order: Any, ways: Any, farthest: Any) -> None:
    """How far drones flew between two steps, beside the mean of their flight; of the flights from `first` to `last`.

    `before` and `now` (6, flights, n) are states. Fills `ways` (3, flights, n) m by slot, and `farthest` (flights,)
    with the longest of them, m. The mean is left out as it moves no two drones towards each other.
    """
    n = now.shape[2]
    for f in range(first, last):
        for part in range(3):
            mean = (now[part, f] - before[part, f]).sum() / n
            for slot in range(n):
                d = order[f, slot]
                ways[part, f, slot] = now[part, f, d] - before[part, f, d] - mean
        most = 0.0
        for slot in range(n):
            most = max(most, ways[0, f, slot] ** 2 + ways[1, f, slot] ** 2 + ways[2, f, slot] ** 2)
        farthest[f] = math.sqrt(most)


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_distances(
    begin: int, end: int, by_slot: Any, grids: Any, starts: Any, order: Any, ways: Any, farthest: Any, found: Any
) -> None:
    """Figures of the drones `begin` to before `end`, counted slot by slot through all flights.

    Fills `found` (5, flights, n) with the distance to the nearest other drone, m, infinite for one that is alone: since
    the last step in the plane and in space, each drone taken to have flown straight on its way (`find_ways`), and now
    in the plane and in space; then with how many are nearer than `SAFE_M` now.
    """
    n = by_slot.shape[2]
    for i in range(begin, end):
        f = i // n
        slot = i - f * n
        x, y, z, grid = by_slot[0, f], by_slot[1, f], by_slot[2, f], grids[f]
        u, v, w = ways[0, f], ways[1, f], ways[2, f]
        hx, hy, hz, hu, hv, hw = x[slot], y[slot], z[slot], u[slot], v[slot], w[slot]
        # A drone now farther away than `reach` was never nearer than `reach` less both drones' ways.
        both_ways = math.sqrt(hu * hu + hv * hv + hw * hw) + farthest[f]
        least_level = least = now_level = now = math.inf
        near = 0
        reach = max(grid[2], SAFE_M) + both_ways
        while n > 1:
            least_level = least = now_level = now = math.inf
            near = 0
            for row in range(row_of(hx - reach, grid), row_of(hx + reach, grid) + 1):
                a, b = slice_of_row(row, hx, hy, reach, grid, starts[f])
                for j in range(a, b):
                    if j != slot:
                        dx, dy, dz = x[j] - hx, y[j] - hy, z[j] - hz
                        d2 = dx * dx + dy * dy
                        s2 = d2 + dz * dz
                        now_level = min(now_level, d2)
                        now = min(now, s2)
                        near += s2 < SAFE_M * SAFE_M
                        # Back along the way from now, at a share s of it: |d + s w|^2 >= |d|^2 + 2 min(d . w, 0).
                        du, dv, dw = hu - u[j], hv - v[j], hw - w[j]
                        along = dx * du + dy * dv
                        if d2 + 2.0 * min(along, 0.0) < least_level:
                            s = _share_at_closest(along, du * du + dv * dv)
                            least_level = min(least_level, (dx + s * du) ** 2 + (dy + s * dv) ** 2)
                        along += dz * dw
                        if s2 + 2.0 * min(along, 0.0) < least:
                            s = _share_at_closest(along, du * du + dv * dv + dw * dw)
                            least = min(least, (dx + s * du) ** 2 + (dy + s * dv) ** 2 + (dz + s * dw) ** 2)
            if now <= reach * reach and math.sqrt(least) + both_ways <= reach:
                break
            reach *= 2.0
        d = order[f, slot]
        found[0, f, d] = math.sqrt(least_level)
        found[1, f, d] = math.sqrt(least)
        found[2, f, d] = math.sqrt(now_level)
        found[3, f, d] = math.sqrt(now)
        found[4, f, d] = near


@njit(nogil=True, cache=True, error_model="numpy")
def unions(first: int, last: int, by_slot: Any, grids: Any, starts: Any, reach: float, out: Any) -> None:
    """`flockd.flight.flocking.metrics.union` of the flights from `first` to before `last`, within `reach` m of each
    other."""
    n = by_slot.shape[2]
    parent = np.empty(n, np.int64)
    for f in range(first, last):
        x, y = by_slot[0, f], by_slot[1, f]
        parent[:] = np.arange(n)
        components = n
        for i in range(n):
            for row in range(row_of(x[i] - reach, grids[f]), row_of(x[i] + reach, grids[f]) + 1):
                a, b = slice_of_row(row, x[i], y[i], reach, grids[f], starts[f])
                for j in range(a, min(b, i)):
                    if (x[j] - x[i]) ** 2 + (y[j] - y[i]) ** 2 <= reach * reach:
                        one, other = _root(parent, i), _root(parent, j)
                        if one != other:
                            parent[one] = other
                            components -= 1
        out[f] = (n - components) / (n - 1) if n > 1 else 1.0


@njit(nogil=True, cache=True, error_model="numpy")
def _root(parent: Any, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(nogil=True, cache=True, error_model="numpy")
def gather(since_s: float, found: Any, touch_m: float, touching: Any, contacts: Any, first_s: Any, out: Any) -> None:
    """Takes one step's `nearest_distances` into the contacts so far; `out` (5, flights) is what else is of the step.

    That is the least distance since the last step, at `since_s`, in the plane and in space, the mean of the distances
    in the plane now, the least in space now, and how many pairs are not safe now. `touching` (flights, n), `contacts`
    and `first_s` (flights,) are changed in place.
    """
    n = found.shape[2]
    for f in range(found.shape[1]):
        out[:, f] = math.inf, math.inf, 0.0, math.inf, 0.0
        for i in range(n):
            out[0, f] = min(out[0, f], found[0, f, i])
            out[1, f] = min(out[1, f], found[1, f, i])
            out[2, f] += found[2, f, i] / n
            out[3, f] = min(out[3, f], found[3, f, i])
            out[4, f] += found[4, f, i] / 2
            touches = found[1, f, i] < touch_m
            if touches and not touching[f, i]:
                contacts[f] += 1
                first_s[f] = min(first_s[f], since_s)
            touching[f, i] = touches


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
        self._of_step = np.empty((5, flights))
        self._order, self._union, self._mean_nearest, self._extent = (np.zeros(flights) for _ in range(4))

    def needs_union(self, step: int) -> bool:
        """Whether `add_tail` has to be called in this step."""
        return bool(self._tail[step])

    def add(self, step: int, found: FloatArray) -> None:
        """Distances of one step and since the one before, as `nearest_distances` gives them."""
        last = max(step - 1, 0)
        gather(
            float(self._times[last]), found, 2 * self._radius_m, self._touching, self._contacts, self._first_s,
            self._of_step,
        )  # fmt: skip
        least_level, least, mean_level, least_now, unsafe_pairs = self._of_step
        np.minimum(self._least, least, out=self._least)
        np.minimum(self._least_level, least_level, out=self._least_level)
        for of_window, begins in (self._least_late, self._late), (self._least_tail, self._tail):
            if begins[step]:
                np.minimum(of_window, least if begins[last] else least_now, out=of_window)
        if self._tail[step]:
            self._mean_nearest += mean_level
        self._unsafe += unsafe_pairs

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
