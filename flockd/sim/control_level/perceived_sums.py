"""What each drone perceives of the others with the errors of cameras and networks, and what the law makes of it.

Errors are drawn without a memory: each is a function of the flight's seed, the two drones and the time, between normal
numbers at the ends of a stretch of time that the next stretch shares. So a flight is the same whatever is flown beside
it, and only those near are looked at. Compiled.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numba import njit

from flockd.core.config.perceived import PerceivedErrors, Spread
from flockd.core.messages import FloatArray, IntArray
from flockd.flight.geometry.level import SAME_SPOT_M
from flockd.sim.control_level.cells import row_of, slice_of_row
from flockd.sim.control_level.law_sums import (
    ALIGNMENT,
    COHESION,
    GROWTH,
    MIN_DISTANCE_M,
    OBSERVATION_M,
    SEPARATION_M,
    cohesion,
    insert_nearest,
    separation,
)

DISTANCE, MISSED, BIAS, RANGE, BEARING, VELOCITY = 0, 1, 2, 3, 5, 7
"""Columns of `by_distance`; an error takes two: of z and of z^3, for a normal number z."""
RANGE_LIMIT, ELEVATION, HIDDEN, RADIUS, STRETCH, MISSED_STRETCH, OWN, OWN_STRETCH, FALSE, LIFETIME, FALSE_M, STEP_S = (
    0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 14,
)  # fmt: skip
"""Entries of `constants`; `OWN` takes two, `FALSE_M` three."""
_STRETCHES = 1.7
"""An error's time constant times this is the stretch whose errors are alike for as long, taken over all lags."""
_Z50, _Z95 = 0.674490, 1.959964
"""Half of all normal numbers, and 95 %, are nearer to 0."""
MOST_FALSE = 4
"""False neighbours of a drone at one time, at most."""
_ENLARGE = 0.8
"""The k nearest are known once the k-th is nearer than this times how far was looked."""


class Room(NamedTuple):
    """What `perceive` fills, for flights of n drones."""

    slots: IntArray
    ranges: FloatArray
    rays: FloatArray
    seen: FloatArray
    z: FloatArray

    @classmethod
    def of(cls, n: int) -> Self:
        """With room for all others and the false ones."""
        return cls(np.empty(n, np.int64), np.empty(n), np.empty((n, 4)), np.empty((n + MOST_FALSE, 7)), np.empty(2))


def by_distance(errors: PerceivedErrors) -> FloatArray:
    """(entries, 9) for `perceived_sums`; what is missed as the normal number below which it is."""
    from scipy.special import ndtri  # noqa: PLC0415 - heavy

    rows = []
    for entry in errors.by_distance:
        missed = float(np.clip(ndtri(entry.missed), -9.0, 9.0))
        spreads = (entry.range_error, entry.bearing_error_deg, entry.velocity_error_m_s)
        of_range, of_bearing, of_velocity = (_cubic(spread) for spread in spreads)
        radians = tuple(math.radians(value) for value in of_bearing)
        rows.append([entry.distance_m, missed, entry.range_bias, *of_range, *radians, *of_velocity])
    return np.array(rows)


def constants(errors: PerceivedErrors, step_s: float) -> FloatArray:
    """The other figures for `perceived_sums`, with times in steps."""
    false = errors.false_neighbours
    return np.array(
        [
            errors.range_limit_m, math.sin(math.radians(errors.elevation_limit_deg)), errors.hidden_limit,
            errors.drone_radius_m, _STRETCHES * errors.error_time_s / step_s,
            _STRETCHES * errors.missed_time_s / step_s, *_cubic(errors.own_velocity_error_m_s),
            _STRETCHES * errors.own_velocity_time_s / step_s, min(false.at_once / MOST_FALSE, 1.0),
            false.lifetime_s / step_s, *false.distances_m, step_s,
        ]
    )  # fmt: skip


def _cubic(spread: Spread) -> tuple[float, float]:
    """a and b such that a z + b z^3, for a normal number z, has this median and 95th percentile."""
    b = (spread.p95 - spread.median * _Z95 / _Z50) / (_Z95**3 - _Z50**2 * _Z95)
    b = min(max(b, 0.0), spread.median / _Z50**3)
    return spread.median / _Z50 - b * _Z50**2, b


