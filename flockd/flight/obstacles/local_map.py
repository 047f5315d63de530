"""The local map: obstacles around the drone, from the ranges of the last few seconds."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import SECTORS, BoolArray, FloatArray, IntArray, ObstacleRanges
from flockd.flight.geometry import Rig

_CONSISTENT_SIGMAS = 3.0
"""Largest difference, in standard deviations, of two ranges of one obstacle."""
_CONTRADICTIONS = 2
"""Number of steps with longer ranges in its direction after which an obstacle is deleted."""

AZIMUTHS = 2 * math.pi / SECTORS * np.arange(SECTORS)
"""(SECTORS,) radians, clockwise from north: the sectors' middles."""
DIRECTIONS = np.column_stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)])
"""(SECTORS, 2) unit vectors north and east: the sectors' middles."""

_NOWHERE_M = np.full(SECTORS, np.inf)
_POINT = np.dtype([("place", float, 2), ("sigma_m", float), ("seen_s", float), ("contradictions", int)])
"""A point of an obstacle: metres north and east from the drone, and the number of steps that contradicted it."""
_Points = NDArray[np.void]
"""(m,) points."""


class LocalMap:
    """Obstacles as points in level axes that point north and east, with the drone at the origin.

    Points move opposite to the drone, and the uncertainty of its motion is added to theirs. A newer range of the same
    obstacle replaces a point; it is deleted after `memory_s`, or when longer ranges contradict it.
    """

    def __init__(self, parameters: ObstacleParameters) -> None:
        self._parameters = parameters
        self._points = np.empty(0, _POINT)
        self._seen_m = np.zeros(SECTORS)
        self._time_s = 0.0

    def step(
        self, time_s: float, ranges: ObstacleRanges | None, displacement: FloatArray | None, sigma_m: float
    ) -> ObstacleRanges:
        """The map's ranges at `time_s`.

        Args:
            time_s: if it is before the last step's, the map starts anew.
            ranges: of this time; None: not measured.
            displacement: (2,) displacement since the last step, metres north and east; None: the map starts anew.
            sigma_m: its standard deviation, each axis.
        """
        self._move(time_s, displacement, sigma_m)
        if ranges is not None:
            self._take(ranges)
        return self._now(time_s)

    def _move(self, time_s: float, displacement: FloatArray | None, sigma_m: float) -> None:
        elapsed_s, self._time_s = time_s - self._time_s, time_s
        if displacement is None or elapsed_s < 0:
            self._points, self._seen_m = np.empty(0, _POINT), np.zeros(SECTORS)
            return
        p, points = self._parameters, self._points.copy()
        points["place"] -= displacement
        points["sigma_m"] = np.hypot(points["sigma_m"], sigma_m)
        kept = (time_s - points["seen_s"] <= p.memory_s) & (np.hypot(*points["place"].T) <= p.range_m)
        self._points = points[kept]
        faded_m = p.range_m * elapsed_s / p.memory_s + math.hypot(*displacement)
        self._seen_m = np.maximum(self._seen_m - faded_m, 0.0)

    def _take(self, ranges: ObstacleRanges) -> None:
        p = self._parameters
        found = (ranges.range_m <= p.range_m).nonzero()[0]
        new = np.zeros(len(found), _POINT)
        new["place"] = ranges.range_m[found, None] * DIRECTIONS[found]
        new["sigma_m"], new["seen_s"] = ranges.sigma_m[found], ranges.time_s
        self._points = np.concatenate([self._without_what_is_seen_anew(ranges), new])
        self._seen_m = np.maximum(self._seen_m, np.minimum(ranges.seen_m, p.range_m))

    def _without_what_is_seen_anew(self, ranges: ObstacleRanges) -> _Points:
        """The points that newer ranges neither replace nor contradict often enough."""
        points = self._points.copy()
        away_m = np.hypot(*points["place"].T)
        around = (sector_of(points["place"])[:, None] + [-1, 0, 1]) % SECTORS
        own = around[:, 1]
        allowed_m = _CONSISTENT_SIGMAS * np.hypot(points["sigma_m"][:, None], ranges.sigma_m[around])
        beyond = np.minimum(ranges.range_m, ranges.seen_m)[around] > away_m[:, None] + allowed_m
        width_m = away_m * (2 * math.pi / SECTORS)
        again = np.abs(ranges.range_m[own] - away_m) <= np.maximum(allowed_m[:, 1], width_m)
        points["contradictions"] += beyond.all(axis=1)
        left: _Points = points[~again & (points["contradictions"] < _CONTRADICTIONS)]
        return left

    def _now(self, time_s: float) -> ObstacleRanges:
        """The nearest possible point of each sector."""
        places, sigmas_m = self._points["place"], self._points["sigma_m"]
        away_m, sectors = np.hypot(*places.T), sector_of(places)
        farthest_first = np.argsort(-(away_m - self._parameters.sigmas * sigmas_m), kind="stable")
        range_m, sigma_m = np.full(SECTORS, np.inf), np.zeros(SECTORS)
        range_m[sectors[farthest_first]] = away_m[farthest_first]  # the last assignment to an index wins
        sigma_m[sectors[farthest_first]] = sigmas_m[farthest_first]
        return ObstacleRanges(time_s, range_m, sigma_m, self._seen_m)


@cache
def in_view(rig: Rig, gone: frozenset[str]) -> BoolArray:
    """(SECTORS,) mask of directions, clockwise from the body's front, in view of a camera not in `gone`, body level."""
    return rig.covers(np.column_stack([DIRECTIONS, np.zeros(SECTORS)]), without=gone)


def nothing_found(time_s: float, rig: Rig, gone: frozenset[str], yaw_rad: float) -> ObstacleRanges:
    """Ranges without obstacle detection: all is free in view; `gone` as of `in_view`."""
    looked = in_view(rig, gone).take(np.arange(SECTORS) - round(yaw_rad / AZIMUTHS[1]), mode="wrap")
    return ObstacleRanges(time_s, _NOWHERE_M, np.zeros(SECTORS), np.where(looked, np.inf, 0.0))


def nearest_points(ranges: ObstacleRanges, sigmas: float) -> FloatArray:
    """(m, 2) metres north and east: the obstacles, each moved nearer by so many standard deviations of its range."""
    known = np.isfinite(ranges.range_m)
    away_m = np.maximum(ranges.range_m[known] - sigmas * ranges.sigma_m[known], NEAREST_M)
    points: FloatArray = away_m[:, None] * DIRECTIONS[known]
    return points


NEAREST_M = 0.01
"""Shortest range of an obstacle: it needs a direction."""


def sector_of(places: FloatArray) -> IntArray:
    """(m,) sector of each place (m, 2)."""
    azimuths = np.arctan2(places[:, 1], places[:, 0])
    sectors: IntArray = np.round(azimuths * SECTORS / (2 * math.pi)).astype(np.int64) % SECTORS
    return sectors
