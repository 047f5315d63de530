"""The local map as an autopilot asks for it: how far each sector around the drone's nose is free."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import SECTORS, BoolArray, FloatArray
from flockd.flight.obstacles.local_map import AZIMUTHS

_LEAST_KNOWN = 0.5
"""What is known to be free to less than this share of the range counts as unknown: no obstacle is made up near by."""
_SECTOR = 2 * math.pi / SECTORS
_TOUCHING = 1e-6
"""Radians: sectors that overlap by less only touch."""


def free_ahead(points: FloatArray, seen_m: FloatArray, moved_m: float, yaw_rad: float, range_m: float) -> FloatArray:
    """(n,) metres, level, from the drone's centre, of n sectors; inf: free as far as obstacles count. NaN: not known.

    Sector k is centred on the azimuth 2 pi k / n, clockwise from the nose. Where obstacles count no further than a
    sector is known to be free, that distance stands for the obstacle.

    Args:
        points: (m, 2) metres north and east of the drone: obstacles, each as wide as a sector.
        seen_m: (n,) metres, of `ObstacleRanges`.
        moved_m: how far the drone has moved since that was so.
        yaw_rad: heading, clockwise from north.
        range_m: farther obstacles do not count.
    """
    known_m = np.where(_overlaps(np.subtract(AZIMUTHS, yaw_rad)), seen_m, np.inf).min(axis=1)
    free_m = np.where(known_m >= range_m, np.inf, known_m - moved_m)
    free_m[known_m < _LEAST_KNOWN * range_m] = np.nan
    if not len(points):
        return free_m
    azimuths = np.arctan2(points[:, 1], points[:, 0]) - yaw_rad
    nearest_m = np.where(_overlaps(azimuths), np.hypot(*points.T), np.inf).min(axis=1)
    return np.where(np.isfinite(nearest_m), nearest_m, free_m)


def _overlaps(azimuths: FloatArray) -> BoolArray:
    """(n, m) whether each of the n sectors overlaps one that is centred on each of the azimuths (m,)."""
    apart = np.abs((AZIMUTHS[:, None] - azimuths + math.pi) % (2 * math.pi) - math.pi)
    overlaps: BoolArray = apart < _SECTOR - _TOUCHING
    return overlaps
