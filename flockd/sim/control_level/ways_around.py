"""Each drone's way around obstacles, for all drones of many flights. Compiled.

As `flockd.flight.obstacles.Avoidance` on exact ranges, which a test holds equal: what the law wants is turned into a
free direction, slowed to what stops in time, and limited towards what is near. A direction is looked at only where it
may be the cheapest: mostly one of 144.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numba import njit

from flockd.core.config.drone import DroneConfig
from flockd.core.messages import FloatArray
from flockd.flight.flocking.law import SAME_SPOT_M
from flockd.flight.obstacles.avoidance import AWAY_PER_S
from flockd.flight.obstacles.local_map import DIRECTIONS
from flockd.flight.obstacles.steering import BESIDE_M, FLOCK, LAST, RIGHT_RAD, SHORTER, TURNED_RAD, TURNS
from flockd.sim.control_level.gate_limits import (
    BRAKING,
    CLEARANCE_M,
    MAX_SPEED,
    SEPARATION_M,
    exact_neighbours,
    gate_figures,
    limited,
    nearest_within,
    needed_m,
    neighbour_limits,
    obstacle_figures,
    obstacle_limits,
    obstacle_points,
)
from flockd.sim.control_level.law_sums import COHESION, MIN_DISTANCE_M, OBSERVATION_M, cohesion, law_figures, separation
from flockd.sim.control_level.perceived_sums import MOST_FALSE, farthest, perceive
from flockd.sim.worlds.obstacles import RANGE_LIMIT_M

FOLLOWING, STEP_S, MAX_U, MAX_V, LAG_S, MARGIN_M, RANGE_M, HORIZON_S = range(8)
"""Where in `Rules.figures`: the law's pull and limits, the time until a command acts, and of `ObstacleParameters`."""


class Rules(NamedTuple):
    """The parameters of law, gate and avoidance as the compiled functions take them."""

    figures: FloatArray
    law: FloatArray
    gate: FloatArray
    obstacles: FloatArray
    turns: FloatArray
    """(144,) rad from the wanted direction."""
    costs: FloatArray
    """(144,) rad: of each turn by itself."""
    directions: FloatArray
    """(sectors, 2)"""

    @classmethod
    def of(cls, drone: DroneConfig) -> Self:
        """Of one drone's configuration."""
        p, gate, law = drone.obstacles, drone.safety.gate, drone.flocking
        following, lag_s = law.velocity * law.own_weight, gate.reaction_s + drone.step_s
        figures = [
            following, drone.step_s, law.max_acceleration_m_s2, law.max_speed_m_s, lag_s, p.margin_m, p.range_m,
            p.horizon_s,
        ]  # fmt: skip
        costs = np.abs(TURNS) + np.where(TURNS < 0, RIGHT_RAD, 0.0)
        return cls(
            np.array(figures), law_figures(law), gate_figures(gate, gate.degraded_separation_m),
            obstacle_figures(p, p.clearance_m), TURNS, costs, DIRECTIONS,
        )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def fly_around(
    begin: int, end: int, by_slot: Any, grids: Any, starts: Any, order: Any, sums: Any, desired: Any, own: Any,
    ranges: Any, first: Any, rules: Any, errors: Any, step: int, last_rad: Any, commands: Any,
) -> None:  # fmt: skip
    """Velocities to ask for, of the drones `begin` to before `end`, counted slot by slot through all flights.

    `sums` and `desired` (2, flights * n) as of `motion.commands`, `own` (2, flights * n) m/s, `ranges` (flights * n,
    sectors) m. `last_rad` (flights * n,) is the direction in which each drone went around last, NaN for none, and is
    changed. Fills `commands` (2, flights * n) m/s but for flights without solids, by `first` as of `sector_ranges`.
    `errors` are as of `gate_limits.fly_gated`.
    """
    n = by_slot.shape[2]
    figures, law, gate = rules.figures, rules.law, rules.gate
    table, perceived, seeds = errors
    seen, planes = np.empty((n + MOST_FALSE, 6)), np.empty((n + MOST_FALSE + ranges.shape[1], 3))
    slots, distances, rays, z = np.empty(n, np.int64), np.empty(n), np.empty((n, 4)), np.empty(2)
    points = np.empty((ranges.shape[1], 2))
    for i in range(begin, end):
        f = i // n
        if first[f] == first[f + 1]:
            continue
        slot = i - f * n
        d = f * n + order[f, slot]
        vn, ve = own[0, d], own[1, d]
        un, ue = sums[0, d] + figures[FOLLOWING] * desired[0, d], sums[1, d] + figures[FOLLOWING] * desired[1, d]
        if table.shape[0] > 0:
            reach = farthest(perceived, law)
            count = perceive(f, slot, by_slot, grids[f], starts[f], order, table, perceived, seeds[f], step, reach,
                             slots, distances, rays, seen, z)  # fmt: skip
            flock_n, flock_e = _mean_seen(seen, count)
        else:
            reach = max(gate[SEPARATION_M] + needed_m(figures[MAX_V], gate[MAX_SPEED], gate), SAME_SPOT_M)
            count = exact_neighbours(slot, by_slot[:, f], grids[f], starts[f], reach, seen)
            more_n, more_e = _same_spot(seen, count, law)
            un, ue = un + more_n, ue + more_e
            flock_n, flock_e = _mean_others(slot, by_slot[3, f], by_slot[4, f])
        wanted_n, wanted_e = limited(vn + un, ve + ue, figures[MAX_V])
        known = obstacle_points(ranges[d], rules.obstacles, rules.directions, points)
        flown_n, flown_e, last_rad[d] = _steered(
            wanted_n, wanted_e, flock_n, flock_e, last_rad[d], ranges[d], points[:known], rules
        )
        un, ue = limited(flown_n - vn, flown_e - ve, figures[MAX_U])
        asked_n, asked_e = limited(vn + un * figures[STEP_S], ve + ue * figures[STEP_S], figures[MAX_V])
        bound = neighbour_limits(seen, count, 0.0, by_slot[:, f, slot], gate, planes)
        clearance_m = rules.obstacles[CLEARANCE_M]
        bound = obstacle_limits(
            points, known, 0.0, 0.0, clearance_m, gate[BRAKING], figures[LAG_S], planes, bound
        )  # fmt: skip
        commands[0, d], commands[1, d] = nearest_within(asked_n, asked_e, planes, bound)


