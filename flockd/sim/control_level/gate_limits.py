"""The gate's limit on how fast a drone flies towards its neighbours, for all drones of many flights. Compiled.

As `flockd.flight.safety.gate.Gate` with `flockd.flight.safety.approach.towards_neighbours` and
`flockd.flight.safety.half_planes`, which a test holds equal, at the rate of setpoints: each setpoint is as near to the
command as the last one sent, the acceleration limit, the neighbours and the obstacles allow. Neighbours are known from
the step's begin and go on as they flew then; obstacles too, where drones look for them. Fence, heights, and commands
that are late are left out.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.flight.obstacles.local_map import NEAREST_M
from flockd.flight.safety.approach import SAME_SPOT_M
from flockd.sim.control_level.cells import row_of, slice_of_row
from flockd.sim.control_level.motion import fly
from flockd.sim.control_level.perceived_sums import MOST_FALSE, perceive
from flockd.sim.worlds.obstacles import EXACT_SIGMA_M

MAX_SPEED, MAX_ACCELERATION, SEPARATION_M, ABOUT_M, BRAKING, REACTION = range(6)
"""Where in the array of `gate_figures`."""
CLEARANCE_M, NEARER_M, LEAST_M = range(3)
"""Where in the array of `obstacle_figures`."""
_ROUNDING_M_S = 1e-9
_PARALLEL = 1e-6
_GUSTS_M_S = 1.0
"""Faster than it was asked to fly, a drone may be by this at most: more would be no ordinary gust."""


def gate_figures(p: GateParameters, separation_m: float) -> FloatArray:
    """The gate's parameters as the compiled functions take them, with the distance to keep from neighbours."""
    about_m = max(separation_m, p.vertical_separation_m)
    return np.array([p.max_speed_m_s, p.max_acceleration_m_s2, separation_m, about_m, p.braking_m_s2, p.reaction_s])


def obstacle_figures(obstacles: ObstacleParameters, clearance_m: float) -> FloatArray:
    """What the compiled functions take of obstacles with exact ranges, with the distance to keep from them."""
    return np.array([clearance_m, obstacles.sigmas * EXACT_SIGMA_M, NEAREST_M])


@njit(nogil=True, cache=True, error_model="numpy")
def fly_gated(
    begin: int, end: int, by_slot: Any, grids: Any, starts: Any, order: Any, states: Any, commands: Any, sent: Any,
    fastest: Any, gate: Any, ticks: int, tick_s: float, gusts: Any, substeps: Any, errors: Any, step: int,
    obstacles: Any,
) -> None:  # fmt: skip
    """Moves the drones `begin` to before `end`, counted slot by slot through all flights, on by one step.

    `states` (6, flights * n) are moved in place towards `commands` (2, flights * n) m/s, by `ticks` setpoints
    `tick_s` apart; `sent` (2, flights * n) m/s is the last one sent, NaN before the first. `fastest` (flights,) m/s is
    the speed of each flight's fastest drone. `gusts` are of all substeps, and `substeps` those of one tick. `errors`
    are `by_distance`, `constants` and seeds as of `perceived_sums`; without rows the neighbours are exact. `obstacles`
    are `obstacle_figures`, the sectors' directions (sectors, 2), and how far obstacles are in each of them (flights *
    n, sectors) m, without rows where drones do not look for any.
    """
    n = by_slot.shape[2]
    table, figures, seeds = errors
    of_obstacles, directions, to_obstacles = obstacles
    seen, planes = np.empty((n + MOST_FALSE, 6)), np.empty((n + MOST_FALSE + len(directions), 3))
    points, known = np.empty((len(directions), 2)), 0
    slots, ranges, rays, z = np.empty(n, np.int64), np.empty(n), np.empty((n, 4)), np.empty(2)
    asked = np.empty(2)
    for i in range(begin, end):
        f = i // n
        slot = i - f * n
        d = f * n + order[f, slot]
        asked[0], asked[1] = commands[0, d], commands[1, d]
        if math.sqrt(asked[0] ** 2 + asked[1] ** 2) > gate[MAX_SPEED]:
            asked[:] = 0.0  # refused
        elapsed_s = tick_s
        if math.isnan(sent[0, d]):
            sent[0, d], sent[1, d] = limited(states[3, d], states[4, d], gate[MAX_SPEED])
            elapsed_s = 0.0
        most = max(math.sqrt(asked[0] ** 2 + asked[1] ** 2), math.sqrt(sent[0, d] ** 2 + sent[1, d] ** 2))
        own = max(math.sqrt(states[3, d] ** 2 + states[4, d] ** 2), most) + _GUSTS_M_S
        others = fastest[f] + _GUSTS_M_S
        reach = gate[SEPARATION_M] + needed_m(most, others, gate) + (own + others) * ticks * tick_s
        if table.shape[0] > 0:
            count = perceive(f, slot, by_slot, grids[f], starts[f], order, table, figures, seeds[f], step, reach,
                             slots, ranges, rays, seen, z)  # fmt: skip
        else:
            count = exact_neighbours(slot, by_slot[:, f], grids[f], starts[f], reach, seen)
        count = _that_may_bind(seen, count, most, own * ticks * tick_s, ticks * tick_s, gate)
        if len(to_obstacles) > 0:
            known = obstacle_points(to_obstacles[d], of_obstacles, directions, points)
        for tick in range(ticks):
            velocity = limited(asked[0] - sent[0, d], asked[1] - sent[1, d], gate[MAX_ACCELERATION] * elapsed_s)
            age_s = tick * tick_s
            bound = neighbour_limits(seen, count, age_s, states[:, d], gate, planes)
            bound = obstacle_limits(
                points, known, age_s * states[3, d], age_s * states[4, d], of_obstacles[CLEARANCE_M], gate[BRAKING],
                gate[REACTION], planes, bound,
            )  # fmt: skip
            sent[0, d], sent[1, d] = nearest_within(sent[0, d] + velocity[0], sent[1, d] + velocity[1], planes, bound)
            of_tick = gusts[tick * substeps[0] : (tick + 1) * substeps[0]]
            fly(d, d + 1, states, sent, of_tick, substeps)
            elapsed_s = tick_s


