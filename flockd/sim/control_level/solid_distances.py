"""Exact distances from many drones to the solids of their flights' worlds. Compiled.

As `flockd.sim.worlds.obstacles`, which a test holds equal: level ranges in sectors all around, and the clearance on
the way from one step to the next. Solids that are too far to matter are passed over by the circle around each.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from flockd.core.messages import FloatArray
from flockd.sim.worlds.obstacles import Box, Frustum, Obstacles, Solid

FRUSTUM, BOX, CAPSULE = 0.0, 1.0, 2.0
KIND, NORTH, EAST, REACH_M, LOW_M, HIGH_M, OWN = range(7)
"""Columns of `solid_rows`: the upright cylinder around a solid, and from `OWN` on the solid's own seven figures."""
_LEAST_SLOPE = 1e-9
_LEAST_DIRECTION = 1e-12
_LEAST_SQUARE = 1e-18


def solid_rows(obstacles: Obstacles) -> FloatArray:
    """(k, 13): a row for each solid."""
    return np.array([_row(solid) for solid in obstacles.solids]).reshape(-1, 13)


def _row(solid: Solid) -> list[float]:
    if isinstance(solid, Frustum):
        reach_m = max(solid.foot_radius, solid.top_radius)
        own = solid.north, solid.east, solid.foot_radius, solid.top_radius, solid.foot, solid.top, 0.0
        return [FRUSTUM, solid.north, solid.east, reach_m, solid.foot, solid.top, *own]
    if isinstance(solid, Box):
        sides = solid.half_length, solid.half_width
        own = solid.north, solid.east, *sides, solid.heading, solid.foot, solid.top
        return [BOX, solid.north, solid.east, math.hypot(*sides), solid.foot, solid.top, *own]
    own = (
        solid.north, solid.east, solid.height, solid.other_north, solid.other_east, solid.other_height, solid.radius,
    )  # fmt: skip
    half_m = math.hypot(solid.other_north - solid.north, solid.other_east - solid.east) / 2
    low, high = sorted((solid.height, solid.other_height))
    middle = (solid.north + solid.other_north) / 2, (solid.east + solid.other_east) / 2
    return [CAPSULE, *middle, half_m + solid.radius, low - solid.radius, high + solid.radius, *own]