@njit(nogil=True, cache=True, error_model="numpy")
def _mixed(a: Any, b: Any, c: Any, d: Any) -> Any:
    """64 bits that depend on all bits of four numbers (the finaliser of SplitMix64, once for each)."""
    bits = np.uint64(0x9E3779B97F4A7C15)
    for number in (a, b, c, d):
        bits = (bits ^ np.uint64(number)) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        bits = bits ^ (bits >> np.uint64(31))
    return bits


@njit(nogil=True, cache=True, error_model="numpy")
def _uniform(bits: Any) -> float:
    """From above 0 to 1, of the upper 32 bits."""
    return (float(bits >> np.uint64(32)) + 1.0) * (1.0 / 4294967296.0)


@njit(nogil=True, cache=True, error_model="numpy")
def _normals(bits: Any, out: Any) -> None:
    """Two normal numbers (Box and Muller)."""
    radius = math.sqrt(-2.0 * math.log(_uniform(bits)))
    angle = 2.0 * math.pi * _uniform(bits << np.uint64(32))
    out[0] = radius * math.cos(angle)
    out[1] = radius * math.sin(angle)


@njit(nogil=True, cache=True, error_model="numpy")
def _slow_normals(seed: Any, pair: Any, kind: Any, step: float, stretch: float, out: Any) -> None:
    """Two normal numbers that change slowly: from one at a stretch's begin to one at its end, at equal variance."""
    phase = _uniform(_mixed(seed, pair, kind, -1))
    at = step / stretch + phase
    number = math.floor(at)
    share = (at - number) * (math.pi / 2)
    _normals(_mixed(seed, pair, kind, number), out)
    first, second = out[0] * math.cos(share), out[1] * math.cos(share)
    _normals(_mixed(seed, pair, kind, number + 1), out)
    out[0] = first + out[0] * math.sin(share)
    out[1] = second + out[1] * math.sin(share)


@njit(nogil=True, cache=True, error_model="numpy")
def _column(table: Any, d: float, column: int) -> float:
    """A column of `by_distance` at a distance, as at the ends beyond them."""
    last = table.shape[0] - 1
    if d <= table[0, 0]:
        return float(table[0, column])
    for k in range(last):
        if d < table[k + 1, 0]:
            share = (d - table[k, 0]) / (table[k + 1, 0] - table[k, 0])
            return float((1.0 - share) * table[k, column] + share * table[k + 1, column])
    return float(table[last, column])


@njit(nogil=True, cache=True, error_model="numpy")
def _error(table: Any, d: float, column: int, z: float) -> float:
    """The error that belongs to a normal number."""
    return _column(table, d, column) * z + _column(table, d, column + 1) * z * z * z


