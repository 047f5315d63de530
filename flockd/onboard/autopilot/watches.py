"""What the link watches in flight: parameters, foreign setpoints, and jumps of the local frame; pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flockd.core import services

LOSS_TIME, LOSS_ACTION, GROUND_STATION_LOSS = "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "NAV_DLL_ACT"
MOST_SPEED = "MPC_XY_VEL_MAX"
KINDS: Mapping[str, type[int] | type[float]] = {
    GROUND_STATION_LOSS: int, LOSS_TIME: float, LOSS_ACTION: int, MOST_SPEED: float
}  # fmt: skip
"""As PX4 declares them."""
LONGEST_LOSS_S = 1.0
"""Largest COM_OF_LOSS_T: PX4 flies on with the last velocity for so long."""
SAFE_ACTIONS: Mapping[int, str] = {0: "Position", 3: "Return", 4: "Land", 5: "Hold"}
"""Values of COM_OBL_RC_ACT with which the autopilot stays, lands or returns."""


class WatchedParameters:
    """The newest values, and their fault."""

    def __init__(self, report: Callable[[str], None]) -> None:
        """``report`` is called with one sentence for each change in flight."""
        self._report = report
        self.values: dict[str, float] = {}

    def take(self, name: str, value: float, *, armed: bool) -> None:
        """Takes a value that was read."""
        known = self.values.get(name, value)
        self.values[name] = value
        if armed and value != known:
            self._report(f"the autopilot's {name} was changed in flight from {known:g} to {value:g}")

    def fault(self, max_gap_s: float) -> str | None:
        """Why no drone may fly with them; None: it may. ``max_gap_s``: longest gap between setpoints in flight."""
        loss_s = self.values.get(LOSS_TIME, LONGEST_LOSS_S)
        if not max_gap_s < loss_s <= LONGEST_LOSS_S:
            return (
                f"the autopilot's {LOSS_TIME} is {loss_s:g}: its failsafe would act that long after the last setpoint; "
                f"set it above {max_gap_s:g} s, and to {LONGEST_LOSS_S:g} s at most"
            )
        action = self.values.get(LOSS_ACTION)
        if action is not None and action not in SAFE_ACTIONS:
            return (
                f"the autopilot's {LOSS_ACTION} is {action:g}: it would not stop the drone when setpoints stop; "
                f"set it to one of {', '.join(f'{safe} ({mode})' for safe, mode in SAFE_ACTIONS.items())}"
            )
        return None


SENT_S = services.POSITION_TARGET.timeout + LONGEST_LOSS_S
"""Time for which PX4 may follow a setpoint after it was sent, and before it follows the next: PX4 flies on with the
last one that arrived, and the message that reports it takes time."""
TOLERANCE_M_S = 0.3
"""Largest change of a setpoint by the autopilot itself, at a reset of its estimator."""
WINDOW, MOST_FOREIGN = 20, 2
"""Messages that are compared, two seconds' worth, and how many of them may name another setpoint."""


class SetpointWatch:
    """Compares the setpoint that PX4 follows with those sent. `sent` and `followed` may run on different threads."""

    def __init__(self, report: Callable[[str], None], parameters: Mapping[str, float]) -> None:
        """``report`` is called with one sentence, once in a flight, if setpoints are clipped; ``parameters``: the
        newest values of the autopilot's parameters."""
        self._report, self._parameters = report, parameters
        self._told = False
        self._sent: deque[tuple[float, float, float]] = deque(maxlen=200)
        self._foreign: deque[bool] = deque(maxlen=WINDOW)
        self.seen: str | None = None
        """Evidence of another sender's setpoints in the last seconds; None: there is none."""

    def sent(self, time_s: float, north_m_s: float, east_m_s: float) -> None:
        """Takes a setpoint that flockd has sent."""
        self._sent.append((time_s, north_m_s, east_m_s))

    def followed(self, time_s: float, north_m_s: float, east_m_s: float, *, offboard: bool) -> None:
        """Takes the setpoint that the autopilot follows; NaN: not a velocity. ``offboard``: it is in that mode."""
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
        """Whether it is one of flockd's setpoints, shortened, to the autopilot's limit if that is known."""
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


