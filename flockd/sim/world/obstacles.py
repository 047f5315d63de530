"""Solids that drones may hit, and the exact distances to them: trunks, crowns, walls, houses, poles and wires.

NED metres; heights are up positive above z = 0. The ground is not among them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any, Literal

import numpy as np
from numba import njit

from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges

FRUSTUM, BOX, CAPSULE = 0.0, 1.0, 2.0
KIND, NORTH, EAST, REACH_M, LOW_M, HIGH_M, OWN = range(7)
"""Columns of a solid's row (13,): the upright cylinder around it, and from `OWN` on its own seven figures."""
_LEAST_SQUARE = 1e-18


@njit(nogil=True, cache=True, error_model="numpy")
def level_ranges(
    x: float, y: float, low: float, high: float, solids: Any, azimuths: Any, half_width: float, limit_m: float, out: Any
) -> None:
    """Level metres, (n,), from a place to the nearest of what lies between two heights at each of the azimuths.

    inf without one, or beyond `limit_m`; 0 inside. `azimuths` (n,) and `half_width` are as of `Obstacles.ranges`,
    `solids` (k, 13) rows.
    """
    out[:] = math.inf
    looks = np.column_stack((azimuths, np.cos(azimuths), np.sin(azimuths)))
    for k in range(solids.shape[0]):
        away_2 = (solids[k, NORTH] - x) ** 2 + (solids[k, EAST] - y) ** 2
        if solids[k, LOW_M] > high or solids[k, HIGH_M] < low or away_2 > (solids[k, REACH_M] + limit_m) ** 2:
            continue
        own = solids[k, OWN:]
        if solids[k, KIND] == FRUSTUM:
            wide = max(_radius_at(own, max(own[4], low)), _radius_at(own, min(own[5], high)))
            _disc_ranges(own[0] - x, own[1] - y, wide, looks, half_width, out)
        elif solids[k, KIND] == BOX:
            _rectangle_ranges(own[0] - x, own[1] - y, own[2], own[3], own[4], looks, half_width, out)
        else:
            _capsule_ranges(own, x, y, low, high, looks, half_width, out)
    for k in range(out.size):
        if out[k] > limit_m:
            out[k] = math.inf


@njit(nogil=True, cache=True, error_model="numpy")
def _radius_at(own: Any, height: float) -> float:
    """Radius of a frustum at a height."""
    return float(own[2] + (height - own[4]) / (own[5] - own[4]) * (own[3] - own[2]))


@njit(nogil=True, cache=True, error_model="numpy")
def _capsule_ranges(
    own: Any, x: float, y: float, low: float, high: float, looks: Any, half_width: float, out: Any
) -> None:
    """Ranges to the part of a capsule between two heights: discs at its ends, and the rectangle between them.

    Exact for upright and level ones; of a sloping one the axis is cut where it leaves the heights by the radius.
    """
    rise = own[5] - own[2]
    begin, end = 0.0, 1.0
    if abs(rise) > 1e-9:
        one, other = (low - own[6] - own[2]) / rise, (high + own[6] - own[2]) / rise
        begin, end = min(max(min(one, other), 0.0), 1.0), min(max(one, other, 0.0), 1.0)
    beyond = max(low - max(own[2], own[5]), min(own[2], own[5]) - high, 0.0)
    if beyond > own[6]:
        return
    wide = math.sqrt(max(own[6] ** 2 - beyond**2, 0.0))
    an, ae = own[0] + begin * (own[3] - own[0]), own[1] + begin * (own[4] - own[1])
    bn, be = own[0] + end * (own[3] - own[0]), own[1] + end * (own[4] - own[1])
    _disc_ranges(an - x, ae - y, wide, looks, half_width, out)
    length = math.sqrt((bn - an) ** 2 + (be - ae) ** 2)
    if length > 0.0:
        _disc_ranges(bn - x, be - y, wide, looks, half_width, out)
        heading = math.atan2(be - ae, bn - an)
        _rectangle_ranges((an + bn) / 2 - x, (ae + be) / 2 - y, length / 2, wide, heading, looks, half_width, out)


@njit(nogil=True, cache=True, error_model="numpy")
def _disc_ranges(dn: float, de: float, radius: float, looks: Any, half_width: float, out: Any) -> None:
    """A sector's nearest point of something convex is the one whose azimuth is nearest to that of the nearest point."""
    away = math.sqrt(dn * dn + de * de)
    if away <= radius:
        out[:] = 0.0
        return
    towards = math.atan2(de, dn)
    meets = away * math.cos(min(math.asin(radius / away) + half_width + 1e-6, math.pi))
    for k in range(out.size):
        if dn * looks[k, 1] + de * looks[k, 2] < meets:
            continue
        aside = max(abs(_wrapped(towards - looks[k, 0])) - half_width, 0.0)
        inside = radius * radius - (away * math.sin(aside)) ** 2
        if inside >= 0.0 and math.cos(aside) > 0.0:
            out[k] = min(out[k], away * math.cos(aside) - math.sqrt(inside))