@njit(nogil=True, cache=True, error_model="numpy")
def limited(vn: float, ve: float, most: float) -> Any:
    """The vector itself if it is no longer than `most`, else the one of that length in its direction."""
    length = math.sqrt(vn * vn + ve * ve)
    return (vn, ve) if length <= most else (vn * (most / length), ve * (most / length))


@njit(nogil=True, cache=True, error_model="numpy")
def exact_neighbours(slot: int, flight: Any, grid: Any, starts: Any, reach: float, seen: Any) -> int:
    """Fills `seen` as `perceive` does with all within `reach` m in the plane; how many."""
    x, y = flight[0], flight[1]
    count = 0
    for row in range(row_of(x[slot] - reach, grid), row_of(x[slot] + reach, grid) + 1):
        a, b = slice_of_row(row, x[slot], y[slot], reach, grid, starts)
        for j in range(a, b):
            dx, dy = x[j] - x[slot], y[j] - y[slot]
            if j != slot and dx * dx + dy * dy <= reach * reach:
                seen[count, 0], seen[count, 1] = dx, dy
                seen[count, 2], seen[count, 3] = flight[3, j], flight[4, j]
                seen[count, 4], seen[count, 5] = flight[2, j] - flight[2, slot], flight[5, j]
                count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def needed_m(speed: float, comes: float, gate: Any) -> float:
    """The distance left from which on a neighbour that comes as fast limits nothing up to this speed."""
    b, lag = gate[BRAKING], gate[BRAKING] * gate[REACTION]
    own = speed * speed + 2.0 * speed * lag
    return float(max((own + comes * comes) / (2.0 * b) + comes * gate[REACTION], own / b))


@njit(nogil=True, cache=True, error_model="numpy")
def _that_may_bind(seen: Any, count: int, speed: float, way_m: float, step_s: float, gate: Any) -> int:
    """Keeps of `seen` those that may limit a speed within a step in which the drone itself flies `way_m`; how many."""
    kept = 0
    for k in range(count):
        away = math.sqrt(seen[k, 0] ** 2 + seen[k, 1] ** 2)
        flies = math.sqrt(seen[k, 2] ** 2 + seen[k, 3] ** 2)
        left = away - gate[SEPARATION_M] - way_m - flies * step_s
        if left < needed_m(speed, min(flies, gate[MAX_SPEED]), gate):
            seen[kept] = seen[k]
            kept += 1
    return kept


