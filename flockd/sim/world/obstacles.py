"""Solids that drones may hit, and the exact distances to them: trunks, crowns, walls, houses, poles and wires.

NED metres; heights are up positive above z = 0. The ground is not among them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges
from flockd.sim.world.solid_distances import BOX, CAPSULE, FRUSTUM, OWN, level_ranges, point_clearances

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
        upright, boxes, lines = (_rows(self.solids, kind) for kind in (Frustum, Box, Capsule))
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


def _rows(solids: Sequence[Solid], kind: type[Solid]) -> FloatArray:
    rows = np.array([_row(solid) for solid in solids if isinstance(solid, kind)]).reshape(-1, 13)
    return rows[:, OWN:]


def _row(solid: Solid) -> list[float]:
    """See `flockd.sim.world.solid_distances`."""
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