@njit(nogil=True, cache=True, error_model="numpy")
def _rectangle_ranges(
    dn: float, de: float, half_n: float, half_e: float, heading: float, looks: Any, half_width: float, out: Any
) -> None:
    """In the rectangle's own axes, along its length and its width."""
    cosine, sine = math.cos(heading), math.sin(heading)
    x, y = -(dn * cosine + de * sine), -(de * cosine - dn * sine)
    to_x, to_y = min(max(x, -half_n), half_n) - x, min(max(y, -half_e), half_e) - y
    nearest = math.sqrt(to_x * to_x + to_y * to_y)
    towards = math.atan2(to_y, to_x) + heading
    for k in range(out.size):
        aside = _wrapped(towards - looks[k, 0])
        if abs(aside) <= half_width or nearest == 0.0:
            out[k] = min(out[k], nearest)
            continue
        looked_at = looks[k, 0] + min(max(aside, -half_width), half_width) - heading
        near_x, far_x = _slab(x, math.cos(looked_at), half_n)
        near_y, far_y = _slab(y, math.sin(looked_at), half_e)
        enter, leave = max(near_x, near_y), min(far_x, far_y)
        if enter <= leave and leave >= 0.0:
            out[k] = min(out[k], max(enter, 0.0))


@njit(nogil=True, cache=True, error_model="numpy")
def _slab(place: float, direction: float, half: float) -> Any:
    """How far along a line it enters and leaves what is within `half` of 0."""
    along = 1e-12 if abs(direction) < 1e-12 else direction
    reach = math.copysign(half, along)
    return (-reach - place) / along, (reach - place) / along


@njit(nogil=True, cache=True, error_model="numpy")
def _wrapped(angle: float) -> float:
    """Between -pi and pi."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(nogil=True, cache=True, error_model="numpy")
def point_clearances(points: Any, solids: Any, out: Any) -> None:
    """Metres, (m,), from points (m, 3) NED to the nearest surface of `solids` (k, 13); negative inside, inf without."""
    for i in range(points.shape[0]):
        x, y, height = points[i, 0], points[i, 1], -points[i, 2]
        least = math.inf
        for k in range(solids.shape[0]):
            reach = least + solids[k, REACH_M]
            if solids[k, LOW_M] - height > least or height - solids[k, HIGH_M] > least or reach < 0.0:
                continue
            if (solids[k, NORTH] - x) ** 2 + (solids[k, EAST] - y) ** 2 <= reach * reach:
                least = min(least, _clearance(solids[k, KIND], solids[k, OWN:], x, y, height))
        out[i] = least


@njit(nogil=True, cache=True, error_model="numpy")
def _clearance(kind: float, own: Any, x: float, y: float, height: float) -> float:
    """From a point to a solid's surface, m; negative inside."""
    if kind == FRUSTUM:
        # A polygon in distance from the axis and height.
        wide, narrow, foot, top = own[2], own[3], own[4], own[5]
        away = math.sqrt((x - own[0]) ** 2 + (y - own[1]) ** 2)
        surface = min(
            _to_segment(away, height, 0.0, foot, wide, foot),
            _to_segment(away, height, wide, foot, narrow, top),
            _to_segment(away, height, 0.0, top, narrow, top),
        )
        return -surface if foot <= height <= top and away <= _radius_at(own, height) else surface
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
def _to_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> float:
    along, up = x1 - x0, y1 - y0
    share = min(max(((x - x0) * along + (y - y0) * up) / max(along**2 + up**2, _LEAST_SQUARE), 0.0), 1.0)
    return math.sqrt((x - x0 - share * along) ** 2 + (y - y0 - share * up) ** 2)


RANGE_LIMIT_M = 20.0
"""How far `true_ranges` reaches."""
HEIGHT_BAND_M = (-0.75, 0.75)
"""Heights that `true_ranges` looks at, from below to above the drone's centre, up positive."""
EXACT_SIGMA_M = 0.01
"""Standard deviation that `true_ranges` gives, which is not 0."""
POINTS_A_STEP = 10
"""At which a clearance is taken on the way from one step to the next: 8 cm apart at 1.5 m/s and a step of 0.5 s."""
Material = Literal["bark", "leaves", "needles", "plaster", "bricks", "stone", "roof", "wood", "metal"]


@dataclass(frozen=True)
class Frustum:
    """An upright cylinder, or a cone: a trunk, a pole, a spruce's crown."""

    north: float
    east: float
    foot_radius: float
    top_radius: float
    foot: float
    top: float
    material: Material = "bark"