JUMP_M, JUMP_RAD = 0.3, math.radians(10.0)
"""Smallest jumps that are detected: far above an estimator's corrections between two messages."""
MOST_ACCELERATION = 20.0
"""Largest acceleration of a drone, m/s^2 and rad/s^2: bounds the change of velocity between two messages."""
LARGEST_M = 1.0
"""A larger jump, or one of the heading, ends the flight."""


class _Sample(NamedTuple):
    stamp_s: float
    value: Sequence[float]
    rate: Sequence[float]


class LocalFrame:
    """Detects jumps of the local frame. `offset` may be read on any thread.

    It uses plain numbers: at 80 messages a second, arrays of three would take most of a link's CPU time.
    """

    def __init__(self) -> None:
        self.offset = np.zeros(3)
        """(3,) m NED that are added to the autopilot's positions."""
        self.large = False
        """Whether one was larger than `LARGEST_M`, or of the heading; reset by the code that acts on it."""
        self._place: _Sample | None = None
        self._attitude: _Sample | None = None

    def restart(self) -> None:
        """Resets the offset: the autopilot's own frame counts from now on."""
        self.offset, self.large = np.zeros(3), False

    def move(self, stamp_s: float, place: Sequence[float], velocity: Sequence[float]) -> str | None:
        """Takes a position and velocity (3,) of the autopilot, by its own clock; returns one sentence on a jump."""
        before, self._place = self._place, _Sample(stamp_s, place, velocity)
        if before is None or stamp_s < before.stamp_s:
            return None
        half_s = 0.5 * (stamp_s - before.stamp_s)
        pairs = zip(place, before.value, before.rate, velocity, strict=True)
        jump = [now - was - half_s * (rate + rate_now) for now, was, rate, rate_now in pairs]
        if not JUMP_M + _unseen(2.0 * half_s) < math.hypot(*jump) < math.inf:
            return None
        self.offset = self.offset - jump
        self.large |= bool(max(math.hypot(*jump[:2]), abs(jump[2])) > LARGEST_M)
        north, east, down = (round(one, 1) + 0.0 for one in jump)
        return (
            f"the autopilot's local frame jumped by {north:.1f} m north, {east:.1f} m east and {down:.1f} m down; "
            "home, fence, height and goals move with it"
        )

    def turn(self, stamp_s: float, attitude: Sequence[float], rate: Sequence[float]) -> str | None:
        """Takes an attitude, a unit quaternion w x y z from the body to NED, and the body's rates (3,) in rad/s, by the
        autopilot's clock; returns one sentence on a jump of the heading.

        Only the heading counts: of the rotation w x y z from the attitude predicted by the rates to the one that was
        sent, the turn about the vertical is 2 atan2(z, w).
        """
        before, self._attitude = self._attitude, _Sample(stamp_s, attitude, rate)
        if before is None or stamp_s < before.stamp_s:
            return None
        interval_s = stamp_s - before.stamp_s
        half = [0.25 * interval_s * (was + now) for was, now in zip(before.rate, rate, strict=True)]
        angle = math.hypot(*half)
        scale = math.sin(angle) / angle if angle > 0.0 else 1.0
        reckoned = _product(before.value, (math.cos(angle), *(scale * one for one in half)))
        w, _, _, z = _product(attitude, (reckoned[0], *(-one for one in reckoned[1:])))
        jump_rad = math.remainder(2.0 * math.atan2(z, w), math.tau)
        if abs(jump_rad) <= JUMP_RAD + _unseen(interval_s):
            return None
        self.large = True
        return f"the autopilot's heading jumped by {math.degrees(jump_rad):.0f} degrees"


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    """Product of quaternions w x y z."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _unseen(interval_s: float) -> float:
    """Largest distance by which the mean of two velocities may be wrong."""
    return 0.25 * MOST_ACCELERATION * interval_s**2
