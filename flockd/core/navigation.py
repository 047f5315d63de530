"""Angles modulo a turn, points within a polygon, and lengths of degrees on the WGS 84 ellipsoid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

EQUATOR_M = 6_378_137.0
SQUARED_ECCENTRICITY = 6.694379990e-3


def wrapped(angle_rad: float) -> float:
    """The same direction in (-pi, pi]; an angle in that interval is unchanged. NaN for angles that are not finite."""
    if not math.isfinite(angle_rad):
        return math.nan
    turned_rad = math.remainder(angle_rad, math.tau)
    return turned_rad if turned_rad > -math.pi else math.pi


def is_inside(corners: Sequence[tuple[float, float]], north_m: float, east_m: float) -> bool:
    """Whether a ray to the east crosses the outline through the corners, (north, east), an odd number of times."""
    crossed = 0
    for (n1, e1), (n2, e2) in zip(corners, (*corners[1:], corners[0]), strict=True):
        crossed += (n1 > north_m) != (n2 > north_m) and east_m < e1 + (e2 - e1) * (north_m - n1) / (n2 - n1)
    return crossed % 2 == 1


def crosses_itself(corners: Sequence[tuple[float, float]]) -> bool:
    """Whether two sides of the closed outline through the corners cross; neighbouring sides may share a corner."""

    def left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
        return (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0])

    sides = list(zip(corners, (*corners[1:], *corners[:1]), strict=True))
    return any(
        left(a, c, d) != left(b, c, d) and left(a, b, c) != left(a, b, d)
        for (a, b), (c, d) in combinations(sides, 2)
        if len({a, b, c, d}) == 4
    )


def metres_a_degree(latitude_deg: float) -> tuple[float, float]:
    """Metres per degree of latitude and per degree of longitude."""
    latitude = math.radians(latitude_deg)
    flattened = 1.0 - SQUARED_ECCENTRICITY * math.sin(latitude) ** 2
    north = math.radians(EQUATOR_M * (1.0 - SQUARED_ECCENTRICITY) / flattened**1.5)
    east = math.radians(EQUATOR_M * math.cos(latitude) / math.sqrt(flattened))
    return north, east


def metres_from(home_deg: Sequence[float], place_deg: Sequence[float]) -> tuple[float, float]:
    """Metres north and east from one place to another, both latitude and longitude, on a plane: correct to a few metres
    within 10 km, to centimetres within 1 km."""
    north_m, east_m = metres_a_degree((place_deg[0] + home_deg[0]) / 2)
    return (place_deg[0] - home_deg[0]) * north_m, degrees_apart(place_deg[1], home_deg[1]) * east_m


def degrees_apart(longitude_deg: float, other_deg: float) -> float:
    """Degrees from one longitude east to another, the shorter way around the Earth: from -180 to 180."""
    return (longitude_deg - other_deg + 180.0) % 360.0 - 180.0