@dataclass(frozen=True)
class Box:
    """A house or a wall. `heading` is that of its length, rad clockwise from north."""

    north: float
    east: float
    half_length: float
    half_width: float
    heading: float
    foot: float
    top: float
    material: Material = "plaster"


@dataclass(frozen=True)
class Capsule:
    """Everything within `radius` of a straight line: a wire, or, upright or of no length, a crown."""

    north: float
    east: float
    height: float
    other_north: float
    other_east: float
    other_height: float
    radius: float
    material: Material = "leaves"


Solid = Frustum | Box | Capsule


class Obstacles:
    """Any number of solids, which may overlap."""

    def __init__(self, solids: Sequence[Solid] = ()) -> None:
        self.solids = tuple(solids)
        self._solids = np.array([_row(solid) for solid in self.solids]).reshape(-1, 13)

    def ranges(
        self, position: FloatArray, azimuths: FloatArray, height_band: tuple[float, float] = HEIGHT_BAND_M, *,
        half_width: float = 0.0, limit_m: float = math.inf,
    ) -> FloatArray:  # fmt: skip
        """(n,) level metres from `position` (3,) NED to the nearest solid at each of the azimuths; inf without one.

        Azimuths (n,) are rad clockwise from north. Of each solid the part counts whose height above the drone lies in
        `height_band`, seen from above. With `half_width` (rad) it is the nearest point of the sector around each
        azimuth, so that nothing thin falls between two of them. 0 inside a solid; inf beyond `limit_m`.
        """
        found = np.empty(len(azimuths))
        low, high = -position[2] + height_band[0], -position[2] + height_band[1]
        level_ranges(position[0], position[1], low, high, self._solids, azimuths, half_width, limit_m, found)
        return found

    def clearance(self, points: FloatArray) -> FloatArray:
        """(...) metres from points (..., 3) NED to the nearest surface, negative inside; inf without any."""
        flat = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
        nearest = np.empty(len(flat))
        point_clearances(flat, self._solids, nearest)
        return nearest.reshape(np.shape(points)[:-1])

    def outlines(self) -> FloatArray:
        """(k, 7) of `FlightLog.obstacles`, a sloping line without its round ends."""
        upright, boxes, lines = (self._solids[self._solids[:, KIND] == kind] for kind in (FRUSTUM, BOX, CAPSULE))
        way, radius = lines[:, OWN + 3 : OWN + 5] - lines[:, OWN : OWN + 2], lines[:, OWN + 6]
        length = np.hypot(way[:, 0], way[:, 1])
        along = np.where(length > 0, length / 2, radius)
        across = np.where(length > 0, radius, 0.0)
        heights = slice(LOW_M, HIGH_M + 1)
        of_frusta = [upright[:, NORTH : REACH_M + 1], np.zeros((len(upright), 2)), upright[:, heights]]
        of_lines = [lines[:, NORTH : EAST + 1], along, across, np.arctan2(way[:, 1], way[:, 0]), lines[:, heights]]
        return np.vstack([np.column_stack(of_frusta), boxes[:, OWN:], np.column_stack(of_lines)])


def true_ranges(
    obstacles: Obstacles, time_s: float, position: FloatArray, *, limit_m: float = RANGE_LIMIT_M
) -> ObstacleRanges:
    """What a drone at `position` (3,) NED would measure without errors: all around, up to `limit_m`."""
    azimuths = np.arange(SECTORS, dtype=float) * (2 * math.pi / SECTORS)
    range_m = obstacles.ranges(position, azimuths, half_width=math.pi / SECTORS, limit_m=limit_m)
    sigma_m = np.where(np.isfinite(range_m), EXACT_SIGMA_M, 0.0)
    return ObstacleRanges(time_s=time_s, range_m=range_m, sigma_m=sigma_m, seen_m=np.minimum(range_m, limit_m))


def _row(solid: Solid) -> list[float]:
    own = [*astuple(solid)[:-1], 0.0][:7]
    north, east = solid.north, solid.east
    match solid:
        case Frustum():
            kind, reach_m, low, high = FRUSTUM, max(solid.foot_radius, solid.top_radius), solid.foot, solid.top
        case Box():
            kind, reach_m, low, high = BOX, math.hypot(solid.half_length, solid.half_width), solid.foot, solid.top
        case Capsule():
            half_m = math.hypot(solid.other_north - solid.north, solid.other_east - solid.east) / 2
            north, east = (solid.north + solid.other_north) / 2, (solid.east + solid.other_east) / 2
            low, high = sorted((solid.height, solid.other_height))
            kind, reach_m, low, high = CAPSULE, half_m + solid.radius, low - solid.radius, high + solid.radius
    return [kind, north, east, reach_m, low, high, *own]
