"""The flocking law's sums over the neighbours, for all drones of many flights. Compiled.

The same figures as `flockd.flight.flocking.FlockingLaw.acceleration` (Eq. 38-41) but for the order in which they are
added up.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from flockd.core.config.flocking import FlockingParameters
from flockd.core.messages import FloatArray
from flockd.sim.control_level.cells import column_of, row_of, slice_of_row

MIN_DISTANCE_M = 1e-3
"""As in `flockd.flight.flocking.law`: nearer counts as this far."""
COHESION, ALIGNMENT, SEPARATION, OBSERVATION_M, DESIRED_M, SEPARATION_M, GROWTH = range(7)
"""Where in the array of `law_figures`. `GROWTH` times the square of a neighbour's age is the most that it may pull."""

_LN2 = 0.6931471805599453
_SQRT_HALF_BITS = 0x3FE6A09E667F3BCD
_MAGIC_BITS = 0x4338000000000000
_MAGIC = 6755399441055744.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})  # unsaid, it would be its caller's
def _log(x: float) -> float:
    """The natural logarithm of a normal, positive number to 1e-16 of itself, without a branch: four at once.

    x = 2^k m with m from sqrt(1/2) to sqrt(2), and log m = 2 artanh(s) with s = (m - 1) / (m + 1), by artanh's
    series: s^2 is below 0.03.
    """
    bits = np.float64(x).view(np.int64)
    k = (bits - np.int64(_SQRT_HALF_BITS)) >> np.int64(52)
    m = np.int64(bits - (k << np.int64(52))).view(np.float64)
    exponent = np.int64(k + np.int64(_MAGIC_BITS)).view(np.float64) - _MAGIC
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    series = 1 / 15 + z * (1 / 17 + z * (1 / 19 + z * (1 / 21)))
    series = 1 / 3 + z * (1 / 5 + z * (1 / 7 + z * (1 / 9 + z * (1 / 11 + z * (1 / 13 + z * series)))))
    return exponent * _LN2 + 2.0 * s * (1.0 + z * series)