@njit(nogil=True, cache=True, error_model="numpy")
def _mean_seen(seen: Any, count: int) -> Any:
    """The neighbours' mean velocity, m/s; 0 without any."""
    north, east = 0.0, 0.0
    for k in range(count):
        north += seen[k, 2]
        east += seen[k, 3]
    return north / max(count, 1), east / max(count, 1)


@njit(nogil=True, cache=True, error_model="numpy")
def _mean_others(slot: int, vn: Any, ve: Any) -> Any:
    """As `_mean_seen`, of all others of a flight."""
    north, east = 0.0, 0.0
    for k in range(vn.size):
        if k != slot:
            north += vn[k]
            east += ve[k]
    return north / max(vn.size - 1, 1), east / max(vn.size - 1, 1)


@njit(nogil=True, cache=True, error_model="numpy")
def _same_spot(seen: Any, count: int, law: Any) -> Any:
    """What the law adds, m/s^2, when neighbours above or below are moved aside as by `flocking.level_offsets`.

    Each of them is taken to have weight, as it has unless more are there than have weight at all.
    """
    north, east = 0.0, 0.0
    for k in range(count):
        x, y = seen[k, 0], seen[k, 1]
        if math.sqrt(x * x + y * y) < SAME_SPOT_M:
            aside_n, aside_e = _pull(0.0, -SAME_SPOT_M if seen[k, 4] > 0.0 else SAME_SPOT_M, law)
            there_n, there_e = _pull(x, y, law)
            north += aside_n - there_n
            east += aside_e - there_e
    return north, east


@njit(nogil=True, cache=True, error_model="numpy")
def _pull(x: float, y: float, law: Any) -> Any:
    """Cohesion and separation of one neighbour that has weight, m/s^2."""
    pull, ex, ey = cohesion(x, y, law)
    away = math.sqrt(x * x + y * y)
    pull = law[COHESION] * pull if away <= law[OBSERVATION_M] else 0.0
    pull += separation(max(away, MIN_DISTANCE_M), law)
    return pull * ex, pull * ey


