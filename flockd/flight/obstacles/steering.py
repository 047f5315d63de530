"""Which way around obstacles: the direction nearest to the wanted one that is free for some seconds.

After Ulrich and Borenstein 1998, "VFH+: reliable obstacle avoidance for fast mobile robots". Directions in which an
obstacle, enlarged by the clearance, is met too soon are closed. Of the others the cheapest is taken, and the one taken
last is cheaper than it would be otherwise.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges
from flockd.flight.geometry.level import limit_norm
from flockd.flight.obstacles.local_map import AZIMUTHS, nearest_points

TURNS = np.linspace(-math.pi, math.pi, 144, endpoint=False)
"""(n,) radians, clockwise from the wanted direction; 0 is one of them."""
LAST = 0.5
"""How much a turn away from the last direction counts, relative to one away from the wanted direction."""
RIGHT_RAD = 0.02
"""To the left costs this much more: of two ways alike all drones take the same."""
LEAST_SHARE = 0.3
"""Of the wanted speed, however far a way around turns away: it has to lead out of dead ends."""
PACE_M_S = 1.5
"""Among neighbours a direction has to be free for the wanted speed up to this one, or up to theirs."""
BESIDE_M = 0.02
"""Beside an obstacle that is nearer than the margin, the margin is smaller by this than what there is."""


class Steering:
    """Remembers the last way around, so that the next step takes the same side."""

    def __init__(self, parameters: ObstacleParameters) -> None:
        self._parameters = parameters
        self._last_rad: float | None = None

    def around(self, wanted: FloatArray, ranges: ObstacleRanges, flock: FloatArray) -> tuple[FloatArray, float]:
        """The velocity (2,) m/s in a free direction, and how far that direction is free, metres.

        The more it turns away from the wanted one, the slower: by (1 + cos(turn)) / 2, at least `LEAST_SHARE`.
        Who has to fly away from the flock for a way around is pulled back the more, and would fly off the faster.
        Nor does that pull ask for a longer free way: among trees none but that back would be long enough. Faster than
        for what has to be free, it flies only where nothing is met within `horizon_s` either.

        `wanted` (2,) m/s; `flock` (2,) m/s is the neighbours' mean velocity, zero without any.
        """
        p = self._parameters
        speed = math.hypot(*wanted)
        if speed == 0.0:
            return wanted, 0.0
        wanted_rad = math.atan2(wanted[1], wanted[0])
        points = nearest_points(ranges, p.sigmas)
        pace = min(speed, max(math.hypot(*flock), PACE_M_S)) if flock.any() else speed
        azimuths = wanted_rad + TURNS
        seen_m = ranges.seen_m[np.round(azimuths / AZIMUTHS[1]).astype(np.int64) % SECTORS]
        cost = self._cost(azimuths)
        nearest_m = float(np.hypot(*points.T).min(initial=np.inf))
        with_margin_m = min(max(nearest_m - BESIDE_M, p.clearance_m), p.clearance_m + p.margin_m)
        for radius_m in (with_margin_m, p.clearance_m):
            free_m = free_way(points, radius_m, azimuths)
            free_m = np.minimum(free_m, seen_m - radius_m)
            is_free = free_m >= min(pace * p.horizon_s, p.range_m - radius_m)
            if is_free.any():
                return self._taken(int(np.argmin(np.where(is_free, cost, np.inf))), wanted, pace, free_m)
        return self._taken(int(np.argmax(free_m - cost)), wanted, pace, free_m)

    def _cost(self, azimuths: FloatArray) -> FloatArray:
        cost = np.abs(TURNS) + np.where(TURNS < 0, RIGHT_RAD, 0.0)
        if self._last_rad is not None:
            cost = cost + LAST * np.abs((azimuths - self._last_rad + math.pi) % math.tau - math.pi)
        return cost

    def _taken(self, index: int, wanted: FloatArray, pace: float, free_m: FloatArray) -> tuple[FloatArray, float]:
        turn, free = float(TURNS[index]), max(float(free_m[index]), 0.0)
        wanted = limit_norm(wanted, max(pace, free / self._parameters.horizon_s))
        turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ wanted
        velocity: FloatArray = max((1.0 + math.cos(turn)) / 2.0, LEAST_SHARE) * turned
        self._last_rad = math.atan2(velocity[1], velocity[0]) if turn else None
        return velocity, free


def free_way(points: FloatArray, radius_m: float, azimuths: FloatArray) -> FloatArray:
    """How far, (k,) m, a disc flies straight in each direction, (k,) rad, before it touches one of the points (m, 2).

    inf where it touches none. Of a point within the disc it flies no way nearer, and any way off.
    """
    ahead_m = points @ np.array([np.cos(azimuths), np.sin(azimuths)])
    square = radius_m**2 - (np.sum(points**2, axis=1)[:, None] - ahead_m**2)
    meets = (square > 0) & (ahead_m > 0)
    way_m = np.where(meets, np.maximum(ahead_m - np.sqrt(np.maximum(square, 0.0)), 0.0), np.inf)
    free: FloatArray = way_m.min(axis=0, initial=np.inf)
    return free
