"""Solids that drones may hit, and the exact distances to them: trunks, crowns, walls, houses, poles and wires.

NED metres; heights are up positive above z = 0. The ground is not among them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np

from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges

RANGE_LIMIT_M = 20.0
"""How far `true_ranges` reaches."""
HEIGHT_BAND_M = (-0.75, 0.75)
"""Of `true_ranges`: from below to above the drone's centre, up positive."""
EXACT_SIGMA_M = 0.01
"""Of `true_ranges`: a standard deviation that is not 0."""
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
        self._frusta = _rows(solids, Frustum, 6)
        self._boxes = _rows(solids, Box, 7)
        self._capsules = _rows(solids, Capsule, 7)

    def ranges(
        self,
        position: FloatArray,
        azimuths: FloatArray,
        height_band: tuple[float, float] = HEIGHT_BAND_M,
        *,
        half_width: float = 0.0,
        limit_m: float = math.inf,
    ) -> FloatArray:
        """(n,) level metres from `position` (3,) NED to the nearest solid at each of the azimuths; inf without one.

        Azimuths (n,) are rad clockwise from north. Of each solid the part counts whose height above the drone lies in
        `height_band`, seen from above. With `half_width` (rad) it is the nearest point of the sector around each
        azimuth, so that nothing thin falls between two of them. 0 inside a solid; inf beyond `limit_m`.
        """
        discs, rectangles = self._sections(-position[2] + height_band[0], -position[2] + height_band[1])
        discs = discs[np.hypot(*(discs[:, :2] - position[:2]).T) <= limit_m + discs[:, 2]]
        reach = limit_m + np.hypot(rectangles[:, 2], rectangles[:, 3])
        rectangles = rectangles[np.hypot(*(rectangles[:, :2] - position[:2]).T) <= reach]
        found = np.concatenate(
            [
                _ranges_to_discs(discs, position[:2], azimuths, half_width),
                _ranges_to_rectangles(rectangles, position[:2], azimuths, half_width),
            ]
        )
        nearest = found.min(axis=0, initial=np.inf)
        return np.where(nearest <= limit_m, nearest, np.inf)

    def clearance(self, points: FloatArray) -> FloatArray:
        """(...) metres from points (..., 3) NED to the nearest surface, negative inside; inf without any."""
        flat = np.asarray(points, dtype=float).reshape(-1, 3) * (1.0, 1.0, -1.0)
        nearest = np.full(len(flat), np.inf)
        for rows, distance in (
            (self._frusta, _to_frusta),
            (self._boxes, _to_boxes),
            (self._capsules, _to_capsules),
        ):
            for part in np.array_split(rows, math.ceil(len(rows) / 64)) if len(rows) else ():
                np.minimum(nearest, distance(part[:, None], flat[None]).min(axis=0), out=nearest)
        return nearest.reshape(np.shape(points)[:-1])

    def outlines(self) -> FloatArray:
        """(k, 7) of `FlightLog.obstacles`, a sloping line without its round ends."""
        upright, boxes, lines = self._frusta, self._boxes, self._capsules
        way = lines[:, 3:5] - lines[:, :2]
        length = np.hypot(way[:, 0], way[:, 1])
        low = np.minimum(lines[:, 2], lines[:, 5]) - lines[:, 6]
        high = np.maximum(lines[:, 2], lines[:, 5]) + lines[:, 6]
        of_frusta = [upright[:, :2], upright[:, 2:4].max(axis=1), np.zeros((len(upright), 2)), upright[:, 4:6]]
        of_lines = [
            (lines[:, :2] + lines[:, 3:5]) / 2,
            np.where(length > 0, length / 2, lines[:, 6]),
            np.where(length > 0, lines[:, 6], 0.0),
            np.arctan2(way[:, 1], way[:, 0]),
            low,
            high,
        ]
        return np.vstack([np.column_stack(of_frusta), boxes, np.column_stack(of_lines)])

    def _sections(self, low: float, high: float) -> tuple[FloatArray, FloatArray]:
        """What lies between two heights, seen from above: discs (k, 3) and rectangles (m, 5), rows as of the solids."""
        frusta = self._frusta[(self._frusta[:, 4] <= high) & (self._frusta[:, 5] >= low)]
        bottom, top = np.maximum(frusta[:, 4], low), np.minimum(frusta[:, 5], high)
        radius = np.maximum(_radius_at(frusta, bottom), _radius_at(frusta, top))
        boxes = self._boxes[(self._boxes[:, 5] <= high) & (self._boxes[:, 6] >= low), :5]
        ends, lines = _capsule_sections(self._capsules, low, high)
        return np.vstack([np.column_stack([frusta[:, :2], radius]), ends]), np.vstack([boxes, lines])


