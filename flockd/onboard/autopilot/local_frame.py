"""The autopilot's positions in a frame that does not jump; pure, knows no clock.

An estimator that is reset, or given another origin, tells the same place by other numbers from one message to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import rotation_from_vector

JUMP_M, JUMP_RAD = 0.3, math.radians(10.0)
"""What an estimator's corrections from one message to the next stay below by far; less is not noticed."""
MOST_ACCELERATION = 20.0
"""Of a drone, m/s^2 and rad/s^2: by so much its velocity may have changed unseen between two messages."""
LARGEST_M = 1.0
"""A larger jump, or one of the heading, is not flown on with."""


@dataclass(frozen=True, eq=False)
class _Sample:
    stamp_s: float
    value: FloatArray
    rate: FloatArray


class LocalFrame:
    """Notices jumps. `offset` may be read on any thread."""

    def __init__(self) -> None:
        self.offset = np.zeros(3)
        """(3,) m NED to be added to the autopilot's own positions."""
        self.large = False
        """One was larger than `LARGEST_M`, or of the heading; whoever has acted on it sets it back."""
        self._place: _Sample | None = None
        self._attitude: _Sample | None = None

    def restart(self) -> None:
        """The autopilot's own frame counts from now on."""
        self.offset, self.large = np.zeros(3), False

    def move(self, stamp_s: float, place: FloatArray, velocity: FloatArray) -> str | None:
        """Takes a position and velocity (3,) of the autopilot's, by its own clock; one sentence on a jump."""
        before, self._place = self._place, _Sample(stamp_s, place, velocity)
        if before is None or stamp_s < before.stamp_s:
            return None
        interval_s = stamp_s - before.stamp_s
        jump = place - before.value - 0.5 * interval_s * (before.rate + velocity)
        if not JUMP_M + _unseen(interval_s) < np.linalg.norm(jump) < math.inf:
            return None
        self.offset = self.offset - jump
        self.large |= float(max(math.hypot(jump[0], jump[1]), abs(jump[2]))) > LARGEST_M
        north, east, down = np.round(jump, 1) + 0.0
        return (
            f"the autopilot's local frame jumped by {north:.1f} m north, {east:.1f} m east and {down:.1f} m down; "
            "home, fence, height and goals move with it"
        )

    def turn(self, stamp_s: float, R_ned_body: FloatArray, rate: FloatArray) -> str | None:
        """The same of attitudes (3, 3) and rates (3,) in rad/s of the body: only the heading is looked at."""
        before, self._attitude = self._attitude, _Sample(stamp_s, R_ned_body, rate)
        if before is None or stamp_s < before.stamp_s:
            return None
        interval_s = stamp_s - before.stamp_s
        reckoned = before.value @ rotation_from_vector(0.5 * interval_s * (before.rate + rate))
        off = R_ned_body @ reckoned.T
        jump_rad = math.atan2(off[1, 0] - off[0, 1], off[0, 0] + off[1, 1])
        if abs(jump_rad) <= JUMP_RAD + _unseen(interval_s):
            return None
        self.large = True
        return f"the autopilot's heading jumped by {math.degrees(jump_rad):.0f} degrees"


def _unseen(interval_s: float) -> float:
    """How far off the mean of two velocities may lead."""
    return 0.25 * MOST_ACCELERATION * interval_s**2
