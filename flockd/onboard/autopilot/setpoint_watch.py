"""Whether the autopilot follows flockd's setpoints or somebody else's; pure, knows no clock.

PX4 takes the newest setpoint of any sender. It tells the one that it follows by POSITION_TARGET_LOCAL_NED.
"""

from __future__ import annotations

import math
from collections import deque

from flockd.core import services

SENT_S = services.POSITION_TARGET.timeout
"""A setpoint of flockd's may be followed for this long after it was sent, and the next for as long not yet."""
TOLERANCE_M_S = 0.3
"""What the autopilot changes of a setpoint itself: a reset of its estimator."""
WINDOW, MOST_FOREIGN = 20, 2
"""Of so many messages, two seconds' worth, so few may name another setpoint."""


class SetpointWatch:
    """Compares what is followed with what was sent. `sent` and `followed` may be called on different threads."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float, float]] = deque(maxlen=200)
        self._foreign: deque[bool] = deque(maxlen=WINDOW)
        self.seen: str | None = None
        """What was seen of another sender in the last seconds; None: nothing."""

    def sent(self, time_s: float, north_m_s: float, east_m_s: float) -> None:
        """Flockd has sent this setpoint."""
        self._sent.append((time_s, north_m_s, east_m_s))

    def followed(self, time_s: float, north_m_s: float, east_m_s: float, *, offboard: bool) -> None:
        """The autopilot follows this one; NaN: it does not follow a velocity. ``offboard``: it is in that mode."""
        sent = list(self._sent)
        recent = [one for one in sent if time_s - one[0] <= SENT_S]
        if not offboard or not recent or time_s - sent[0][0] <= SENT_S:
            self._foreign.clear()
            self.seen = None
            return
        off_m_s = min(math.hypot(north_m_s - north, east_m_s - east) for _, north, east in recent)
        self._foreign.append(not off_m_s <= TOLERANCE_M_S)
        if sum(self._foreign) <= MOST_FOREIGN:
            self.seen = None
        elif self._foreign[-1]:
            what = f"{north_m_s:.1f} m/s north and {east_m_s:.1f} m/s east"
            if not math.isfinite(off_m_s):
                what = "a setpoint without a velocity"
            self.seen = f"another program sends setpoints: the autopilot follows {what}, which flockd did not send"