def law_figures(p: FlockingParameters) -> FloatArray:
    """The law's parameters as the compiled functions take them."""
    return np.array(
        [
            p.cohesion, p.alignment, p.separation,
            p.observation_distance_m, p.desired_distance_m, p.separation_distance_m,
            math.inf if p.cohesion_time_s is None else p.max_acceleration_m_s2 / p.cohesion_time_s**2,
        ]
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"})
def _uniform_slice(a: int, b: int, here: Any, x: Any, y: Any, vx: Any, vy: Any, law: Any, sums: Any) -> Any:
    """Adds the drones of the slots from a to b to `sums`; returns how many are within the separation distance.

    `sums` (7,): cohesion's sum (north, east), velocities (north, east), how many, and of their places north and east.
    The own drone may be among them: it adds its own velocity, and nothing to cohesion.
    """
    reach2 = law[OBSERVATION_M] ** 2
    near2 = law[SEPARATION_M] ** 2
    scale = 1.0 / law[DESIRED_M] ** 2
    fn, fe, vn, ve, count, dn, de, near = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(a, b):
        dx = x[j] - here[0]
        dy = y[j] - here[1]
        d2 = dx * dx + dy * dy
        seen = 1.0 if d2 <= reach2 else 0.0
        pull = 0.5 * seen * _log(d2 * scale + 1e-300)
        fn += pull * dx
        fe += pull * dy
        vn += seen * vx[j]
        ve += seen * vy[j]
        dn += seen * dx
        de += seen * dy
        count += seen
        near += 1.0 if d2 <= near2 else 0.0
    sums[0] += fn
    sums[1] += fe
    sums[2] += vn
    sums[3] += ve
    sums[4] += count
    sums[5] += dn
    sums[6] += de
    return near


@njit(nogil=True, cache=True, error_model="numpy")
def uniform_sums(
    begin: int, end: int, by_slot: Any, grids: Any, starts: Any, order: Any, law: Any, out: Any, middles: Any
) -> None:
    """Sums for the drones `begin` to before `end`, counted slot by slot through all flights; weight 1 on all who are
    seen.

    `out` (2, flights, n) m/s^2 is u of Eq. 38 without u_vf, `middles` (2, flights, n) m the way from each drone to the
    middle of it and of those it sees.
    """
    n = by_slot.shape[2]
    sums = np.empty(7)
    here = np.empty(4)
    push = np.empty(2)
    reach = max(law[OBSERVATION_M], law[SEPARATION_M])
    for i in range(begin, end):
        f = i // n
        slot = i - f * n
        x, y, vx, vy = by_slot[0, f], by_slot[1, f], by_slot[3, f], by_slot[4, f]
        here[0], here[1], here[2], here[3] = x[slot], y[slot], vx[slot], vy[slot]
        sums[:] = 0.0
        near = 0.0
        first = row_of(here[0] - reach, grids[f])
        last = row_of(here[0] + reach, grids[f])
        for row in range(first, last + 1):
            a, b = slice_of_row(row, here[0], here[1], reach, grids[f], starts[f])
            near += _uniform_slice(a, b, here, x, y, vx, vy, law, sums)
        push[:] = 0.0
        if near > 1.0:
            first = row_of(here[0] - law[SEPARATION_M], grids[f])
            last = row_of(here[0] + law[SEPARATION_M], grids[f])
            for row in range(first, last + 1):
                a, b = slice_of_row(row, here[0], here[1], law[SEPARATION_M], grids[f], starts[f])
                touching = _separation_slice(a, b, here, x, y, law, push)
                if touching > (1.0 if a <= slot < b else 0.0):
                    for j in range(a, b):
                        if j != slot:
                            _touch(x[j] - here[0], y[j] - here[1], law, push, sums)
        d = order[f, slot]
        c = sums[4]
        out[0, f, d] = law[COHESION] * sums[0] + law[ALIGNMENT] * (sums[2] - c * here[2]) + push[0] - here[2]
        out[1, f, d] = law[COHESION] * sums[1] + law[ALIGNMENT] * (sums[3] - c * here[3]) + push[1] - here[3]
        middles[0, f, d] = sums[5] / c
        middles[1, f, d] = sums[6] / c


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"})
def _separation_slice(a: int, b: int, here: Any, x: Any, y: Any, law: Any, push: Any) -> Any:
    """Adds separation (Eq. 41) from the drones of the slots from a to b; returns how many are at hardly any distance.

    Those, nearer than `MIN_DISTANCE_M`, are left to `_touch`; the own drone is one of them.
    """
    near2 = law[SEPARATION_M] ** 2
    least2 = MIN_DISTANCE_M * MIN_DISTANCE_M
    inverse = 1.0 / law[SEPARATION_M]
    pn, pe, touching = 0.0, 0.0, 0.0
    for j in range(a, b):
        dx = x[j] - here[0]
        dy = y[j] - here[1]
        d2 = dx * dx + dy * dy
        touching += 1.0 if d2 < least2 else 0.0
        near = 1.0 if least2 <= d2 <= near2 else 0.0
        over = 1.0 / math.sqrt(max(d2, least2))
        crowding = near * (over - inverse)
        pn -= crowding * crowding * over * dx
        pe -= crowding * crowding * over * dy
    push[0] += law[SEPARATION] * pn
    push[1] += law[SEPARATION] * pe
    return touching


@njit(nogil=True, cache=True, error_model="numpy")
def _touch(dx: float, dy: float, law: Any, push: Any, sums: Any) -> None:
    """Adds to both a neighbour nearer than `MIN_DISTANCE_M`: its separation, and what its cohesion lacks.

    It counts as that far away, and as to the north where there is no direction.
    """
    d = math.sqrt(dx * dx + dy * dy)
    if d >= MIN_DISTANCE_M:
        return
    ex, ey = (1.0, 0.0) if d == 0.0 else (dx / d, dy / d)
    pull, _, _ = cohesion(dx, dy, law)
    added = 0.0 if d == 0.0 else 0.5 * _log(d * d / law[DESIRED_M] ** 2 + 1e-300)
    sums[0] += pull * ex - added * dx
    sums[1] += pull * ey - added * dy
    push[0] += separation(MIN_DISTANCE_M, law) * ex
    push[1] += separation(MIN_DISTANCE_M, law) * ey


@njit(nogil=True, cache=True, error_model="numpy")
def separation(distance: float, law: Any) -> float:
    """Along the line to a neighbour at that distance, m/s^2 (Eq. 41)."""
    crowding = max(1.0 / distance - 1.0 / law[SEPARATION_M], 0.0)
    return float(-law[SEPARATION] * crowding * crowding)


@njit(nogil=True, cache=True, error_model="numpy")
def insert_nearest(kept: int, most: int, key: float, number: int, keys: Any, numbers: Any) -> int:
    """Puts a neighbour into the sorted `keys` and `numbers` of the nearest; returns how many there are then, at `most`.

    Of two with the same key the smaller number counts as nearer.
    """
    if kept == most:
        if key > keys[kept - 1] or (key == keys[kept - 1] and number > numbers[kept - 1]):
            return kept
        kept -= 1
    k = kept
    while k > 0 and (keys[k - 1] > key or (keys[k - 1] == key and numbers[k - 1] > number)):
        keys[k] = keys[k - 1]
        numbers[k] = numbers[k - 1]
        k -= 1
    keys[k] = key
    numbers[k] = number
    return kept + 1


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_sums(
    begin: int, end: int, states: Any, by_slot: Any, grids: Any, starts: Any, order: Any, law: Any, nearest: int,
    out: Any,
) -> None:  # fmt: skip
    """As `uniform_sums`, with weight 1 on the `nearest` of those who are seen; square after square of cells around."""
    n = by_slot.shape[2]
    keys = np.empty(nearest)
    numbers = np.empty(nearest, np.int64)
    push = np.empty(2)
    reach = max(law[OBSERVATION_M], law[SEPARATION_M])
    for i in range(begin, end):
        f = i // n
        slot = i - f * n
        x, y, grid = by_slot[0, f], by_slot[1, f], grids[f]
        hx, hy, hvx, hvy = x[slot], y[slot], by_slot[3, f, slot], by_slot[4, f, slot]
        row, column = row_of(hx, grid), column_of(hy, grid)
        rows, columns = int(grid[3]), int(grid[4])
        kept = 0
        push[:] = 0.0
        ring = 0
        while True:
            for r in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
                step = 1 if abs(r - row) == ring else max(2 * ring, 1)
                for c in range(column - ring, column + ring + 1, step):
                    if c < 0 or c >= columns:
                        continue
                    for j in range(starts[f, r * columns + c], starts[f, r * columns + c + 1]):
                        if j == slot:
                            continue
                        dx, dy = x[j] - hx, y[j] - hy
                        d2 = dx * dx + dy * dy
                        if d2 <= law[OBSERVATION_M] ** 2:
                            kept = insert_nearest(kept, nearest, d2, order[f, j], keys, numbers)
                        if d2 <= law[SEPARATION_M] ** 2:
                            _, ex, ey = cohesion(dx, dy, law)
                            strength = separation(max(math.sqrt(d2), MIN_DISTANCE_M), law)
                            push[0] += strength * ex
                            push[1] += strength * ey
            looked = min(
                hx - (grid[0] + (row - ring) * grid[2]), grid[0] + (row + ring + 1) * grid[2] - hx,
                hy - (grid[1] + (column - ring) * grid[2]), grid[1] + (column + ring + 1) * grid[2] - hy,
            )  # fmt: skip
            needed = min(reach, max(math.sqrt(keys[kept - 1]), law[SEPARATION_M])) if kept == nearest else reach
            if looked > needed or (
                row - ring <= 0 and column - ring <= 0 and row + ring >= rows and column + ring >= columns
            ):
                break
            ring += 1
        ux, uy = 0.0, 0.0
        d = order[f, slot]
        for k in range(kept):
            other = numbers[k]
            dx, dy = states[0, f, other] - hx, states[1, f, other] - hy
            pull, ex, ey = cohesion(dx, dy, law)
            ux += law[COHESION] * pull * ex + law[ALIGNMENT] * (states[3, f, other] - hvx)
            uy += law[COHESION] * pull * ey + law[ALIGNMENT] * (states[4, f, other] - hvy)
        out[0, f, d] = ux + push[0] - hvx
        out[1, f, d] = uy + push[1] - hvy


@njit(nogil=True, cache=True, error_model="numpy")
def cohesion(dx: float, dy: float, law: Any) -> Any:
    """Towards one neighbour, in metres (Eq. 39 without C_f and W), and the direction to it."""
    d = math.sqrt(dx * dx + dy * dy)
    ex, ey = (1.0, 0.0) if d == 0.0 else (dx / d, dy / d)
    d = max(d, MIN_DISTANCE_M)
    return d * math.log(d / law[DESIRED_M]), ex, ey
