"""How many metres a degree is, near a place on the WGS 84 ellipsoid."""

from __future__ import annotations

import math

EQUATOR_M = 6_378_137.0
SQUARED_ECCENTRICITY = 6.694379990e-3


def metres_a_degree(latitude_deg: float) -> tuple[float, float]:
    """Metres in a degree of latitude and of longitude."""
    latitude = math.radians(latitude_deg)
    flattened = 1.0 - SQUARED_ECCENTRICITY * math.sin(latitude) ** 2
    north = math.radians(EQUATOR_M * (1.0 - SQUARED_ECCENTRICITY) / flattened**1.5)
    east = math.radians(EQUATOR_M * math.cos(latitude) / math.sqrt(flattened))
    return north, east


def degrees_apart(longitude_deg: float, other_deg: float) -> float:
    """How far east one longitude is of another, the shorter way around the Earth: from -180 to 180."""
    return (longitude_deg - other_deg + 180.0) % 360.0 - 180.0
