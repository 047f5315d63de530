"""Solids that drones may hit, and the exact distances to them: trunks, crowns, walls, houses, poles and wires.

NED metres; heights are up positive above z = 0. The ground is not among them. Seen from above, what of a solid lies
between two heights is a rectangle with a margin around it: `Shape`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges

Shape = tuple[float, float, float, float, float, float]
"""Of a middle north and east, half length, half width, heading of the length (rad clockwise from north), and margin:
all points no farther than that from the rectangle."""
_LEAST_SQUARE = 1e-18
RANGE_LIMIT_M = 20.0
"""How far `true_ranges` reaches."""
HEIGHT_BAND_M = (-0.75, 0.75)
"""Heights that `true_ranges` looks at, from below to above the drone's centre, up positive."""
EXACT_SIGMA_M = 0.01
"""Standard deviation that `true_ranges` gives, which is not 0."""
POINTS_A_STEP = 10
"""At which a clearance is taken on the way from one step to the next: 8 cm apart at 1.5 m/s and a step of 0.5 s."""
Material = Literal["bark", "leaves", "needles", "plaster", "bricks", "stone", "roof", "wood", "metal"]


class _Upright:
    foot: float
    top: float

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest height, m."""
        return self.foot, self.top


@dataclass(frozen=True)
class Frustum(_Upright):
    """An upright cylinder, or a cone: a trunk, a pole, a spruce's crown."""

    north: float
    east: float
    foot_radius: float
    top_radius: float
    foot: float
    top: float
    material: Material = "bark"

    def between(self, low: float, high: float) -> Shape:
        """The outline of its part between two heights, m, that it reaches."""
        rise = (np.clip([low, high], self.foot, self.top) - self.foot) / (self.top - self.foot)
        radius = float((self.foot_radius + rise * (self.top_radius - self.foot_radius)).max())
        return self.north, self.east, 0.0, 0.0, 0.0, radius

    def clearance(self, points: FloatArray) -> FloatArray:
        """Distances (n,) m from points (n, 3) NED to its surface, negative inside.

        Its section is a polygon in distance from the axis and height.
        """
        away, height = np.hypot(points[:, 0] - self.north, points[:, 1] - self.east), -points[:, 2]
        corners = [(0.0, self.foot), (self.foot_radius, self.foot), (self.top_radius, self.top), (0.0, self.top)]
        place = np.column_stack([away, height])
        surface: FloatArray = np.min([_to_line(place, *np.array(corners[i : i + 2])) for i in range(3)], axis=0)
        rise = (height - self.foot) / (self.top - self.foot)
        inside = (rise >= 0) & (rise <= 1) & (away <= self.foot_radius + rise * (self.top_radius - self.foot_radius))
        return np.where(inside, -surface, surface)


