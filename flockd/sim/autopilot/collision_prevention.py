"""PX4's Collision Prevention as the fake autopilot keeps it: what it does with OBSTACLE_DISTANCE in Position mode.

Its smooth braking is not PX4's: here the speed towards an obstacle falls with what is left of the distance.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flockd.core.messages import FloatArray

SECTORS = 72
FRESH_S, HOLD_S = 0.5, 5.0
"""How old a sector may become; and for how long without any, before PX4 goes to Hold."""
UNKNOWN_CM = 0xFFFF
MAV_FRAME_BODY_FRD = 12
SPEED_PER_M = 1.0


class CollisionPrevention:
    """The newest distance in each sector, clockwise from the nose."""

    def __init__(self) -> None:
        self.distances_cm = np.full(SECTORS, UNKNOWN_CM)
        self._since_s = np.full(SECTORS, -math.inf)
        self._directions = np.exp(2j * np.pi * np.arange(SECTORS) / SECTORS)

    def take(self, message: Any, now_s: float) -> None:
        """Takes a message of the one kind that it knows; unknown sectors stay as they are until they are old."""
        if message.frame != MAV_FRAME_BODY_FRD or message.increment != 360 // SECTORS:
            return
        sent = np.array(message.distances)
        known = sent != UNKNOWN_CM
        self.distances_cm[known], self._since_s[known] = sent[known], now_s

    def without_data_s(self, now_s: float) -> float:
        """Since any sector was fresh; infinite before the first."""
        return now_s - float(self._since_s.max())

    def limited(self, velocity: FloatArray, keep_m: float, now_s: float) -> FloatArray:
        """(2,) m/s ahead and right, of what the sticks ask for: nothing towards what is not known."""
        wanted = complex(*velocity)
        fresh = now_s - self._since_s <= FRESH_S
        sector = round(np.angle(wanted) * SECTORS / (2 * np.pi)) % SECTORS
        if not fresh[sector]:
            return np.zeros(2)
        for away_m, direction in zip(0.01 * self.distances_cm[fresh], self._directions[fresh], strict=True):
            towards = (wanted * direction.conjugate()).real
            wanted -= max(towards - SPEED_PER_M * max(away_m - keep_m, 0.0), 0.0) * direction
        return np.array([wanted.real, wanted.imag])