@njit(nogil=True, cache=True, error_model="numpy")
def _candidates(
    slot: int, x: Any, y: Any, z: Any, grid: Any, starts: Any, reach: float, elevation: float, slots: Any, ranges: Any
) -> int:
    """Fills `slots` and `ranges` with those within `reach` m and the cameras' view, from near to far; how many."""
    count = 0
    hx, hy, hz = x[slot], y[slot], z[slot]
    for row in range(row_of(hx - reach, grid), row_of(hx + reach, grid) + 1):
        a, b = slice_of_row(row, hx, hy, reach, grid, starts)
        for j in range(a, b):
            d = math.sqrt((x[j] - hx) ** 2 + (y[j] - hy) ** 2 + (z[j] - hz) ** 2)
            if j != slot and d <= reach and abs(z[j] - hz) <= elevation * d:
                slots[count] = j
                ranges[count] = d
                count += 1
    by_range = np.argsort(ranges[:count], kind="mergesort")
    slots[:count] = slots[:count][by_range]
    ranges[:count] = ranges[:count][by_range]
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def _hidden(rays: Any, seen: int, dx: float, dy: float, dz: float, d: float, radius: float) -> float:
    """How much of a drone those that are nearer hide, about: of two discs, by how deep they reach into each other.

    `rays` (n, 4) are directions and angular radii of the first `seen`.
    """
    share = 0.0
    own = radius / d
    for k in range(seen):
        between = (rays[k, 0] - dx / d) ** 2 + (rays[k, 1] - dy / d) ** 2 + (rays[k, 2] - dz / d) ** 2
        both = own + rays[k, 3]
        if between < both * both:
            share += min((both - math.sqrt(between)) / (2.0 * own), 1.0)
    return min(share, 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def perceived_sums(
    begin: int, end: int, by_slot: Any, grids: Any, starts: Any, order: Any, law: Any, nearest: int, table: Any,
    figures: Any, seeds: Any, step: int, all_seen: bool, out: Any, middles: Any, own: Any,
) -> None:  # fmt: skip
    """As `flockd.sim.control_level.law_sums.uniform_sums`, with errors; `nearest` 0 is uniform weight.

    `table` and `figures` are `by_distance` and `constants`, `seeds` (flights,). `own` (2, flights, n) m/s is what each
    drone takes for its velocity. With `all_seen` the middle is of all who are perceived, else of those looked at.
    """
    n = by_slot.shape[2]
    slots, ranges, rays = np.empty(n, np.int64), np.empty(n), np.empty((n, 4))
    room = n + MOST_FALSE
    seen = np.empty((room, 7))
    keys, numbers = np.empty(max(nearest, 1)), np.empty(max(nearest, 1), np.int64)
    z, sums = np.empty(2), np.empty(2)
    limit = farthest(figures, law)
    for i in range(begin, end):
        f = i // n
        slot = i - f * n
        drone = order[f, slot]
        _slow_normals(seeds[f], drone, 0, step, figures[OWN_STRETCH], z)
        vn = by_slot[3, f, slot] + figures[OWN] * z[0] + figures[OWN + 1] * z[0] ** 3
        ve = by_slot[4, f, slot] + figures[OWN] * z[1] + figures[OWN + 1] * z[1] ** 3
        own[0, f, drone], own[1, f, drone] = vn, ve
        whole = nearest == 0 or all_seen
        reach = limit if whole else min(limit, max(4.0 * grids[f, 2], 2.0 * law[SEPARATION_M]))
        while True:
            count = perceive(f, slot, by_slot, grids[f], starts[f], order, table, figures, seeds[f], step, reach,
                              slots, ranges, rays, seen, z)  # fmt: skip
            _part(seen, count)
            kept = 0
            for k in range(count):
                level = seen[k, 0] ** 2 + seen[k, 1] ** 2
                if nearest > 0 and level <= law[OBSERVATION_M] ** 2:
                    kept = insert_nearest(kept, nearest, level, k, keys, numbers)
            if reach >= limit or (kept == nearest and math.sqrt(keys[kept - 1]) <= _ENLARGE * reach):
                break
            reach = min(2.0 * reach, limit)
        sums[:] = 0.0
        for k in range(count if nearest == 0 else kept):
            j = k if nearest == 0 else numbers[k]
            if seen[j, 0] ** 2 + seen[j, 1] ** 2 <= law[OBSERVATION_M] ** 2:
                pull, ex, ey = cohesion(seen[j, 0], seen[j, 1], law)
                pull = law[COHESION] * pull
                grown = law[GROWTH] * seen[j, 6] ** 2
                pull = grown if pull > grown else pull
                sums[0] += pull * ex + law[ALIGNMENT] * (seen[j, 2] - vn)
                sums[1] += pull * ey + law[ALIGNMENT] * (seen[j, 3] - ve)
        middle_n, middle_e = 0.0, 0.0
        for k in range(count):
            middle_n += seen[k, 0]
            middle_e += seen[k, 1]
            if seen[k, 0] ** 2 + seen[k, 1] ** 2 <= law[SEPARATION_M] ** 2:
                _, ex, ey = cohesion(seen[k, 0], seen[k, 1], law)
                away = max(math.sqrt(seen[k, 0] ** 2 + seen[k, 1] ** 2), MIN_DISTANCE_M)
                sums[0] += separation(away, law) * ex
                sums[1] += separation(away, law) * ey
        out[0, f, drone] = sums[0] - vn
        out[1, f, drone] = sums[1] - ve
        middles[0, f, drone] = middle_n / (count + 1)
        middles[1, f, drone] = middle_e / (count + 1)


@njit(nogil=True, cache=True, error_model="numpy")
def _part(seen: Any, count: int) -> None:
    """As `flockd.flight.flocking.level_offsets`."""
    for k in range(count):
        if seen[k, 0] ** 2 + seen[k, 1] ** 2 < SAME_SPOT_M * SAME_SPOT_M:
            seen[k, 0], seen[k, 1] = 0.0, -SAME_SPOT_M if seen[k, 4] > 0.0 else SAME_SPOT_M


@njit(nogil=True, cache=True, error_model="numpy")
def farthest(figures: Any, law: Any) -> float:
    """How far away a neighbour is that counts at all, m."""
    return float(min(figures[RANGE_LIMIT], max(law[OBSERVATION_M], law[SEPARATION_M]) * 2.0))


@njit(nogil=True, cache=True, error_model="numpy")
def perceive(
    f: int, slot: int, by_slot: Any, grid: Any, starts: Any, order: Any, table: Any, figures: Any, seed: Any, step: int,
    reach: float, slots: Any, ranges: Any, rays: Any, seen: Any, z: Any,
) -> int:  # fmt: skip
    """Fills `seen` (.., 7) with the neighbours that one drone perceives; how many.

    A row is the level place, m from the drone, and velocity, m/s; without errors, how far below it is and sinks; and
    for how long it has been seen, s: those that are there as if always.
    """
    n = by_slot.shape[2]
    x, y, depth = by_slot[0, f], by_slot[1, f], by_slot[2, f]
    drone = order[f, slot]
    near = _candidates(slot, x, y, depth, grid, starts, reach, figures[ELEVATION], slots, ranges)
    count, rays_kept = 0, 0
    for k in range(near):
        j, d = slots[k], max(ranges[k], MIN_DISTANCE_M)
        dx, dy, dz = x[j] - x[slot], y[j] - y[slot], depth[j] - depth[slot]
        if _hidden(rays, rays_kept, dx, dy, dz, d, figures[RADIUS]) > figures[HIDDEN]:
            continue  # what hides it hides what is behind it too
        rays[rays_kept] = dx / d, dy / d, dz / d, figures[RADIUS] / d
        rays_kept += 1
        pair = drone * n + order[f, j]
        _slow_normals(seed, pair, 1, step, figures[MISSED_STRETCH], z)
        if z[0] < _column(table, d, MISSED):
            continue
        _slow_normals(seed, pair, 2, step, figures[STRETCH], z)
        longer = math.exp(_column(table, d, BIAS) + _error(table, d, RANGE, z[0]))
        turn = _error(table, d, BEARING, z[1])
        px, py = (
            longer * (dx * math.cos(turn) - dy * math.sin(turn)),
            longer * (dx * math.sin(turn) + dy * math.cos(turn)),
        )
        _slow_normals(seed, pair, 3, step, figures[STRETCH], z)
        seen[count, 0], seen[count, 1] = px, py
        seen[count, 2] = by_slot[3, f, j] + _error(table, d, VELOCITY, z[0])
        seen[count, 3] = by_slot[4, f, j] + _error(table, d, VELOCITY, z[1])
        seen[count, 4], seen[count, 5], seen[count, 6] = dz, by_slot[5, f, j], math.inf
        count += 1
    for k in range(MOST_FALSE):
        at = step / figures[LIFETIME] + _uniform(_mixed(seed, drone, 4 + k, -1))
        bits = _mixed(seed, drone, 4 + k, math.floor(at))
        if _uniform(bits) > figures[FALSE]:
            continue
        bits = _mixed(seed, drone, 8 + k, math.floor(at))
        bearing, share = 2.0 * math.pi * _uniform(bits), 2.0 * _uniform(bits << np.uint64(32))
        middle = figures[FALSE_M + 1]
        d = (
            figures[FALSE_M] * (1.0 - share) + middle * share
            if share < 1.0
            else (middle * (2.0 - share) + figures[FALSE_M + 2] * (share - 1.0))
        )
        if d <= reach:
            seen[count, 0], seen[count, 1] = d * math.cos(bearing), d * math.sin(bearing)
            seen[count, 2], seen[count, 3] = by_slot[3, f, slot], by_slot[4, f, slot]
            seen[count, 4], seen[count, 5] = 0.0, by_slot[5, f, slot]
            seen[count, 6] = (at - math.floor(at)) * figures[LIFETIME] * figures[STEP_S]
            count += 1
    return count
