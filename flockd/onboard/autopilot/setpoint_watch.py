"""Whether the autopilot follows flockd's setpoints or somebody else's; pure, knows no clock.

PX4 takes the newest setpoint of any sender. It tells the one that it follows by POSITION_TARGET_LOCAL_NED.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

from flockd.core import services
from flockd.onboard.autopilot.watched_parameters import LONGEST_LOSS_S, MOST_SPEED

SENT_S = services.POSITION_TARGET.timeout + LONGEST_LOSS_S
"""A setpoint of flockd's may be followed for this long after it was sent, and the next for as long not yet: for as long
as PX4 flies on with the last one that arrived, and as a message that tells of it may take."""
TOLERANCE_M_S = 0.3
"""What the autopilot changes of a setpoint itself: a reset of its estimator."""
WINDOW, MOST_FOREIGN = 20, 2
"""Of so many messages, two seconds' worth, so few may name another setpoint."""


class SetpointWatch:
    """Compares what is followed with what was sent. `sent` and `followed` may be called on different threads."""

    def __init__(self, report: Callable[[str], None], parameters: Mapping[str, float]) -> None:
        """``report`` is called with one sentence where setpoints are clipped, once in a flight; ``parameters``: the
        newest values of the autopilot's.
        """
        self._report, self._parameters = report, parameters
        self._told = False
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
            self.seen, self._told = None, self._told and offboard
            return
        off_m_s = min(math.hypot(north_m_s - north, east_m_s - east) for _, north, east in recent)
        own = off_m_s <= TOLERANCE_M_S or self._is_clipped(north_m_s, east_m_s, recent)
        self._foreign.append(not own)
        if sum(self._foreign) <= MOST_FOREIGN:
            self.seen = None
        elif self._foreign[-1]:
            what = f"{north_m_s:.1f} m/s north and {east_m_s:.1f} m/s east"
            if not math.isfinite(off_m_s):
                what = "a setpoint without a velocity"
            self.seen = f"another program sends setpoints: the autopilot follows {what}, which flockd did not send"

    def _is_clipped(self, north_m_s: float, east_m_s: float, recent: list[tuple[float, float, float]]) -> bool:
        """Whether it is one of flockd's, but shorter, and as long as the autopilot's limit where that is known."""
        flown_m_s, limit_m_s = math.hypot(north_m_s, east_m_s), self._parameters.get(MOST_SPEED)
        if not flown_m_s > TOLERANCE_M_S or (limit_m_s is not None and abs(flown_m_s - limit_m_s) > TOLERANCE_M_S):
            return False
        for _, north, east in recent:
            asked_m_s = math.hypot(north, east)
            share = flown_m_s / max(asked_m_s, flown_m_s)
            if math.hypot(north_m_s - share * north, east_m_s - share * east) <= TOLERANCE_M_S:
                if not self._told:
                    known = "may limit it" if limit_m_s is None else f"is {limit_m_s:g}"
                    self._report(
                        f"the autopilot flies slower than flockd asks, {flown_m_s:.1f} instead of {asked_m_s:.1f} m/s: "
                        f"its {MOST_SPEED} {known}"
                    )
                self._told = True
                return True
        return False