def true_ranges(
    obstacles: Obstacles, time_s: float, position: FloatArray, *, limit_m: float = RANGE_LIMIT_M
) -> ObstacleRanges:
    """What a drone at `position` (3,) NED would measure without errors: all around, up to `limit_m`."""
    azimuths = np.arange(SECTORS, dtype=float) * (2 * math.pi / SECTORS)
    range_m = obstacles.ranges(position, azimuths, half_width=math.pi / SECTORS, limit_m=limit_m)
    return ObstacleRanges(
        time_s=time_s,
        range_m=range_m,
        sigma_m=np.where(np.isfinite(range_m), EXACT_SIGMA_M, 0.0),
        seen_m=np.minimum(range_m, limit_m),
    )


def _rows(solids: Sequence[Solid], kind: type[Solid], columns: int) -> FloatArray:
    return np.array([astuple(solid)[:columns] for solid in solids if isinstance(solid, kind)]).reshape(-1, columns)


def _radius_at(frusta: FloatArray, height: FloatArray) -> FloatArray:
    share = (height - frusta[..., 4]) / (frusta[..., 5] - frusta[..., 4])
    radius: FloatArray = frusta[..., 2] + share * (frusta[..., 3] - frusta[..., 2])
    return radius


def _capsule_sections(capsules: FloatArray, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Discs at the ends of each capsule's part between two heights, and the rectangle between them.

    Exact for upright and level ones; of a sloping one the axis is cut where it leaves the heights by the radius.
    """
    one, other, radius = capsules[:, :3], capsules[:, 3:6], capsules[:, 6]
    rise = other[:, 2] - one[:, 2]
    steep = np.abs(rise) > 1e-9
    slope = np.where(steep, rise, 1.0)
    first, last = (low - radius - one[:, 2]) / slope, (high + radius - one[:, 2]) / slope
    begin = np.where(steep, np.clip(np.minimum(first, last), 0.0, 1.0), 0.0)
    end = np.where(steep, np.clip(np.maximum(first, last), 0.0, 1.0), 1.0)
    beyond = np.maximum(
        np.maximum(low - np.maximum(one[:, 2], other[:, 2]), np.minimum(one[:, 2], other[:, 2]) - high), 0
    )
    within = beyond <= radius
    level_radius = np.sqrt(np.maximum(radius**2 - beyond**2, 0.0))
    a = (one + begin[:, None] * (other - one))[within]
    b = (one + end[:, None] * (other - one))[within]
    wide = level_radius[within]
    way = b[:, :2] - a[:, :2]
    length = np.hypot(way[:, 0], way[:, 1])
    discs = np.vstack([np.column_stack([a[:, :2], wide]), np.column_stack([b[:, :2], wide])[length > 0]])
    middle = (a[:, :2] + b[:, :2]) / 2
    rectangles = np.column_stack([middle, length / 2, wide, np.arctan2(way[:, 1], way[:, 0])])
    return discs, rectangles[length > 0]


def _ranges_to_discs(discs: FloatArray, place: FloatArray, azimuths: FloatArray, half_width: float) -> FloatArray:
    """(k, n)"""
    offset = discs[:, :2] - place
    away = np.hypot(offset[:, 0], offset[:, 1])[:, None]
    radius = discs[:, 2:3]
    towards = np.arctan2(offset[:, 1], offset[:, 0])[:, None]
    # A sector's nearest point of something convex is the one whose azimuth is nearest to that of the nearest point.
    aside = np.maximum(np.abs(_wrapped(towards - azimuths)) - half_width, 0.0)
    inside = radius**2 - (away * np.sin(aside)) ** 2
    hit = (inside >= 0) & (np.cos(aside) > 0)
    ranges = np.where(hit, away * np.cos(aside) - np.sqrt(np.maximum(inside, 0.0)), np.inf)
    return np.where(away <= radius, 0.0, ranges)


def _ranges_to_rectangles(
    rectangles: FloatArray, place: FloatArray, azimuths: FloatArray, half_width: float
) -> FloatArray:
    """(k, n), in each rectangle's own axes."""
    half, heading = rectangles[:, None, 2:4], rectangles[:, 4:5]
    offset = place - rectangles[:, :2]
    turned = np.hypot(offset[:, 0], offset[:, 1]), np.arctan2(offset[:, 1], offset[:, 0]) - rectangles[:, 4]
    origin = np.column_stack([turned[0] * np.cos(turned[1]), turned[0] * np.sin(turned[1])])[:, None]
    to_nearest = np.clip(origin, -half, half) - origin
    nearest = np.hypot(to_nearest[..., 0], to_nearest[..., 1])
    towards = np.arctan2(to_nearest[..., 1], to_nearest[..., 0]) + heading
    aside = _wrapped(towards - azimuths)
    looked_at = azimuths + np.clip(aside, -half_width, half_width) - heading
    direction = np.stack([np.cos(looked_at), np.sin(looked_at)], axis=-1)
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    near, far = (-np.sign(direction) * half - origin) / direction, (np.sign(direction) * half - origin) / direction
    enter, leave = near.max(axis=-1), far.min(axis=-1)
    hit = (enter <= leave) & (leave >= 0)
    ranges = np.where(hit, np.maximum(enter, 0.0), np.inf)
    return np.where((np.abs(aside) <= half_width) | (nearest == 0), nearest, ranges)


def _wrapped(angle: FloatArray) -> FloatArray:
    """Between -pi and pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _to_frusta(rows: FloatArray, points: FloatArray) -> FloatArray:
    """(k, m) of points north, east, up: a polygon in distance from the axis and height."""
    away = np.hypot(points[..., 0] - rows[..., 0], points[..., 1] - rows[..., 1])
    height = points[..., 2]
    wide, narrow, foot, top = (rows[..., column] for column in range(2, 6))
    zero = np.zeros_like(wide)
    sides = (
        _to_segment(away, height, zero, foot, wide, foot),
        _to_segment(away, height, wide, foot, narrow, top),
        _to_segment(away, height, zero, top, narrow, top),
    )
    surface = np.minimum(np.minimum(sides[0], sides[1]), sides[2])
    inside = (height >= foot) & (height <= top) & (away <= _radius_at(rows, height))
    return np.where(inside, -surface, surface)


def _to_segment(
    x: FloatArray, y: FloatArray, x0: FloatArray, y0: FloatArray, x1: FloatArray, y1: FloatArray
) -> FloatArray:
    along, up = x1 - x0, y1 - y0
    share = np.clip(((x - x0) * along + (y - y0) * up) / np.maximum(along**2 + up**2, 1e-18), 0.0, 1.0)
    return np.hypot(x - x0 - share * along, y - y0 - share * up)


def _to_boxes(rows: FloatArray, points: FloatArray) -> FloatArray:
    north, east = points[..., 0] - rows[..., 0], points[..., 1] - rows[..., 1]
    c, s = np.cos(rows[..., 4]), np.sin(rows[..., 4])
    beyond = np.stack(
        np.broadcast_arrays(
            np.abs(north * c + east * s) - rows[..., 2],
            np.abs(-north * s + east * c) - rows[..., 3],
            np.abs(points[..., 2] - (rows[..., 5] + rows[..., 6]) / 2) - (rows[..., 6] - rows[..., 5]) / 2,
        )
    )
    outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=0))
    return np.asarray(outside + np.minimum(beyond.max(axis=0), 0.0))


def _to_capsules(rows: FloatArray, points: FloatArray) -> FloatArray:
    line = rows[..., 3:6] - rows[..., :3]
    squared = np.maximum((line**2).sum(axis=-1), 1e-18)
    share = np.clip(((points - rows[..., :3]) * line).sum(axis=-1) / squared, 0.0, 1.0)
    nearest = rows[..., :3] + share[..., None] * line
    distance: FloatArray = np.sqrt(((points - nearest) ** 2).sum(axis=-1)) - rows[..., 6]
    return distance