@njit(nogil=True, cache=True, error_model="numpy")
def neighbour_limits(seen: Any, count: int, age_s: float, state: Any, gate: Any, planes: Any) -> int:
    """Fills `planes` (.., 3) with directions to neighbours and speeds, `age_s` after they were seen; how many."""
    bound = 0
    b, lag = gate[BRAKING], gate[BRAKING] * gate[REACTION]
    for k in range(count):
        x = seen[k, 0] + age_s * (seen[k, 2] - state[3])
        y = seen[k, 1] + age_s * (seen[k, 3] - state[4])
        z = seen[k, 4] + age_s * (seen[k, 5] - state[5])
        away = math.sqrt(x * x + y * y)
        if away <= SAME_SPOT_M or abs(z) >= gate[ABOUT_M]:  # `perceive` moves one above or below that far off
            continue
        ex, ey = x / away, y / away
        comes = -min(max(seen[k, 2] * ex + seen[k, 3] * ey, -gate[MAX_SPEED]), gate[MAX_SPEED])
        left = away - gate[SEPARATION_M]
        most = 0.0
        if left > 0.0:
            square = lag * lag + 2.0 * b * (left - comes * gate[REACTION]) - comes * abs(comes)
            both = math.sqrt(lag * lag + b * left) - lag
            most = min(math.sqrt(max(square, lag * lag)) - lag, max(both, -comes))
        planes[bound, 0], planes[bound, 1], planes[bound, 2] = ex, ey, most
        bound += 1
    return bound


@njit(nogil=True, cache=True, error_model="numpy")
def obstacle_points(ranges: Any, figures: Any, directions: Any, points: Any) -> int:
    """Fills `points` (.., 2) as `flockd.flight.obstacles.nearest_points` from exact ranges (sectors,); how many."""
    count = 0
    for sector in range(ranges.size):
        if ranges[sector] < math.inf:
            away = max(ranges[sector] - figures[NEARER_M], figures[LEAST_M])
            points[count, 0], points[count, 1] = away * directions[sector, 0], away * directions[sector, 1]
            count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def obstacle_limits(
    points: Any, count: int, way_n: float, way_e: float, clearance_m: float, braking: float, reaction_s: float,
    planes: Any, bound: int,
) -> int:  # fmt: skip
    """Adds to the first `bound` of `planes` what `flockd.flight.safety.approach.towards_obstacles` says; how many then.

    Of obstacles seen at `points` (.., 2) m before the drone flew the way (`way_n`, `way_e`) m.
    """
    lag = braking * reaction_s
    for k in range(count):
        north, east = points[k, 0] - way_n, points[k, 1] - way_e
        away = math.sqrt(north * north + east * east)
        if away > 0.0:
            most = math.sqrt(lag * lag + 2.0 * braking * max(away - clearance_m, 0.0)) - lag
            planes[bound, 0], planes[bound, 1], planes[bound, 2] = north / away, east / away, most
            bound += 1
    return bound


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_within(vn: float, ve: float, planes: Any, count: int) -> Any:
    """`flockd.flight.safety.half_planes.nearest_within` of the first `count` of `planes` (.., 3), which it changes."""
    over = False
    for k in range(count):
        over = over or planes[k, 0] * vn + planes[k, 1] * ve > planes[k, 2]
    if not over:
        return vn, ve
    speed = math.sqrt(vn * vn + ve * ve)
    kept = 0
    for k in range(count):
        if planes[k, 2] <= speed + _ROUNDING_M_S:
            planes[kept] = planes[k]
            kept += 1
    found_n, found_e, nearest = 0.0, 0.0, speed * speed
    for i in range(kept):
        beyond = planes[i, 0] * vn + planes[i, 1] * ve - planes[i, 2]
        if beyond > 0.0 and beyond * beyond < nearest:
            pn, pe = vn - beyond * planes[i, 0], ve - beyond * planes[i, 1]
            if _fits(pn, pe, planes, kept):
                found_n, found_e, nearest = pn, pe, beyond * beyond
    for i in range(kept):
        for j in range(i + 1, kept):
            determinant = planes[i, 0] * planes[j, 1] - planes[i, 1] * planes[j, 0]
            if abs(determinant) <= _PARALLEL:
                continue
            pn = (planes[i, 2] * planes[j, 1] - planes[j, 2] * planes[i, 1]) / determinant
            pe = (planes[j, 2] * planes[i, 0] - planes[i, 2] * planes[j, 0]) / determinant
            away = (pn - vn) ** 2 + (pe - ve) ** 2
            if away < nearest and _fits(pn, pe, planes, kept):
                found_n, found_e, nearest = pn, pe, away
    return found_n, found_e


@njit(nogil=True, cache=True, error_model="numpy")
def _fits(vn: float, ve: float, planes: Any, count: int) -> bool:
    for k in range(count):  # noqa: SIM110 - compiled, where generators are slow
        if planes[k, 0] * vn + planes[k, 1] * ve - planes[k, 2] > _ROUNDING_M_S:
            return False
    return True