@njit(nogil=True, cache=True, error_model="numpy")
def sector_ranges(
    begin: int, end: int, n: int, states: Any, solids: Any, first: Any, band: Any, limit_m: float, out: Any
) -> None:
    """Level metres from the drones `begin` to before `end` to the nearest solid in each sector; inf without one.

    `states` (6, flights * n) NED; `solids` are `solid_rows` of all flights, those of flight f from `first[f]` to before
    `first[f + 1]`; `band` is from how far below to how far above a drone solids count, m; `limit_m` how far. `out`
    (flights * n, sectors).
    """
    for i in range(begin, end):
        x, y, height = states[0, i], states[1, i], -states[2, i]
        low, high = height + band[0], height + band[1]
        ranges = out[i]
        ranges[:] = math.inf
        for k in range(first[i // n], first[i // n + 1]):
            if solids[k, LOW_M] > high or solids[k, HIGH_M] < low:
                continue
            reach = solids[k, REACH_M] + limit_m
            if (solids[k, NORTH] - x) ** 2 + (solids[k, EAST] - y) ** 2 > reach * reach:
                continue
            own = solids[k, OWN:]
            if solids[k, KIND] == FRUSTUM:
                wide = max(_radius_at(own, max(own[4], low)), _radius_at(own, min(own[5], high)))
                _disc_ranges(own[0] - x, own[1] - y, wide, ranges)
            elif solids[k, KIND] == BOX:
                _rectangle_ranges(own[0] - x, own[1] - y, own[2], own[3], own[4], ranges)
            else:
                _capsule_ranges(own, x, y, low, high, ranges)
        for k in range(ranges.size):
            if ranges[k] > limit_m:
                ranges[k] = math.inf


@njit(nogil=True, cache=True, error_model="numpy")
def _radius_at(own: Any, height: float) -> float:
    """Of a frustum."""
    return float(own[2] + (height - own[4]) / (own[5] - own[4]) * (own[3] - own[2]))


@njit(nogil=True, cache=True, error_model="numpy")
def _capsule_ranges(own: Any, x: float, y: float, low: float, high: float, ranges: Any) -> None:
    """Of the part of a capsule between two heights: discs at its ends, and the rectangle between them."""
    rise = own[5] - own[2]
    begin, end = 0.0, 1.0
    if abs(rise) > _LEAST_SLOPE:
        one, other = (low - own[6] - own[2]) / rise, (high + own[6] - own[2]) / rise
        begin, end = min(max(min(one, other), 0.0), 1.0), min(max(one, other, 0.0), 1.0)
    beyond = max(low - max(own[2], own[5]), min(own[2], own[5]) - high, 0.0)
    if beyond > own[6]:
        return
    wide = math.sqrt(max(own[6] ** 2 - beyond**2, 0.0))
    an, ae = own[0] + begin * (own[3] - own[0]), own[1] + begin * (own[4] - own[1])
    bn, be = own[0] + end * (own[3] - own[0]), own[1] + end * (own[4] - own[1])
    _disc_ranges(an - x, ae - y, wide, ranges)
    length = math.sqrt((bn - an) ** 2 + (be - ae) ** 2)
    if length > 0.0:
        _disc_ranges(bn - x, be - y, wide, ranges)
        heading = math.atan2(be - ae, bn - an)
        _rectangle_ranges((an + bn) / 2 - x, (ae + be) / 2 - y, length / 2, wide, heading, ranges)


@njit(nogil=True, cache=True, error_model="numpy")
def _disc_ranges(dn: float, de: float, radius: float, ranges: Any) -> None:
    """From a disc's nearest sector to both sides, as far as sectors meet it."""
    away = math.sqrt(dn * dn + de * de)
    if away <= radius:
        ranges[:] = 0.0
        return
    sectors = ranges.size
    width = 2.0 * math.pi / sectors
    towards = math.atan2(de, dn)
    middle = int(np.rint(towards / width))
    for side in (1, -1):
        for turn in range(sectors // 2 + 1):
            sector = middle + side * turn
            aside = max(abs(_wrapped(towards - sector * width)) - width / 2, 0.0)
            inside = radius * radius - (away * math.sin(aside)) ** 2
            if inside < 0.0 or math.cos(aside) <= 0.0:
                break
            found = away * math.cos(aside) - math.sqrt(inside)
            ranges[sector % sectors] = min(ranges[sector % sectors], found)


@njit(nogil=True, cache=True, error_model="numpy")
def _rectangle_ranges(dn: float, de: float, half_n: float, half_e: float, heading: float, ranges: Any) -> None:
    """In the rectangle's own axes, along its length and its width."""
    sectors = ranges.size
    width = 2.0 * math.pi / sectors
    cosine, sine = math.cos(heading), math.sin(heading)
    x, y = -(dn * cosine + de * sine), -(de * cosine - dn * sine)
    to_x, to_y = min(max(x, -half_n), half_n) - x, min(max(y, -half_e), half_e) - y
    nearest = math.sqrt(to_x * to_x + to_y * to_y)
    towards = math.atan2(to_y, to_x) + heading
    for sector in range(sectors):
        aside = _wrapped(towards - sector * width)
        if abs(aside) <= width / 2 or nearest == 0.0:
            ranges[sector] = min(ranges[sector], nearest)
            continue
        looked_at = sector * width + min(max(aside, -width / 2), width / 2) - heading
        near_x, far_x = _slab(x, math.cos(looked_at), half_n)
        near_y, far_y = _slab(y, math.sin(looked_at), half_e)
        enter, leave = max(near_x, near_y), min(far_x, far_y)
        if enter <= leave and leave >= 0.0:
            ranges[sector] = min(ranges[sector], max(enter, 0.0))


@njit(nogil=True, cache=True, error_model="numpy")
def _slab(place: float, direction: float, half: float) -> Any:
    """How far along a line it enters and leaves what is within `half` of 0."""
    along = _LEAST_DIRECTION if abs(direction) < _LEAST_DIRECTION else direction
    reach = math.copysign(half, along)
    return (-reach - place) / along, (reach - place) / along


@njit(nogil=True, cache=True, error_model="numpy")
def _wrapped(angle: float) -> float:
    """Between -pi and pi."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(nogil=True, cache=True, error_model="numpy")
def way_clearances(
    begin: int, end: int, n: int, before: Any, now: Any, step_s: float, points: int, solids: Any, first: Any, out: Any
) -> None:
    """The smallest clearance (flights * n,) m of the drones `begin` to before `end` on the way between two states.

    `before` and `now` (6, flights * n) NED are `step_s` apart; between them each drone flies on the cubic through
    both, of which so many `points` are looked at, and `now`'s. `solids` and `first` as of `sector_ranges`.
    """
    path = np.empty((points + 1, 3))
    for i in range(begin, end):
        for p in range(points + 1):
            s = p / points
            for axis in range(3):
                path[p, axis] = (
                    (2 * s**3 - 3 * s**2 + 1) * before[axis, i]
                    + (s**3 - 2 * s**2 + s) * step_s * before[axis + 3, i]
                    + (3 * s**2 - 2 * s**3) * now[axis, i]
                    + (s**3 - s**2) * step_s * now[axis + 3, i]
                )
            path[p, 2] = -path[p, 2]
        middle, low, high = path[points // 2], path[:, 2].min(), path[:, 2].max()
        around = 0.0
        for p in range(points + 1):
            around = max(around, math.sqrt((path[p, 0] - middle[0]) ** 2 + (path[p, 1] - middle[1]) ** 2))
        least = math.inf
        for k in range(first[i // n], first[i // n + 1]):
            reach = least + solids[k, REACH_M] + around
            if solids[k, LOW_M] - high > least or low - solids[k, HIGH_M] > least or reach < 0.0:
                continue
            if (solids[k, NORTH] - middle[0]) ** 2 + (solids[k, EAST] - middle[1]) ** 2 > reach * reach:
                continue
            kind, own = solids[k, KIND], solids[k, OWN:]
            for p in range(points + 1):
                least = min(least, _clearance(kind, own, path[p, 0], path[p, 1], path[p, 2]))
        out[i] = least


@njit(nogil=True, cache=True, error_model="numpy")
def _clearance(kind: float, own: Any, x: float, y: float, height: float) -> float:
    """From a point to a solid's surface, m; negative inside."""
    if kind == FRUSTUM:
        return _to_frustum(own, math.sqrt((x - own[0]) ** 2 + (y - own[1]) ** 2), height)
    if kind == BOX:
        cosine, sine = math.cos(own[4]), math.sin(own[4])
        north, east = x - own[0], y - own[1]
        a = abs(north * cosine + east * sine) - own[2]
        b = abs(-north * sine + east * cosine) - own[3]
        c = abs(height - (own[5] + own[6]) / 2) - (own[6] - own[5]) / 2
        outside = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
        return float(outside + min(max(a, b, c), 0.0))
    ln, le, lu = own[3] - own[0], own[4] - own[1], own[5] - own[2]
    along = (x - own[0]) * ln + (y - own[1]) * le + (height - own[2]) * lu
    share = min(max(along / max(ln * ln + le * le + lu * lu, _LEAST_SQUARE), 0.0), 1.0)
    a, b, c = x - own[0] - share * ln, y - own[1] - share * le, height - own[2] - share * lu
    return math.sqrt(a * a + b * b + c * c) - float(own[6])


@njit(nogil=True, cache=True, error_model="numpy")
def _to_frustum(own: Any, away: float, height: float) -> float:
    """A polygon in distance from the axis and height."""
    wide, narrow, foot, top = own[2], own[3], own[4], own[5]
    surface = min(
        _to_segment(away, height, 0.0, foot, wide, foot),
        _to_segment(away, height, wide, foot, narrow, top),
        _to_segment(away, height, 0.0, top, narrow, top),
    )
    return -surface if foot <= height <= top and away <= _radius_at(own, height) else surface


@njit(nogil=True, cache=True, error_model="numpy")
def _to_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> float:
    along, up = x1 - x0, y1 - y0
    share = min(max(((x - x0) * along + (y - y0) * up) / max(along**2 + up**2, _LEAST_SQUARE), 0.0), 1.0)
    return math.sqrt((x - x0 - share * along) ** 2 + (y - y0 - share * up) ** 2)
