"""The supervisor on a fake clock: every state with every event, and stories of flights that go wrong."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any, Literal, NamedTuple, Self

import pytest

from flockd.flight.safety import (
    OFFBOARD,
    Action,
    CameraHealth,
    Decision,
    Event,
    Inputs,
    MissionEnd,
    SafetyParameters,
    State,
    Supervisor,
)
from flockd.flight.safety.events import notice

NAN, NEVER = math.nan, math.inf
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


class Fault(NamedTuple):
    """One row of what is promised: how a fault shows, and what it means before the flight and in it."""

    changes: dict[str, Any]
    before: Literal["ready", "wait", "latch"]
    action: Action


FAULTS = {
    Event.SIGHT_LOST: Fault({"cameras": NONE_SEE}, "wait", Action.HOVER),
    Event.CAMERA_LOST: Fault({"cameras": ONE_LOST}, "ready", Action.FLY_DEGRADED),
    Event.FRAMES_DROPPED: Fault({"dropped_share": 0.25}, "ready", Action.FLY_DEGRADED),
    Event.ESTIMATE_STALE: Fault({"estimate_age_s": 1.6}, "wait", Action.HOVER),
    Event.EGO_MOTION_POOR: Fault({"ego_motion_age_s": 1.5}, "ready", Action.FLY_DEGRADED),
    Event.EGO_MOTION_LOST: Fault({"ego_motion_age_s": 3.0}, "wait", Action.HOVER),
    Event.NETWORK_FAULT: Fault({"network_faults": 1}, "ready", Action.FLY_DEGRADED),
    Event.INFERENCE_STUCK: Fault({"inference_stuck": True}, "ready", Action.FLY_DEGRADED),
    Event.OVERLOADED: Fault({"load": 1.5}, "ready", Action.FLY_DEGRADED),
    Event.FAR_OVERLOADED: Fault({"load": 2.5}, "wait", Action.HOVER),
    Event.HOT: Fault({"temperature_c": 90.0}, "ready", Action.FLY_DEGRADED),
    Event.TOO_HOT: Fault({"temperature_c": 100.0}, "wait", Action.HOVER),
    Event.LOOP_LATE: Fault({"loop_lag_s": 0.3}, "ready", Action.FLY_DEGRADED),
    Event.VELOCITY_OFF: Fault({"velocity_error_m_s": 0.7}, "ready", Action.FLY_DEGRADED),
    Event.VELOCITY_FAR_OFF: Fault({"velocity_error_m_s": 0.9}, "ready", Action.ASK_HOLD),
    Event.NO_ROOM_TO_HOLD: Fault({"velocity_error_m_s": 0.9, "obstacle_near": True}, "ready", Action.FLY_DEGRADED),
    Event.TASK_DIED: Fault({"dead_tasks": ("pilot",)}, "wait", Action.ASK_HOLD),
    Event.NEIGHBOURS_LOST: Fault({"neighbours_age_s": 2.5}, "ready", Action.FLY),
    Event.NEIGHBOUR_CLOSE: Fault({"nearest_neighbour_m": 0.9}, "ready", Action.FLY),
    Event.COMMAND_REFUSED: Fault({"refused_commands": 1}, "ready", Action.FLY_DEGRADED),
    Event.FENCE_LEFT: Fault({"outside_fence": True}, "wait", Action.FLY_DEGRADED),
    Event.HEIGHTS_LEFT: Fault({"outside_heights": True}, "wait", Action.FLY_DEGRADED),
    Event.MOTION_UNKNOWN: Fault({"motion_age_s": 0.6}, "wait", Action.HOVER),
    Event.LINK_LOST: Fault({"heartbeat_age_s": 3.6}, "latch", Action.SILENCE),
    Event.STREAM_ENDED: Fault({"stream_fault": "the thread was stopped"}, "latch", Action.SILENCE),
    Event.AUTOPILOT_FAILSAFE: Fault({"autopilot_failsafe": True}, "wait", Action.FLY),
    Event.FOREIGN_SETPOINTS: Fault({"foreign_setpoints": "3 m/s north"}, "ready", Action.FLY_DEGRADED),
    Event.PARAMETERS_UNSUITABLE: Fault({"parameter_fault": "COM_OF_LOSS_T is 20"}, "wait", Action.FLY_DEGRADED),
    Event.NOT_OFFBOARD: Fault({"flight_mode": "position"}, "ready", Action.SILENCE),
    Event.NOT_ARMED: Fault({"armed": False}, "wait", Action.SILENCE),
    Event.NOT_IN_AIR: Fault({"in_air": False}, "wait", Action.FLY),
    Event.FRAME_JUMPED: Fault({"frame_jumped": True}, "ready", Action.ASK_HOLD),
    Event.BATTERY_LOW: Fault({"battery_low": True}, "wait", Action.ASK_HOLD),
    Event.POSITION_LOST: Fault({"position_lost": True}, "wait", Action.ASK_HOLD),
    Event.SHUTDOWN_ASKED: Fault({"shutdown_asked": True}, "latch", Action.ASK_HOLD),
    Event.HOLD_ASKED: Fault({"hold_asked": True}, "latch", Action.ASK_HOLD),
    Event.LAND_ASKED: Fault({"land_asked": True}, "latch", Action.ASK_LAND),
    Event.MISSION_LANDS: Fault({"mission_over": MissionEnd.LAND}, "ready", Action.ASK_LAND),
    Event.MISSION_RETURNS: Fault({"mission_over": MissionEnd.RETURN}, "ready", Action.ASK_RETURN),
}
"""faults.md, fault by fault."""

WORSE = (
    Action.FLY,
    Action.FLY_DEGRADED,
    Action.HOVER,
    Action.ASK_HOLD,
    Action.ASK_RETURN,
    Action.ASK_LAND,
    Action.SILENCE,
)
"""The ladder, from the top down."""
STATE_OF = {
    Action.FLY: State.NORMAL,
    Action.FLY_DEGRADED: State.DEGRADED,
    Action.HOVER: State.HOVER,
    Action.ASK_HOLD: State.ASKING,
    Action.ASK_RETURN: State.ASKING,
    Action.ASK_LAND: State.ASKING,
    Action.SILENCE: State.SILENT,
}


def worst(*actions: Action) -> Action:
    return max(actions, key=WORSE.index)


def everything_well(fault: Fault) -> dict[str, Any]:
    """What undoes a fault."""
    return {key: getattr(QUIET, key) for key in fault.changes}


EVENTS = pytest.mark.parametrize("event", FAULTS, ids=str)


def test_every_event_that_inputs_can_show_is_in_the_table() -> None:
    assert FAULTS.keys() == set(Event) - {Event.STARTED, Event.NO_ANSWER}


@EVENTS
def test_each_fault_shows_as_its_own_event_and_as_no_other(event: Event) -> None:
    noticed = notice(replace(QUIET, **FAULTS[event].changes), SafetyParameters())
    assert noticed.keys() == {event}
    assert noticed[event]


def test_nothing_is_the_matter_in_a_quiet_flight() -> None:
    assert notice(QUIET, SafetyParameters()) == {}


# Every state with every event.


@EVENTS
def test_idle_stays_idle_and_silent_and_is_ready_afterwards_unless_latched(event: Event) -> None:
    flight = on_the_ground().step(armed=True)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    flight.step(**{"flight_mode": "hold", **FAULTS[event].changes})
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    assert event in flight.events
    flight.step(**everything_well(FAULTS[event])).step(in_air=True, armed=True, flight_mode="hold")
    latched = FAULTS[event].before == "latch"
    assert flight.state is (State.IDLE if latched else State.READY)
    assert (event in flight.events) == (latched or event is Event.NOT_OFFBOARD)


@EVENTS
def test_ready_offers_standstill_only_while_it_may_fly(event: Event) -> None:
    flight = ready()
    assert (flight.state, flight.action) == (State.READY, Action.OFFER)
    flight.step(**FAULTS[event].changes)
    expected = {
        "ready": (State.READY, Action.OFFER),
        "wait": (State.IDLE, Action.SILENCE),
        "latch": (State.IDLE, Action.SILENCE),
    }
    assert (flight.state, flight.action) == expected[FAULTS[event].before]
    assert event in flight.events
    flight.step(**everything_well(FAULTS[event]), **{"flight_mode": "hold"} if event is not Event.NOT_OFFBOARD else {})
    if event is not Event.NOT_OFFBOARD:
        assert flight.state is (State.IDLE if FAULTS[event].before == "latch" else State.READY)


@EVENTS
def test_a_flight_begins_only_if_nothing_is_in_its_way(event: Event) -> None:
    flight = ready().step(**{"flight_mode": OFFBOARD, **FAULTS[event].changes})
    if event is Event.NOT_OFFBOARD:
        assert flight.state is State.READY
    elif FAULTS[event].before == "ready":
        assert flight.action is FAULTS[event].action
    else:
        assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)


FLIGHTS: dict[Action, tuple[dict[str, Any], ...]] = {
    Action.FLY: ({},),
    Action.FLY_DEGRADED: ({"load": 1.5},),
    Action.HOVER: ({"estimate_age_s": 1.6},),
    Action.ASK_HOLD: ({"hold_asked": True}, {"hold_asked": False}),
}
"""The steps that lead there."""


@EVENTS
@pytest.mark.parametrize("before", FLIGHTS, ids=str)
def test_a_flight_goes_as_far_down_the_ladder_as_the_event_asks_and_gets_no_better_by_it(
    before: Action, event: Event
) -> None:
    flight = flying()
    for changes in FLIGHTS[before]:
        flight.step(**changes)
    assert (flight.state, flight.action) == (STATE_OF[before], before)
    flight.step(**FAULTS[event].changes)
    expected = worst(before, FAULTS[event].action)
    assert (flight.state, flight.action) == (STATE_OF[expected], expected)
    if before is Action.FLY:
        assert event in flight.events
    elif before is Action.ASK_HOLD:
        assert flight.events[0] is Event.HOLD_ASKED


@EVENTS
def test_silent_stays_silent_whatever_happens_and_afterwards(event: Event) -> None:
    flight = flying().step(flight_mode="position").step(**FAULTS[event].changes)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    flight.step(**everything_well(FAULTS[event])).step(flight_mode=OFFBOARD)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    assert flight.events[0] is Event.NOT_OFFBOARD


CAUSE_AND_EFFECT = (
    {Event.LINK_LOST, Event.STREAM_ENDED},
    {Event.FOREIGN_SETPOINTS, Event.VELOCITY_FAR_OFF},
    {Event.FOREIGN_SETPOINTS, Event.NO_ROOM_TO_HOLD},
)


@EVENTS
def test_of_two_events_the_worse_wins_and_is_reported_first(event: Event) -> None:
    for other, fault in FAULTS.items():
        if fault.changes.keys() & FAULTS[event].changes.keys():
            continue  # two values of one number
        if {event, other} in CAUSE_AND_EFFECT:
            continue  # told by its cause alone
        flight = flying().step(**FAULTS[event].changes, **fault.changes)
        expected = worst(fault.action, FAULTS[event].action)
        assert flight.action is expected, other
        assert FAULTS[flight.events[0]].action is expected
        assert sorted(flight.events) == sorted({event, other})


# Stories.


def test_the_pilot_brings_it_up_and_switches_to_offboard() -> None:
    flight = Flight().step(armed=None, in_air=None, flight_mode=None, heartbeat_age_s=NEVER, estimate_age_s=NEVER)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    assert flight.events[0] is Event.STARTED
    flight.step(armed=False, in_air=False, flight_mode="hold", heartbeat_age_s=0.2)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    assert Event.STARTED not in flight.events
    flight.step(estimate_age_s=0.4).step(armed=True, flight_mode="take-off")
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    flight.step(in_air=True)
    assert (flight.state, flight.action) == (State.READY, Action.OFFER)
    flight.run(30.0, flight_mode="hold")
    assert flight.events == [Event.NOT_OFFBOARD]
    flight.step(flight_mode=OFFBOARD)
    assert (flight.state, flight.action, flight.events) == (State.NORMAL, Action.FLY, [])


def test_restarted_in_the_air_it_comes_up_idle_although_offboard_is_still_on() -> None:
    flight = Flight().run(20.0)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    flight.step(flight_mode="hold").run(5.0).step(flight_mode=OFFBOARD).run(5.0)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    assert flight.events == [Event.STARTED]


def test_an_operator_resumes_after_a_restart_in_the_air_and_the_pilot_switches() -> None:
    flight = Flight().step(flight_mode="hold").step(resume_asked=True).step(resume_asked=False)
    assert (flight.state, flight.action) == (State.READY, Action.OFFER)
    assert flight.step(flight_mode=OFFBOARD).action is Action.FLY


@pytest.mark.parametrize(
    ("armed", "in_air"), [(None, None), (None, False), (False, None), (False, True), (True, False), (True, None)]
)
def test_only_a_vehicle_known_to_be_disarmed_and_on_the_ground_makes_a_new_start(
    armed: bool | None, in_air: bool | None
) -> None:
    flight = Flight().step(armed=armed, in_air=in_air).step(armed=True, in_air=True)
    assert flight.state is State.IDLE


def test_what_was_true_before_the_link_was_lost_makes_no_new_start() -> None:
    flight = Flight().step(armed=False, in_air=False, heartbeat_age_s=4.0).step(armed=True, in_air=True)
    assert flight.step(heartbeat_age_s=0.1).state is State.IDLE


def test_the_pilot_takes_over_and_it_never_comes_back_by_itself() -> None:
    flight = flying().run(10.0).step(flight_mode="position")
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    assert flight.sentence(Event.NOT_OFFBOARD) == "the flight mode is position"
    flight.step(flight_mode=OFFBOARD)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    flight.run(60.0, flight_mode="position").run(60.0, flight_mode=OFFBOARD)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    assert flight.events == [Event.NOT_OFFBOARD]


def test_what_was_mild_when_the_pilot_took_over_is_not_reported_as_a_reason_for_it() -> None:
    flight = flying().step(cameras=ONE_LOST, flight_mode="position").step(cameras=ALL_SEE)
    assert flight.events == [Event.NOT_OFFBOARD]


def test_after_landing_and_disarming_a_new_flight_may_begin() -> None:
    flight = flying().step(flight_mode="position").step(flight_mode="land").step(in_air=False)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    flight.step(armed=False)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    flight.step(armed=True).step(in_air=True, flight_mode="hold")
    assert flight.action is Action.OFFER
    flight.step(flight_mode=OFFBOARD)
    assert (flight.state, flight.action) == (State.NORMAL, Action.FLY)


def test_link_lost_and_regained_does_not_restart_offboard_by_itself() -> None:
    flight = flying().run(5.0).run(1.5, heartbeat_age_s=3.4)
    assert (flight.state, flight.action) == (State.NORMAL, Action.FLY)
    flight.step(heartbeat_age_s=3.6)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    flight.run(30.0, heartbeat_age_s=0.2)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    assert flight.events == [Event.LINK_LOST]
    flight.step(flight_mode="hold").run(5.0, flight_mode=OFFBOARD)
    assert flight.action is Action.SILENCE


@pytest.mark.fault("own-stall")
def test_flockds_own_stall_is_told_before_the_mode_that_followed_from_it() -> None:
    flight = flying().step(stream_fault="the thread was stopped", flight_mode="hold").step(stream_fault=None)
    assert flight.events == [Event.STREAM_ENDED, Event.NOT_OFFBOARD]
    assert flight.sentence(Event.STREAM_ENDED) == "setpoints ended: the thread was stopped"


def test_a_stream_that_ended_with_the_link_is_told_once() -> None:
    flight = flying().step(stream_fault="no heartbeat", heartbeat_age_s=3.6)
    assert flight.events == [Event.LINK_LOST]


def test_after_the_autopilots_failsafe_it_is_ready_when_the_pilot_has_selected_another_mode() -> None:
    flight = flying().step(flight_mode="hold", autopilot_failsafe=True).step(resume_asked=True).step(resume_asked=False)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    assert flight.events[0] is Event.AUTOPILOT_FAILSAFE
    flight.step(autopilot_failsafe=False)
    assert (flight.state, flight.action) == (State.READY, Action.OFFER)


@pytest.mark.parametrize("what", ["foreign_setpoints", "parameter_fault"])
def test_somebody_who_interferes_for_half_a_second_makes_it_ask_for_hold(what: str) -> None:
    flight = flying().step(**{what: "seen"})
    assert flight.action is Action.FLY_DEGRADED
    assert flight.run(0.375).action is Action.FLY_DEGRADED
    assert flight.run(0.1875).action is Action.ASK_HOLD


def test_link_lost_while_ready_needs_a_new_start_too() -> None:
    flight = ready().step(heartbeat_age_s=3.6).step(heartbeat_age_s=0.2)
    assert (flight.state, flight.action) == (State.IDLE, Action.SILENCE)
    flight.step(resume_asked=True)
    assert (flight.state, flight.action) == (State.READY, Action.OFFER)


def test_resume_does_not_help_while_the_link_is_lost() -> None:
    flight = flying().step(heartbeat_age_s=4.0).step(resume_asked=True).step(resume_asked=False)
    assert flight.step(heartbeat_age_s=0.2).state is State.SILENT


def test_resume_in_flight_changes_nothing() -> None:
    flight = flying().step(cameras=NONE_SEE).step(resume_asked=True)
    assert flight.state is State.HOVER


def test_a_glimpse_lost_for_half_a_second_is_a_hover_and_a_slow_while() -> None:
    flight = flying().run(0.5, cameras=NONE_SEE)
    assert (flight.state, flight.action) == (State.HOVER, Action.HOVER)
    flight.step(cameras=ALL_SEE)
    assert (flight.state, flight.action, flight.events) == (State.DEGRADED, Action.FLY_DEGRADED, [])
    flight.run(2.0 - 2 * STEP_S)
    assert (flight.state, flight.action) == (State.DEGRADED, Action.FLY_DEGRADED)
    flight.step()
    assert (flight.state, flight.action) == (State.NORMAL, Action.FLY)


def test_cameras_unplugged_hover_at_most_a_second_then_hold_then_silence() -> None:
    flight = flying().step(cameras=NONE_SEE).run(1.0 - STEP_S)
    assert (flight.state, flight.action) == (State.HOVER, Action.HOVER)
    flight.step()
    assert (flight.state, flight.action) == (State.ASKING, Action.ASK_HOLD)
    flight.run(0.5)
    assert (flight.state, flight.action) == (State.ASKING, Action.ASK_HOLD)
    flight.step(flight_mode="hold")
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    assert flight.events[:2] == [Event.SIGHT_LOST, Event.NOT_OFFBOARD]


def test_cameras_plugged_in_again_do_not_bring_it_back_after_hold_was_asked() -> None:
    flight = flying().run(1.5, cameras=NONE_SEE)
    assert flight.state is State.ASKING
    flight.step(cameras=ALL_SEE)
    assert (flight.state, flight.action) == (State.ASKING, Action.ASK_HOLD)
    assert flight.events == [Event.SIGHT_LOST]
    flight.step(flight_mode="hold").run(10.0).run(10.0, flight_mode=OFFBOARD)
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)


def test_a_loose_plug_does_not_make_it_hover_for_ever() -> None:
    flight = flying().run(0.375, cameras=NONE_SEE).run(0.5, cameras=ALL_SEE)
    flight.run(0.375, cameras=NONE_SEE).run(0.5, cameras=ALL_SEE)
    assert (flight.state, flight.action) == (State.DEGRADED, Action.FLY_DEGRADED)
    flight.step(cameras=NONE_SEE).run(0.25 - STEP_S)
    assert (flight.state, flight.action) == (State.HOVER, Action.HOVER)
    flight.step()  # 0.375 + 0.375 + 0.25 s of hovering
    assert (flight.state, flight.action) == (State.ASKING, Action.ASK_HOLD)


def test_after_a_while_of_flying_as_usual_it_may_hover_a_whole_second_again() -> None:
    flight = flying().run(0.875, cameras=NONE_SEE).run(3.0, cameras=ALL_SEE)
    assert flight.state is State.NORMAL
    assert flight.run(0.875, cameras=NONE_SEE).state is State.HOVER


def test_every_flight_has_its_own_second_of_hovering() -> None:
    flight = flying().run(0.875, cameras=NONE_SEE).step(flight_mode="position", cameras=ALL_SEE)
    flight.step(armed=False, in_air=False).step(armed=True, in_air=True, flight_mode="hold")
    assert flight.step(flight_mode=OFFBOARD).state is State.NORMAL
    assert flight.run(0.875, cameras=NONE_SEE).state is State.HOVER


def test_a_flight_that_begins_degraded_has_a_whole_second_of_hovering_too() -> None:
    flight = ready().step(cameras=ONE_LOST).step(flight_mode=OFFBOARD)
    assert flight.state is State.DEGRADED
    flight.step(cameras=NONE_SEE).run(1.0 - STEP_S)
    assert (flight.state, flight.action) == (State.HOVER, Action.HOVER)


def test_it_makes_no_difference_what_the_clock_showed_at_the_start() -> None:
    for now_s in (0.0, 1e6):
        flight = Flight(now_s=now_s).step(armed=False, in_air=False, flight_mode="hold").step(armed=True, in_air=True)
        assert flight.step(flight_mode=OFFBOARD).state is State.NORMAL


def test_every_flight_asks_anew() -> None:
    flight = flying().step(land_asked=True).step(land_asked=False, flight_mode="land")
    flight.step(armed=False, in_air=False).step(armed=True, in_air=True, flight_mode="hold").step(flight_mode=OFFBOARD)
    flight.step(hold_asked=True)
    assert (flight.state, flight.action) == (State.ASKING, Action.ASK_HOLD)


@pytest.mark.parametrize("asked", ["hold_asked", "land_asked", "shutdown_asked"])
def test_an_autopilot_that_does_not_reply_is_left_to_its_failsafe_after_two_seconds(asked: str) -> None:
    flight = flying().step(**{asked: True}).run(2.0 - STEP_S)
    assert flight.state is State.ASKING
    flight.step()
    assert (flight.state, flight.action) == (State.SILENT, Action.SILENCE)
    assert Event.NO_ANSWER in flight.events
    assert flight.run(30.0, **{asked: False}).state is State.SILENT


def test_a_worse_event_while_asking_asks_for_more_and_has_its_own_two_seconds() -> None:
    flight = flying().run(1.5, hold_asked=True).step(land_asked=True)
    assert flight.action is Action.ASK_LAND
    assert flight.events[:2] == [Event.HOLD_ASKED, Event.LAND_ASKED]
    assert flight.run(2.0 - STEP_S, land_asked=False).action is Action.ASK_LAND
    assert flight.step().state is State.SILENT


def test_when_stopped_it_stands_still_until_hold_is_confirmed() -> None:
    flight = flying().step(shutdown_asked=True)
    assert flight.action is Action.ASK_HOLD
    flight.run(0.5).step(flight_mode="hold")
    assert (flight.state, flight.events[0]) == (State.SILENT, Event.SHUTDOWN_ASKED)


@pytest.mark.parametrize(
    ("mode", "action"), [("hold", Action.ASK_HOLD), ("return", Action.ASK_RETURN), ("land", Action.ASK_LAND)]
)
def test_low_battery_and_lost_position_are_answered_as_configured(
    mode: Literal["hold", "return", "land"], action: Action
) -> None:
    assert flying(SafetyParameters(on_battery_low=mode)).step(battery_low=True).action is action
    assert flying(SafetyParameters(on_position_lost=mode)).step(position_lost=True).action is action


def test_return_is_worse_than_hold_and_land_is_worse_than_return() -> None:
    returns = SafetyParameters(on_battery_low="return", on_position_lost="land")
    flight = flying(returns).step(hold_asked=True)
    assert flight.action is Action.ASK_HOLD
    assert flight.step(battery_low=True).action is Action.ASK_RETURN
    assert flight.step(position_lost=True).action is Action.ASK_LAND


@pytest.mark.fault("alone")
def test_alone_it_flies_on_for_a_while_and_then_holds() -> None:
    flight = flying().step(neighbours_age_s=5.0).run(10.0 - STEP_S)
    assert (flight.action, flight.events) == (Action.FLY, [Event.NEIGHBOURS_LOST])
    flight.step()
    assert (flight.action, flight.events) == (Action.ASK_HOLD, [Event.NEIGHBOURS_LOST])


def test_a_neighbour_seen_again_is_a_new_while() -> None:
    flight = flying().run(9.0, neighbours_age_s=5.0).step(neighbours_age_s=0.1).run(9.0, neighbours_age_s=5.0)
    assert flight.action is Action.FLY


def test_being_alone_counts_from_the_beginning_of_the_flight() -> None:
    flight = ready().run(60.0, neighbours_age_s=NEVER).step(flight_mode=OFFBOARD)
    assert flight.run(10.0 - STEP_S).action is Action.FLY
    assert flight.step().action is Action.ASK_HOLD


def test_a_drone_configured_to_fly_alone_does_so_for_ever() -> None:
    flight = flying(SafetyParameters(alone_s=None)).run(120.0, neighbours_age_s=NEVER)
    assert flight.action is Action.FLY


@pytest.mark.fault("fence-left")
@pytest.mark.parametrize("limit", ["outside_fence", "outside_heights"])
def test_outside_its_limits_it_has_three_seconds_to_come_back(limit: str) -> None:
    flight = flying()
    assert flight.run(3.0, **{limit: True}).action is Action.FLY_DEGRADED
    assert flight.run(3.0, **{limit: False}).action is Action.FLY
    assert flight.step(**{limit: True}).run(3.0 - STEP_S).action is Action.FLY_DEGRADED
    assert flight.step().action is Action.ASK_HOLD


def test_in_too_strong_gusts_among_obstacles_hold_is_asked_for_where_there_is_room() -> None:
    flight = flying().run(20.0, velocity_error_m_s=0.9, obstacle_near=True)
    assert flight.action is Action.FLY_DEGRADED
    assert "flies on to where no obstacle is within 2 m" in flight.sentence(Event.NO_ROOM_TO_HOLD)
    assert flight.step(obstacle_near=False).action is Action.ASK_HOLD
    assert flight.run(1.0, obstacle_near=True).action is Action.ASK_HOLD


def test_where_no_room_is_found_hold_is_asked_for_after_half_a_minute() -> None:
    flight = flying().step(velocity_error_m_s=0.9, obstacle_near=True).run(30.0 - STEP_S)
    assert flight.action is Action.FLY_DEGRADED
    assert flight.step().action is Action.ASK_HOLD


@pytest.mark.parametrize("obstacle_near", [False, True])
def test_being_off_the_own_setpoints_while_anothers_are_followed_is_no_wind(obstacle_near: bool) -> None:
    foreign = {"foreign_setpoints": "3 m/s north", "velocity_error_m_s": 3.0, "obstacle_near": obstacle_near}
    flight = flying().step(**foreign)
    assert flight.action is Action.FLY_DEGRADED
    assert flight.run(0.5, **foreign).action is Action.ASK_HOLD
    assert flight.events == [Event.FOREIGN_SETPOINTS]


def test_an_obstacle_near_alone_is_no_reason() -> None:
    assert flying().run(60.0, obstacle_near=True).action is Action.FLY


def test_a_degraded_drone_is_well_again_two_seconds_after_the_last_fault() -> None:
    flight = flying().run(5.0, network_faults=1)
    assert flight.state is State.DEGRADED
    flight.run(2.0 - STEP_S, network_faults=0).step(network_faults=1)
    assert flight.run(2.0 - STEP_S, network_faults=0).state is State.DEGRADED
    assert flight.step().state is State.NORMAL


def test_other_bounds_on_the_ladder_are_taken_from_the_configuration() -> None:
    parameters = SafetyParameters(hover_s=0.5, recovery_s=0.0, ask_timeout_s=1.0, outside_s=1.0, alone_s=4.0)
    flight = flying(parameters).run(0.5, cameras=NONE_SEE)
    assert (flight.state, flight.action) == (State.HOVER, Action.HOVER)
    flight.step(cameras=ALL_SEE)
    assert (flight.state, flight.action) == (State.NORMAL, Action.FLY)
    flight.step(cameras=NONE_SEE).run(0.5)
    assert (flight.state, flight.action) == (State.ASKING, Action.ASK_HOLD)
    assert flight.run(1.0).state is State.SILENT
    for fault, after_s in (({"outside_fence": True}, 1.0), ({"neighbours_age_s": NEVER}, 4.0)):
        flight = flying(parameters).step(**fault)
        assert flight.run(after_s - STEP_S).state is not State.ASKING
        assert flight.step().action is Action.ASK_HOLD


# What is noticed, and when.


def noticed_with(**changes: Any) -> list[Event]:
    return list(notice(replace(QUIET, **changes), SafetyParameters()))


@pytest.mark.parametrize(
    ("lost", "limit", "event"),
    [
        ((), 1, None),
        (("left",), 1, Event.CAMERA_LOST),
        (("left", "back"), 1, Event.SIGHT_LOST),
        (("left", "back"), 2, Event.CAMERA_LOST),
        (("left",), 0, Event.SIGHT_LOST),
        (("left", "back", "right"), 9, Event.CAMERA_LOST),
        (("left", "back", "right", "front"), 9, Event.SIGHT_LOST),
    ],
)
def test_so_many_cameras_may_be_lost(lost: tuple[str, ...], limit: int, event: Event | None) -> None:
    cameras = ALL_SEE | dict.fromkeys(lost, UNPLUGGED)
    noticed = notice(replace(QUIET, cameras=cameras), SafetyParameters(max_lost_cameras=limit))
    assert list(noticed) == ([event] if event else [])


def test_a_drone_with_one_camera_cannot_lose_it_and_one_without_any_sees_nothing() -> None:
    for cameras in ({"front": UNPLUGGED}, {}):
        assert noticed_with(cameras=cameras) == [Event.SIGHT_LOST]


def test_the_reason_names_the_cameras_and_their_faults() -> None:
    cameras = {
        "front": UNPLUGGED,
        "right": replace(SEES, frozen=True),
        "back": replace(SEES, age_s=0.2),
        "left": replace(SEES, noisy=True),
        "top": SEES,
    }
    sentence = notice(replace(QUIET, cameras=cameras), SafetyParameters())[Event.SIGHT_LOST]
    assert "front unplugged, right frozen, back silent, left noisy" in sentence
    assert "top" not in sentence
    sentence = notice(replace(QUIET, cameras=cameras), SafetyParameters(max_lost_cameras=4))[Event.CAMERA_LOST]
    assert "front unplugged, right frozen, back silent, left noisy" in sentence
    assert "there are none" in notice(replace(QUIET, cameras={}), SafetyParameters())[Event.SIGHT_LOST]


def test_a_camera_is_silent_after_three_of_its_own_frame_periods() -> None:
    def noticed(age_s: float, period_s: float) -> list[Event]:
        camera = replace(SEES, age_s=age_s, period_s=period_s)
        return noticed_with(cameras=ALL_SEE | {"left": camera})

    assert noticed(1.5, 0.5) == []
    assert noticed(1.51, 0.5) == [Event.CAMERA_LOST]
    assert noticed(0.1, 1 / 30) == []
    assert noticed(0.11, 1 / 30) == [Event.CAMERA_LOST]
    assert noticed(NAN, 0.5) == noticed(NEVER, 0.5) == noticed(0.1, NAN) == [Event.CAMERA_LOST]


LIMITS: list[tuple[str, float, float, Event | None, Event]] = [
    # the number, the last good value, the first bad one, and the events of both
    ("dropped_share", 0.2, 0.201, None, Event.FRAMES_DROPPED),
    ("estimate_age_s", 1.5, 1.501, None, Event.ESTIMATE_STALE),
    ("ego_motion_age_s", 0.75, 0.751, None, Event.EGO_MOTION_POOR),
    ("ego_motion_age_s", 2.75, 2.751, Event.EGO_MOTION_POOR, Event.EGO_MOTION_LOST),
    ("network_faults", 0, 1, None, Event.NETWORK_FAULT),
    ("load", 1.0, 1.001, None, Event.OVERLOADED),
    ("load", 2.0, 2.001, Event.OVERLOADED, Event.FAR_OVERLOADED),
    ("temperature_c", 85.0, 85.1, None, Event.HOT),
    ("temperature_c", 95.0, 95.1, Event.HOT, Event.TOO_HOT),
    ("loop_lag_s", 0.2, 0.201, None, Event.LOOP_LATE),
    ("velocity_error_m_s", 0.6, 0.61, None, Event.VELOCITY_OFF),
    ("velocity_error_m_s", 0.8, 0.81, Event.VELOCITY_OFF, Event.VELOCITY_FAR_OFF),
    ("velocity_late_s", 0.0, 0.5, None, Event.VELOCITY_OFF),
    ("velocity_late_s", 0.5, 1.0, Event.VELOCITY_OFF, Event.VELOCITY_FAR_OFF),
    ("neighbours_age_s", 2.0, 2.001, None, Event.NEIGHBOURS_LOST),
    ("nearest_neighbour_m", 1.0, 0.999, None, Event.NEIGHBOUR_CLOSE),
    ("refused_commands", 0, 1, None, Event.COMMAND_REFUSED),
    ("motion_age_s", 0.5, 0.501, None, Event.MOTION_UNKNOWN),
    ("heartbeat_age_s", 3.5, 3.501, None, Event.LINK_LOST),
    ("message_age_s", 2.0, 2.001, None, Event.LINK_LOST),
]


@pytest.mark.parametrize(("number", "good", "bad", "at_good", "at_bad"), LIMITS)
def test_limits_are_where_they_are_said_to_be(
    number: str, good: float, bad: float, at_good: Event | None, at_bad: Event
) -> None:
    assert noticed_with(**{number: good}) == ([at_good] if at_good else [])
    assert noticed_with(**{number: bad}) == [at_bad]


def test_a_number_that_is_not_one_is_bad() -> None:
    numbers = {field.name for field in fields(Inputs) if "float" in str(field.type)}
    assert numbers == {number for number, *_ in LIMITS if isinstance(getattr(QUIET, number), float)}
    worst_of = {number: at_bad for number, _, _, _, at_bad in LIMITS}
    for number in numbers:
        assert noticed_with(**{number: NAN}) == [worst_of[number]]


def test_a_computer_without_a_thermal_zone_is_not_hot() -> None:
    assert noticed_with(temperature_c=None) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dropped_share": 0.25}, "25%"),
        ({"estimate_age_s": 1.6}, "1.6 s"),
        ({"ego_motion_age_s": 1.5}, "no ego-motion estimated for 1.5 s"),
        ({"load": 1.5}, "150%"),
        ({"temperature_c": 90.0}, "90.0 °C"),
        ({"loop_lag_s": 0.25}, "0.25 s"),
        ({"dead_tasks": ("pilot", "camera")}, "pilot, camera"),
        ({"neighbours_age_s": 2.5}, "2.5 s"),
        ({"nearest_neighbour_m": 0.8}, "0.8 m"),
        ({"heartbeat_age_s": 3.6}, "no heartbeat from the autopilot for 3.6 s"),
        ({"message_age_s": 2.1}, "no message from the autopilot for 2.1 s"),
        ({"message_age_s": NEVER}, "no message from the autopilot yet"),
        ({"stream_fault": "the thread was stopped"}, "setpoints ended: the thread was stopped"),
        ({"autopilot_failsafe": True}, "select Hold or Position, and offboard once flockd is ready"),
        ({"foreign_setpoints": "another program sends 3 m/s"}, "another program sends 3 m/s"),
        ({"parameter_fault": "COM_OF_LOSS_T was changed"}, "COM_OF_LOSS_T was changed"),
        ({"flight_mode": "position"}, "position"),
        ({"flight_mode": None}, "not known"),
    ],
)
def test_the_reason_says_how_bad_it_is(changes: dict[str, Any], words: str) -> None:
    (sentence,) = notice(replace(QUIET, **changes), SafetyParameters()).values()
    assert words in sentence


def test_in_waiting_what_keeps_it_from_flying_is_reported_first() -> None:
    flight = ready().step(cameras=ONE_LOST, outside_fence=True, hold_asked=True)
    assert flight.events[0] is Event.HOLD_ASKED
    assert flight.events[1] is Event.FENCE_LEFT
    assert sorted(flight.events[2:]) == [Event.CAMERA_LOST, Event.NOT_OFFBOARD]