@njit(nogil=True, cache=True, error_model="numpy")
def _steered(
    wanted_n: float, wanted_e: float, flock_n: float, flock_e: float, last_rad: float, ranges: Any, points: Any,
    rules: Any,
) -> Any:  # fmt: skip
    """`flockd.flight.obstacles.Avoidance.steered`: a velocity, and the direction to remember."""
    speed = math.sqrt(wanted_n * wanted_n + wanted_e * wanted_e)
    north, east = 0.0, 0.0
    if speed > 0.0:
        turn, free_m = _around(wanted_n, wanted_e, flock_n, flock_e, last_rad, ranges, points, rules)
        cosine, sine = math.cos(turn), math.sin(turn)
        north, east = cosine * wanted_n - sine * wanted_e, sine * wanted_n + cosine * wanted_e
        last_rad = math.atan2(east, north) if abs(turn) > TURNED_RAD else math.nan
        lag = rules.gate[BRAKING] * rules.figures[LAG_S]
        north, east = limited(north, east, math.sqrt(lag * lag + 2.0 * rules.gate[BRAKING] * max(free_m, 0.0)) - lag)
    least, nearest = rules.obstacles[CLEARANCE_M], -1
    for k in range(points.shape[0]):
        away = math.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2)
        if away < least:
            least, nearest = away, k
    if nearest >= 0:
        share = AWAY_PER_S * (rules.obstacles[CLEARANCE_M] - least) / least
        north -= share * points[nearest, 0]
        east -= share * points[nearest, 1]
    return north, east, last_rad


@njit(nogil=True, cache=True, error_model="numpy")
def _around(
    wanted_n: float, wanted_e: float, flock_n: float, flock_e: float, last_rad: float, ranges: Any, points: Any,
    rules: Any,
) -> Any:  # fmt: skip
    """`flockd.flight.obstacles.steering.Steering.around`: a turn, and how far the way is free in that direction."""
    figures, turns = rules.figures, rules.turns
    wanted_rad = math.atan2(wanted_e, wanted_n)
    way_m = math.sqrt(wanted_n * wanted_n + wanted_e * wanted_e) * figures[HORIZON_S]
    costs = _costs(wanted_rad, flock_n, flock_e, last_rad, rules)
    clearance_m = rules.obstacles[CLEARANCE_M]
    nearest_m = math.inf
    for k in range(points.shape[0]):
        nearest_m = min(nearest_m, math.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2))
    with_margin_m = min(max(nearest_m - BESIDE_M, clearance_m), clearance_m + figures[MARGIN_M])
    free_m = np.empty(turns.size)
    for radius_m in (with_margin_m, clearance_m):
        free_m[:] = math.nan
        for share in SHORTER:
            needed = min(share * way_m, figures[RANGE_M] - radius_m)
            best = -1
            for k in range(turns.size):  # from the wanted direction to both sides: first those likely to be cheap
                i = (turns.size // 2 + ((k + 1) // 2 if k % 2 else -(k // 2))) % turns.size
                if best >= 0 and (costs[i] > costs[best] or (costs[i] == costs[best] and i > best)):
                    continue
                if math.isnan(free_m[i]):
                    free_m[i] = _free_way(wanted_rad + turns[i], radius_m, ranges, points)
                if free_m[i] >= needed:
                    best = i
            if best >= 0:
                return turns[best], free_m[best]
    best = int(np.argmax(free_m - costs))
    return turns[best], free_m[best]


@njit(nogil=True, cache=True, error_model="numpy")
def _costs(wanted_rad: float, flock_n: float, flock_e: float, last_rad: float, rules: Any) -> Any:
    """(144,) rad"""
    costs = rules.costs.copy()
    if not math.isnan(last_rad):
        for i in range(costs.size):
            costs[i] += LAST * abs(_wrapped(wanted_rad + rules.turns[i] - last_rad))
    if flock_n != 0.0 or flock_e != 0.0:
        flock_rad = math.atan2(flock_e, flock_n)
        for i in range(costs.size):
            costs[i] += FLOCK * abs(_wrapped(wanted_rad + rules.turns[i] - flock_rad))
    return costs


@njit(nogil=True, cache=True, error_model="numpy")
def _free_way(azimuth: float, radius_m: float, ranges: Any, points: Any) -> float:
    """How far a disc flies straight before it touches a point or what is not known, m."""
    cosine, sine = math.cos(azimuth), math.sin(azimuth)
    free_m = math.inf
    for k in range(points.shape[0]):
        ahead = points[k, 0] * cosine + points[k, 1] * sine
        if ahead > 0.0:
            square = radius_m * radius_m - (points[k, 0] ** 2 + points[k, 1] ** 2 - ahead * ahead)
            if square > 0.0:
                free_m = min(free_m, max(ahead - math.sqrt(square), 0.0))
    sector = int(np.rint(azimuth / (2.0 * math.pi / ranges.size))) % ranges.size
    return float(min(free_m, min(ranges[sector], RANGE_LIMIT_M) - radius_m))


@njit(nogil=True, cache=True, error_model="numpy")
def _wrapped(angle: float) -> float:
    """Between -pi and pi."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
