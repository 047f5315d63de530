"""The supervisor: whether flockd may fly the drone now, and how it reacts to events.

Its levels are normal, degraded, hover, ask the autopilot, silence. It worsens at once and recovers only partly: a drone
once handed over stays so until it was seen disarmed on the ground or an operator asks to resume. The pilot always has
priority.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from flockd.core.config.safety import SafetyParameters
from flockd.flight.safety.events import Event, Inputs, notice
from flockd.flight.safety.policy import ASKS, Action, Barrier, Reaction, rules


class State(StrEnum):
    """The supervisor's state. The value is its name in telemetry."""

    IDLE = "idle"
    """Not ready. The initial state, in the air too."""
    READY = "ready"
    """Waiting for the pilot to switch to offboard."""
    NORMAL = "normal"
    DEGRADED = "degraded"
    HOVER = "hover"
    ASKING = "asking"
    """Waiting for the autopilot to take over."""
    SILENT = "silent"
    """Handed over: the pilot or the autopilot flies."""


FLYING = frozenset({State.NORMAL, State.DEGRADED, State.HOVER, State.ASKING})
_ACTIONS = {
    State.IDLE: Action.SILENCE,
    State.READY: Action.OFFER,
    State.NORMAL: Action.FLY,
    State.DEGRADED: Action.FLY_DEGRADED,
    State.HOVER: Action.HOVER,
    State.SILENT: Action.SILENCE,
}


class Reason(NamedTuple):
    """An event, for programs and for people."""

    event: Event
    sentence: str


class Decision(NamedTuple):
    """The supervisor's decision."""

    state: State
    action: Action
    reasons: tuple[Reason, ...]
    """First why the drone was handed over, if it was; then the present events, the worst first."""


@dataclass
class _Flight:
    """State of the current flight."""

    unwell_s: float = -math.inf
    """When the reaction was last DEGRADE or worse."""
    hovered_s: float = 0.0
    """Time hovered since it last flew normally."""
    asked: Reaction = Reaction.NOTE
    """The mode requested from the autopilot."""
    asked_s: float = math.inf


class Supervisor:
    """The state machine. It has no clock: `now_s` is monotonic and never decreases."""

    def __init__(self, parameters: SafetyParameters) -> None:
        self._parameters = parameters
        self._rules = rules(parameters)
        self._state = State.IDLE
        self._since_s: dict[Event, float] = {}
        """When each present event began; in flight, not before the flight began."""
        self._latched: dict[Event, str] = {
            Event.STARTED: "just started; waits to see the vehicle disarmed on the ground"
        }
        """Why flockd may not fly, even if all events have ended."""
        self._flight = _Flight()
        self._now_s = -math.inf

    def step(self, now_s: float, inputs: Inputs) -> Decision:
        """Takes the inputs at `now_s`; call it at 10 Hz or more."""
        if self._state is State.HOVER:
            self._flight.hovered_s += now_s - self._now_s
        self._now_s = now_s
        noticed = notice(inputs, self._parameters)
        self._since_s = {event: self._since_s.get(event, now_s) for event in noticed}
        if self._state in FLYING:
            self._fly(noticed)
        else:
            landed = inputs.armed is False and inputs.in_air is False
            self._wait(noticed, released=landed or inputs.resume_asked)
        action = ASKS[self._flight.asked] if self._state is State.ASKING else _ACTIONS[self._state]
        return Decision(self._state, action, self._reasons(noticed))

    def _wait(self, noticed: dict[Event, str], released: bool) -> None:
        """Idle, ready or silent: may the drone fly, and has the pilot switched to offboard?"""
        if released:
            self._latched = {}
        barriers = {event: self._rules[event].barrier for event in noticed}
        self._latched |= {event: noticed[event] for event, barrier in barriers.items() if barrier is Barrier.LATCH}
        if self._latched:
            self._state = State.SILENT if self._state is State.SILENT else State.IDLE
        elif Barrier.WAIT in barriers.values():
            self._state = State.IDLE
        elif Event.NOT_OFFBOARD in noticed:
            self._state = State.READY
        else:
            self._begin(noticed)

    def _begin(self, noticed: dict[Event, str]) -> None:
        """The pilot has switched to offboard."""
        self._since_s = dict.fromkeys(noticed, self._now_s)
        self._flight = _Flight()
        self._fly(noticed)

    def _fly(self, noticed: dict[Event, str]) -> None:
        """In flight: the worst event decides."""
        worst = max((self._reaction(event) for event in noticed), default=Reaction.NOTE)
        if worst >= Reaction.DEGRADE:
            self._flight.unwell_s = self._now_s
        if worst is Reaction.SILENCE:
            self._hand_over(State.SILENT, noticed)
        elif self._state is State.ASKING or worst >= Reaction.HOLD:
            self._ask(max(worst, Reaction.HOLD), noticed)
        elif worst is Reaction.HOVER and self._flight.hovered_s >= self._parameters.hover_s:
            self._ask(Reaction.HOLD, noticed)
        elif worst is Reaction.HOVER:
            self._state = State.HOVER
        elif self._now_s - self._flight.unwell_s < self._parameters.recovery_s:
            self._state = State.DEGRADED
        else:
            self._state = State.NORMAL
            self._flight.hovered_s = 0.0

    def _ask(self, wanted: Reaction, noticed: dict[Event, str]) -> None:
        """Requests a mode from the autopilot, later perhaps a worse one; silent if it does not comply in time."""
        if wanted > self._flight.asked:
            self._flight.asked, self._flight.asked_s = wanted, self._now_s
            self._hand_over(State.ASKING, noticed)
        elif self._now_s - self._flight.asked_s >= self._parameters.ask_timeout_s:
            self._hand_over(State.SILENT, {})
            self._latched[Event.NO_ANSWER] = "the autopilot did not take over; setpoints end, and its failsafe acts"

    def _hand_over(self, state: State, noticed: dict[Event, str]) -> None:
        """Ends the flight for good, and keeps the reason."""
        self._state = state
        grave = [event for event in noticed if self._reaction(event) >= Reaction.HOVER]
        self._latched |= {event: noticed[event] for event in sorted(grave, key=self._reaction, reverse=True)}

    def _reaction(self, event: Event) -> Reaction:
        return self._rules[event].reaction_at(self._now_s - self._since_s[event])

    def _reasons(self, noticed: dict[Event, str]) -> tuple[Reason, ...]:
        def gravity(event: Event) -> int:
            return self._reaction(event) if self._state in FLYING else self._rules[event].barrier

        now = {event: noticed[event] for event in sorted(noticed, key=gravity, reverse=True)}
        return tuple(Reason(event, sentence) for event, sentence in {**self._latched, **now}.items())
