"""Tells ground stations, through the autopilot, what state the drone's flockd is in, and why."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from flockd.flight.safety import Decision, State
from flockd.onboard.autopilot.mavsdk_link import Severity

EVERY_S = 2.0
"""Between two texts, but for a graver one: a state that comes and goes meanwhile is not told."""

SEVERITIES: Mapping[State, Severity] = {
    State.IDLE: Severity.INFO,
    State.READY: Severity.INFO,
    State.NORMAL: Severity.INFO,
    State.DEGRADED: Severity.NOTICE,
    State.HOVER: Severity.WARNING,
    State.ASKING: Severity.CRITICAL,
    State.SILENT: Severity.WARNING,
}


class StateTexts:
    """Tells each new state once, the newest where several came too quickly."""

    def __init__(self, send: Callable[[str, Severity], None], clock: Callable[[], float]) -> None:
        self._send, self._clock = send, clock
        self._told: State | None = None
        self._told_s = -math.inf

    def update(self, decision: Decision) -> None:
        """Takes what the supervisor has decided; call it at each tick."""
        state, now_s = decision.state, self._clock()
        if state is self._told:
            return
        severity = SEVERITIES[state]
        graver = self._told is None or severity < SEVERITIES[self._told]
        if graver or now_s - self._told_s >= EVERY_S:
            self._told, self._told_s = state, now_s
            self._send(f"flockd {state_sentence(decision)}", severity)


def state_sentence(decision: Decision) -> str:
    """The state, and why it is so."""
    reasons = "; ".join(reason.sentence for reason in decision.reasons)
    return f"{decision.state}: {reasons}" if reasons else str(decision.state)