@dataclass(frozen=True)
class Box(_Upright):
    """A house or a wall. `heading` is that of its length, rad clockwise from north."""

    north: float
    east: float
    half_length: float
    half_width: float
    heading: float
    foot: float
    top: float
    material: Material = "plaster"

    def between(self, low: float, high: float) -> Shape:
        """The outline of its part between two heights, m, that it reaches."""
        return self.north, self.east, self.half_length, self.half_width, self.heading, 0.0

    def clearance(self, points: FloatArray) -> FloatArray:
        """Distances (n,) m from points (n, 3) NED to its surface, negative inside."""
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        north, east = points[:, 0] - self.north, points[:, 1] - self.east
        half = np.array([self.half_length, self.half_width, (self.top - self.foot) / 2])
        place = np.column_stack([
            north * cosine + east * sine, east * cosine - north * sine, -points[:, 2] - (self.top + self.foot) / 2,
        ])  # fmt: skip
        off = np.abs(place) - half
        return np.asarray(np.linalg.norm(np.maximum(off, 0.0), axis=1) + np.minimum(off.max(axis=1), 0.0))


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

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest height, m."""
        low, high = sorted((self.height, self.other_height))
        return low - self.radius, high + self.radius

    def between(self, low: float, high: float) -> Shape:
        """The outline of its part between two heights, m, that it reaches.

        Exact for upright and level ones; of a sloping one the axis is cut where it leaves the heights by the radius.
        """
        rise, ends = self.other_height - self.height, np.array([0.0, 1.0])
        if abs(rise) > 1e-9:
            ends = np.sort((np.array([low - self.radius, high + self.radius]) - self.height) / rise).clip(0.0, 1.0)
        one, other = complex(self.north, self.east), complex(self.other_north, self.other_east)
        begin, end = one + ends * (other - one)
        beyond = max(low - max(self.height, self.other_height), min(self.height, self.other_height) - high, 0.0)
        margin, middle, way = math.sqrt(max(self.radius**2 - beyond**2, 0.0)), (begin + end) / 2, end - begin
        return middle.real, middle.imag, abs(way) / 2, 0.0, math.atan2(way.imag, way.real), margin

    def clearance(self, points: FloatArray) -> FloatArray:
        """Distances (n,) m from points (n, 3) NED to its surface, negative inside."""
        ends = (self.north, self.east, -self.height), (self.other_north, self.other_east, -self.other_height)
        return _to_line(points, *np.array(ends)) - self.radius


Solid = Frustum | Box | Capsule


def _to_line(points: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """(n,) from points (n, k) to the straight line between two."""
    way = other - one
    share = np.clip((points - one) @ way / max(float(way @ way), _LEAST_SQUARE), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - one - share[:, None] * way, axis=1))


class Obstacles:
    """Solids, which may overlap."""

    def __init__(self, solids: Sequence[Solid] = ()) -> None:
        self.solids = tuple(solids)
        self._heights = np.array([solid.heights for solid in self.solids]).reshape(-1, 2)
        self._around = np.array([solid.between(-math.inf, math.inf) for solid in self.solids]).reshape(-1, 6)
        self._reach = np.hypot(self._around[:, 2], self._around[:, 3]) + self._around[:, 5]

    def ranges(
        self, position: FloatArray, azimuths: FloatArray, height_band: tuple[float, float] = HEIGHT_BAND_M, *,
        half_width: float = 0.0, limit_m: float = math.inf,
    ) -> FloatArray:  # fmt: skip
        """Level distances (n,) m from `position` (3,) NED to the nearest solid at each azimuth; inf without one.

        Azimuths (n,) are rad clockwise from north. Of each solid the part counts whose height above the drone lies in
        `height_band`, seen from above. With `half_width` (rad) it is the nearest point of the sector around each
        azimuth, so that nothing thin falls between two of them. 0 inside a solid; inf beyond `limit_m`.
        """
        low, high = -position[2] + height_band[0], -position[2] + height_band[1]
        near = np.hypot(*(self._around[:, :2] - position[:2]).T) <= self._reach + limit_m
        near &= (self._heights[:, 0] <= high) & (self._heights[:, 1] >= low)
        shapes = [self.solids[i].between(low, high) for i in np.flatnonzero(near)]
        if not shapes:
            return np.full(len(azimuths), math.inf)
        found = _sector_ranges(np.array(shapes), position[:2], azimuths, half_width).min(axis=0)
        return np.where(found > limit_m, math.inf, found)

    def clearance(self, points: FloatArray) -> FloatArray:
        """Distances (...) m from points (..., 3) NED to the nearest surface, negative inside; inf without solids."""
        flat = np.asarray(points, dtype=float).reshape(-1, 3)
        nearest = np.full(len(flat), math.inf)
        for solid, around, reach in zip(self.solids, self._around, self._reach, strict=True):
            near = np.hypot(flat[:, 0] - around[0], flat[:, 1] - around[1]) - reach < nearest
            nearest[near] = np.minimum(nearest[near], solid.clearance(flat[near]))
        return nearest.reshape(np.shape(points)[:-1])

    def outlines(self) -> FloatArray:
        """The solids (k, 7) as `FlightLog.obstacles` has them; a sloping line without its round ends."""
        middle, sides, margin = self._around[:, :2], self._around[:, 2:4], self._around[:, 5:]
        line = (sides[:, :1] > 0) & (sides[:, 1:] == 0)
        sides = np.hstack([np.where(sides[:, :1] > 0, sides[:, :1], margin), np.where(line, margin, sides[:, 1:])])
        return np.hstack([middle, sides, self._around[:, 4:5], self._heights])


def _sector_ranges(shapes: FloatArray, place: FloatArray, azimuths: FloatArray, half_width: float) -> FloatArray:
    """(k, n) level metres from a place (2,) to the nearest point of each shape (k, 6) in each sector; inf without one.

    A sector's nearest point of something convex is the one whose azimuth is nearest to that of the nearest point.
    Complex numbers are places and directions in the rectangle's own axes, along its length and across.
    """
    north, east, length, width, heading, margin = shapes.T[..., None]
    turn = np.exp(-1j * heading)
    own = (place[0] - north + 1j * (place[1] - east)) * turn
    nearest = np.clip(own.real, -length, length) + 1j * np.clip(own.imag, -width, width) - own
    range_m = np.maximum(np.abs(nearest) - margin, 0.0)
    aside = np.angle(nearest / turn * np.exp(-1j * azimuths))
    ray = np.exp(1j * (azimuths + np.clip(aside, -half_width, half_width))) * turn
    # The ray meets the rectangle, as wide as the margin makes it, or the discs at its ends.
    enter, leave = -math.inf, math.inf
    for at, slope, half in ((own.real, ray.real, length), (own.imag, ray.imag, np.maximum(width, margin))):
        along = np.where(np.abs(slope) < 1e-12, 1e-12, slope)
        ends = np.sort([(-half - at) / along, (half - at) / along], axis=0)
        enter, leave = np.maximum(enter, ends[0]), np.minimum(leave, ends[1])
    met = np.where((enter <= leave) & (leave >= 0.0), np.maximum(enter, 0.0), math.inf)
    for end in (-length, length):
        off = (end - own) / ray
        inside = margin**2 - off.imag**2
        begins = off.real - np.sqrt(np.maximum(inside, 0.0))
        met = np.minimum(met, np.where((inside >= 0.0) & (off.real > 0.0), begins, math.inf))
    return np.where((np.abs(aside) <= half_width) | (range_m == 0.0), range_m, met)


def true_ranges(
    obstacles: Obstacles, time_s: float, position: FloatArray, *, limit_m: float = RANGE_LIMIT_M
) -> ObstacleRanges:
    """The ranges that a drone at `position` (3,) m NED would measure without errors, all around, up to `limit_m`."""
    azimuths = np.arange(SECTORS, dtype=float) * (2 * math.pi / SECTORS)
    range_m = obstacles.ranges(position, azimuths, half_width=math.pi / SECTORS, limit_m=limit_m)
    sigma_m = np.where(np.isfinite(range_m), EXACT_SIGMA_M, 0.0)
    return ObstacleRanges(time_s=time_s, range_m=range_m, sigma_m=sigma_m, seen_m=np.minimum(range_m, limit_m))
