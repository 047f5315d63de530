"""A quiet flight on a fake clock, for stories about what disturbs it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

from flockd.flight.safety import (
    OFFBOARD,
    Action,
    CameraHealth,
    Decision,
    Event,
    Inputs,
    SafetyParameters,
    State,
    Supervisor,
)

STEP_S = 1 / 16
"""Step of the supervisor. A power of two, so that the clock adds up without rounding."""

SEES = CameraHealth(age_s=0.02, period_s=0.033, unplugged=False, frozen=False, noisy=False)
UNPLUGGED = replace(SEES, unplugged=True)
ALL_SEE = {"front": SEES, "right": SEES, "back": SEES, "left": SEES}
ONE_LOST = ALL_SEE | {"back": UNPLUGGED}
NONE_SEE = dict.fromkeys(ALL_SEE, UNPLUGGED)

QUIET = Inputs(
    cameras=ALL_SEE,
    dropped_share=0.01,
    estimate_age_s=0.4,
    ego_motion_age_s=0.0,
    network_faults=0,
    inference_stuck=False,
    load=0.6,
    temperature_c=60.0,
    loop_lag_s=0.01,
    velocity_error_m_s=0.1,
    velocity_late_s=0.0,
    dead_tasks=(),
    neighbours_age_s=0.4,
    nearest_neighbour_m=2.5,
    refused_commands=0,
    obstacle_near=False,
    outside_fence=False,
    outside_heights=False,
    motion_age_s=0.03,
    heartbeat_age_s=0.5,
    message_age_s=0.1,
    stream_fault=None,
    autopilot_failsafe=False,
    foreign_setpoints=None,
    parameter_fault=None,
    frame_jumped=False,
    flight_mode=OFFBOARD,
    armed=True,
    in_air=True,
    battery_low=False,
    position_lost=False,
    shutdown_asked=False,
    hold_asked=False,
    land_asked=False,
    resume_asked=False,
)
"""A flight in which nothing is the matter; every test says what is different."""


class Flight:
    """A supervisor, its clock, and what it is told."""

    def __init__(self, parameters: SafetyParameters | None = None, now_s: float = 1000.0) -> None:
        self.supervisor = Supervisor(parameters or SafetyParameters())
        self.now_s = now_s
        self.inputs = QUIET
        self.decision = Decision(State.IDLE, Action.SILENCE, ())

    def tell(self, **changes: Any) -> Self:
        """From the next step on, this is different."""
        self.inputs = replace(self.inputs, **changes)
        return self

    def step(self, **changes: Any) -> Self:
        """One step."""
        self.tell(**changes)
        self.now_s += STEP_S
        self.decision = self.supervisor.step(self.now_s, self.inputs)
        return self

    def run(self, duration_s: float, **changes: Any) -> Self:
        """Steps for as long as that, a multiple of a step."""
        self.tell(**changes)
        steps = duration_s / STEP_S
        assert steps.is_integer()
        for _ in range(int(steps)):
            self.step()
        return self

    @property
    def state(self) -> State:
        return self.decision.state

    @property
    def action(self) -> Action:
        return self.decision.action

    @property
    def events(self) -> list[Event]:
        return [reason.event for reason in self.decision.reasons]

    def sentence(self, event: Event) -> str:
        return {reason.event: reason.sentence for reason in self.decision.reasons}[event]


def on_the_ground(parameters: SafetyParameters | None = None) -> Flight:
    """Switched on, disarmed, the autopilot in Hold."""
    return Flight(parameters).step(armed=False, in_air=False, flight_mode="hold")


def ready(parameters: SafetyParameters | None = None) -> Flight:
    """The pilot has brought the drone up."""
    return on_the_ground(parameters).step(armed=True).step(in_air=True)


def flying(parameters: SafetyParameters | None = None) -> Flight:
    """The pilot has switched to offboard."""
    return ready(parameters).step(flight_mode=OFFBOARD)
