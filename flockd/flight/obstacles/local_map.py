"""The local map: where obstacles are around the drone, from the ranges of the last few seconds."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import SECTORS, BoolArray, FloatArray, IntArray, ObstacleRanges
from flockd.flight.geometry import Rig

_CONSISTENT_SIGMAS = 3.0
"""Two ranges that differ by no more may be of one obstacle."""
_CONTRADICTIONS = 2
"""An obstacle that so many steps have looked past is none."""

AZIMUTHS = 2 * math.pi / SECTORS * np.arange(SECTORS)
"""(n,) radians, clockwise from north: the sectors' middles."""
DIRECTIONS = np.column_stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)])
"""(n, 2) north and east, of length 1: the sectors' middles."""

_NOWHERE_M = np.full(SECTORS, np.inf)
_POINT = np.dtype([("place", float, 2), ("sigma_m", float), ("seen_s", float), ("contradictions", int)])
"""An obstacle that was seen: metres north and east from the drone, and how many steps have looked past it since."""
_Points = NDArray[np.void]
"""(m,) of them."""


class LocalMap:
    """Obstacles as points in level axes that point north and east, with the drone at the origin.

    A point moves as the drone does not, and grows uncertain by the drone's own motion. It is replaced by a newer one
    of the same obstacle, and forgotten after `memory_s`, or when newer ranges look past it.
    """

    def __init__(self, parameters: ObstacleParameters) -> None:
        self._parameters = parameters
        self._points = np.empty(0, _POINT)
        self._seen_m = np.zeros(SECTORS)
        self._time_s = 0.0

    def step(
        self, time_s: float, ranges: ObstacleRanges | None, displacement: FloatArray | None, sigma_m: float
    ) -> ObstacleRanges:
        """What the map says at `time_s`.

        Args:
            time_s: not before the last step's; if it is, the map begins anew.
            ranges: of this time; None: nothing was looked at.
            displacement: (2,) metres north and east that the drone went since the last step; None: the map begins anew.
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
        found = np.flatnonzero(ranges.range_m <= p.range_m)
        new = np.zeros(len(found), _POINT)
        new["place"] = ranges.range_m[found, None] * DIRECTIONS[found]
        new["sigma_m"], new["seen_s"] = ranges.sigma_m[found], ranges.time_s
        self._points = np.concatenate([self._without_what_is_seen_anew(ranges), new])
        self._seen_m = np.maximum(self._seen_m, np.minimum(ranges.seen_m, p.range_m))

    def _without_what_is_seen_anew(self, ranges: ObstacleRanges) -> _Points:
        """The points that newer ranges neither show again nor have looked past often enough."""
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
        """In each sector the point that may be nearest."""
        places, sigmas_m = self._points["place"], self._points["sigma_m"]
        away_m, sectors = np.hypot(*places.T), sector_of(places)
        farthest_first = np.argsort(-(away_m - self._parameters.sigmas * sigmas_m), kind="stable")
        range_m, sigma_m = np.full(SECTORS, np.inf), np.zeros(SECTORS)
        range_m[sectors[farthest_first]] = away_m[farthest_first]  # the last one written stays
        sigma_m[sectors[farthest_first]] = sigmas_m[farthest_first]
        return ObstacleRanges(time_s, range_m, sigma_m, self._seen_m)


@cache
def in_view(rig: Rig, gone: frozenset[str]) -> BoolArray:
    """(SECTORS,) in which directions, clockwise from the body's front, cameras that are not `gone` look, held level."""
    return rig.covers(np.column_stack([DIRECTIONS, np.zeros(SECTORS)]), without=gone)


def nothing_found(time_s: float, rig: Rig, gone: frozenset[str], yaw_rad: float) -> ObstacleRanges:
    """Ranges for a drone that does not look for obstacles: all free in view; `gone` as of `in_view`."""
    looked = in_view(rig, gone).take(np.arange(SECTORS) - round(yaw_rad / AZIMUTHS[1]), mode="wrap")
    return ObstacleRanges(time_s, _NOWHERE_M, np.zeros(SECTORS), np.where(looked, np.inf, 0.0))


def nearest_points(ranges: ObstacleRanges, sigmas: float) -> FloatArray:
    """(m, 2) metres north and east: the obstacles, each nearer by so many standard deviations than it was measured."""
    known = np.isfinite(ranges.range_m)
    away_m = np.maximum(ranges.range_m[known] - sigmas * ranges.sigma_m[known], NEAREST_M)
    points: FloatArray = away_m[:, None] * DIRECTIONS[known]
    return points


NEAREST_M = 0.01
"""No obstacle counts as nearer: it needs a direction."""


def sector_of(places: FloatArray) -> IntArray:
    """(m,) of places (m, 2)."""
    azimuths = np.arctan2(places[:, 1], places[:, 0])
    sectors: IntArray = np.round(azimuths * SECTORS / (2 * math.pi)).astype(np.int64) % SECTORS
    return sectors
