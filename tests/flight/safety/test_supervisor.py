"""The supervisor on a fake clock: every state with every event, and stories of flights that go wrong."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from random import Random
from typing import Any, Literal, NamedTuple, Self

import pytest

from flockd.core.config.safety import SafetyParameters
from flockd.flight.safety import OFFBOARD, Action, CameraHealth, Decision, Event, Inputs, State, Supervisor, link_lost
from flockd.flight.safety.events import notice
from tests.hostile import any_float, hostile
from tests.make import quiet

NAN, NEVER = math.nan, math.inf
STEP_S = 1 / 16
"""Step of the supervisor. A power of two, so that the clock adds up without rounding."""
QUIET = quiet()
ALL_SEE = QUIET.cameras
SEES = ALL_SEE["front"]
UNPLUGGED = replace(SEES, fault="unplugged")
ONE_LOST = {**ALL_SEE, "back": UNPLUGGED}
NONE_SEE = dict.fromkeys(ALL_SEE, UNPLUGGED)
STATE_OF = {
    Action.FLY: State.NORMAL, Action.FLY_DEGRADED: State.DEGRADED, Action.HOVER: State.HOVER,
    Action.ASK_HOLD: State.ASKING, Action.ASK_RETURN: State.ASKING, Action.ASK_LAND: State.ASKING,
    Action.SILENCE: State.SILENT, Action.OFFER: State.READY,
}  # fmt: skip
"""And idle is silent too."""
LADDER: list[Action] = [action for action in STATE_OF if action is not Action.OFFER]
"""From the top down."""


class Flight:
    """A supervisor, its clock, and what it is told."""

    def __init__(self, parameters: SafetyParameters | None = None, now_s: float = 1000.0) -> None:
        self.supervisor = Supervisor(parameters or SafetyParameters())
        self.now_s, self.inputs = now_s, QUIET
        self.decision = Decision(State.IDLE, Action.SILENCE, ())

    def step(self, **changes: Any) -> Self:
        """One step; from it on, this is different."""
        return self.run(STEP_S, **changes)

    def run(self, duration_s: float, **changes: Any) -> Self:
        """Steps for as long as that, a multiple of a step."""
        self.inputs = replace(self.inputs, **changes)
        steps = duration_s / STEP_S
        assert steps.is_integer()
        for _ in range(int(steps)):
            self.now_s += STEP_S
            self.decision = self.supervisor.step(self.now_s, self.inputs)
            idle = self.decision[:2] == (State.IDLE, Action.SILENCE)
            assert idle or self.decision.state is STATE_OF[self.decision.action]
        return self

    def then(self, what: State | Action, *events: Event) -> Self:
        """Holds what was decided in the last step against this state or action, and against these events, if any."""
        assert (self.decision.state if isinstance(what, State) else self.decision.action) is what
        assert not events or tuple(self.events) == events
        return self

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
    return on_the_ground(parameters).step(armed=True).step(in_air=True).then(Action.OFFER)


def flying(parameters: SafetyParameters | None = None) -> Flight:
    """The pilot has switched to offboard."""
    return ready(parameters).step(flight_mode=OFFBOARD).then(Action.FLY)


class Fault(NamedTuple):
    """One row of what is promised: how a fault shows, and what it means before the flight and in it."""

    changes: dict[str, Any]
    before: Literal["ready", "wait", "latch"]
    action: Action

    @property
    def undone(self) -> dict[str, Any]:
        return {key: getattr(QUIET, key) for key in self.changes}


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
    Event.TASK_DIED: Fault({"dead_tasks": ("pilot", "camera")}, "wait", Action.ASK_HOLD),
    Event.NEIGHBOURS_LOST: Fault({"neighbours_age_s": 2.5}, "ready", Action.FLY),
    Event.NEIGHBOUR_CLOSE: Fault({"nearest_neighbour_m": 0.8}, "ready", Action.FLY),
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
    Event.MISSION_LANDS: Fault({"takeover": "land"}, "ready", Action.ASK_LAND),
    Event.MISSION_RETURNS: Fault({"takeover": "return"}, "ready", Action.ASK_RETURN),
}
"""faults.md, fault by fault."""


def worst(*actions: Action) -> Action:
    return max(actions, key=LADDER.index)


EVENTS = pytest.mark.parametrize("event", FAULTS, ids=str)


def test_every_event_that_inputs_can_show_is_in_the_table() -> None:
    assert FAULTS.keys() == set(Event) - {Event.STARTED, Event.NO_ANSWER}
    assert notice(QUIET, SafetyParameters()) == {}


# Every state with every event.


SHOWN = {
    Event.FRAMES_DROPPED: "25%", Event.ESTIMATE_STALE: "1.6 s", Event.EGO_MOTION_POOR: "1.5 s",
    Event.OVERLOADED: "150%", Event.HOT: "90.0 °C", Event.LOOP_LATE: "0.30 s", Event.TASK_DIED: "pilot, camera",
    Event.NEIGHBOURS_LOST: "2.5 s", Event.NEIGHBOUR_CLOSE: "0.8 m", Event.LINK_LOST: "3.6 s",
    Event.STREAM_ENDED: "the thread was stopped", Event.AUTOPILOT_FAILSAFE: "select Hold or Position",
    Event.FOREIGN_SETPOINTS: "3 m/s north", Event.PARAMETERS_UNSUITABLE: "COM_OF_LOSS_T is 20",
    Event.NOT_OFFBOARD: "position",
}  # fmt: skip
"""What of the inputs above is in the sentence."""


@EVENTS
def test_each_fault_shows_as_its_own_event_and_as_no_other_and_says_how_bad_it_is(event: Event) -> None:
    ((noticed, sentence),) = notice(quiet(**FAULTS[event].changes), SafetyParameters()).items()
    assert noticed is event
    assert sentence
    assert SHOWN.get(event, "") in sentence


@EVENTS
def test_idle_stays_idle_and_silent_and_is_ready_afterwards_unless_latched(event: Event) -> None:
    flight = on_the_ground().step(armed=True).then(State.IDLE)
    flight.step(**{"flight_mode": "hold", **FAULTS[event].changes}).then(State.IDLE)
    assert event in flight.events
    flight.step(**FAULTS[event].undone).step(in_air=True, armed=True, flight_mode="hold")
    latched = FAULTS[event].before == "latch"
    flight.then(State.IDLE if latched else State.READY)
    assert (event in flight.events) == (latched or event is Event.NOT_OFFBOARD)


@EVENTS
def test_ready_offers_standstill_only_while_it_may_fly(event: Event) -> None:
    flight = ready().step(**FAULTS[event].changes)
    flight.then(State.READY if FAULTS[event].before == "ready" else State.IDLE)
    assert event in flight.events
    if event is not Event.NOT_OFFBOARD:
        flight.step(**FAULTS[event].undone, flight_mode="hold")
        flight.then(State.IDLE if FAULTS[event].before == "latch" else State.READY)


@EVENTS
def test_a_flight_begins_only_if_nothing_is_in_its_way(event: Event) -> None:
    flight = ready().step(**{"flight_mode": OFFBOARD, **FAULTS[event].changes})
    begins: State | Action = FAULTS[event].action if FAULTS[event].before == "ready" else State.IDLE
    flight.then(State.READY if event is Event.NOT_OFFBOARD else begins)


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
    flight.then(before).step(**FAULTS[event].changes).then(worst(before, FAULTS[event].action))
    if before is Action.FLY:
        assert event in flight.events
    elif before is Action.ASK_HOLD:
        assert flight.events[0] is Event.HOLD_ASKED


@EVENTS
def test_silent_stays_silent_whatever_happens_and_afterwards(event: Event) -> None:
    flight = flying().step(flight_mode="position").step(**FAULTS[event].changes).then(State.SILENT)
    flight.step(**FAULTS[event].undone).step(flight_mode=OFFBOARD).then(State.SILENT)
    assert flight.events[0] is Event.NOT_OFFBOARD


CAUSE_AND_EFFECT = (
    {Event.LINK_LOST, Event.STREAM_ENDED},
    {Event.FOREIGN_SETPOINTS, Event.VELOCITY_FAR_OFF},
    {Event.FOREIGN_SETPOINTS, Event.NO_ROOM_TO_HOLD},
)
"""Told by its cause alone."""


@EVENTS
def test_of_two_events_the_worse_wins_and_is_reported_first(event: Event) -> None:
    for other, fault in FAULTS.items():
        if fault.changes.keys() & FAULTS[event].changes.keys() or {event, other} in CAUSE_AND_EFFECT:
            continue
        expected = worst(fault.action, FAULTS[event].action)
        flight = flying().step(**FAULTS[event].changes, **fault.changes).then(expected)
        assert FAULTS[flight.events[0]].action is expected
        assert sorted(flight.events) == sorted({event, other})


# Stories.


def test_the_pilot_brings_it_up_and_switches_to_offboard() -> None:
    flight = Flight().step(armed=None, in_air=None, flight_mode=None, heartbeat_age_s=NEVER, estimate_age_s=NEVER)
    assert flight.then(State.IDLE).events[0] is Event.STARTED
    assert flight.sentence(Event.NOT_OFFBOARD).endswith("not known")
    flight.step(armed=False, in_air=False, flight_mode="hold", heartbeat_age_s=0.2).then(State.IDLE)
    assert Event.STARTED not in flight.events
    flight.step(estimate_age_s=0.4).step(armed=True, flight_mode="take-off").then(State.IDLE)
    flight.step(in_air=True).then(State.READY).run(30.0, flight_mode="hold").then(State.READY, Event.NOT_OFFBOARD)
    assert not flight.step(flight_mode=OFFBOARD).then(State.NORMAL).events


def test_restarted_in_the_air_it_comes_up_idle_although_offboard_is_still_on() -> None:
    flight = Flight().run(20.0).then(State.IDLE).step(flight_mode="hold").run(5.0).step(flight_mode=OFFBOARD)
    flight.run(5.0).then(State.IDLE, Event.STARTED)


def test_an_operator_resumes_after_a_restart_in_the_air_and_the_pilot_switches() -> None:
    flight = Flight().step(flight_mode="hold").step(resume_asked=True).step(resume_asked=False).then(State.READY)
    flight.step(flight_mode=OFFBOARD).then(Action.FLY)


@pytest.mark.parametrize(
    ("armed", "in_air"), [(None, None), (None, False), (False, None), (False, True), (True, False), (True, None)]
)
def test_only_a_vehicle_known_to_be_disarmed_and_on_the_ground_makes_a_new_start(
    armed: bool | None, in_air: bool | None
) -> None:
    Flight().step(armed=armed, in_air=in_air).step(armed=True, in_air=True).then(State.IDLE)


def test_what_was_true_before_the_link_was_lost_makes_no_new_start() -> None:
    flight = Flight().step(armed=False, in_air=False, heartbeat_age_s=4.0).step(armed=True, in_air=True)
    flight.step(heartbeat_age_s=0.1).then(State.IDLE)


def test_the_pilot_takes_over_and_it_never_comes_back_by_itself() -> None:
    flight = flying().run(10.0).step(flight_mode="position").then(State.SILENT)
    assert flight.sentence(Event.NOT_OFFBOARD).endswith("position")
    flight.step(flight_mode=OFFBOARD).then(State.SILENT)
    flight.run(60.0, flight_mode="position").run(60.0, flight_mode=OFFBOARD).then(State.SILENT, Event.NOT_OFFBOARD)


def test_what_was_mild_when_the_pilot_took_over_is_not_reported_as_a_reason_for_it() -> None:
    flight = flying().step(cameras=ONE_LOST, flight_mode="position").step(cameras=ALL_SEE)
    flight.then(State.SILENT, Event.NOT_OFFBOARD)


def test_after_landing_and_disarming_a_new_flight_may_begin_and_asks_anew() -> None:
    flight = flying().step(land_asked=True).step(land_asked=False, flight_mode="land").step(in_air=False)
    flight.then(State.SILENT).step(armed=False).then(State.IDLE)
    flight.step(armed=True).step(in_air=True, flight_mode="hold").then(Action.OFFER)
    flight.step(flight_mode=OFFBOARD).then(Action.FLY).step(hold_asked=True).then(Action.ASK_HOLD)


def test_link_lost_and_regained_does_not_restart_offboard_by_itself() -> None:
    flight = flying().run(5.0).run(1.5, heartbeat_age_s=3.4).then(State.NORMAL)
    flight.step(heartbeat_age_s=3.6).then(State.SILENT)
    flight.run(30.0, heartbeat_age_s=0.2).then(State.SILENT, Event.LINK_LOST)
    flight.step(flight_mode="hold").run(5.0, flight_mode=OFFBOARD).then(Action.SILENCE)


@pytest.mark.fault("own-stall")
def test_flockds_own_stall_is_told_before_the_mode_that_followed_from_it() -> None:
    flight = flying().step(stream_fault="the thread was stopped", flight_mode="hold").step(stream_fault=None)
    flight.then(State.SILENT, Event.STREAM_ENDED, Event.NOT_OFFBOARD)
    assert "the thread was stopped" in flight.sentence(Event.STREAM_ENDED)


def test_a_stream_that_ended_with_the_link_is_told_once() -> None:
    flying().step(stream_fault="no heartbeat", heartbeat_age_s=3.6).then(State.SILENT, Event.LINK_LOST)


def test_after_the_autopilots_failsafe_it_is_ready_when_the_pilot_has_selected_another_mode() -> None:
    flight = flying().step(flight_mode="hold", autopilot_failsafe=True).step(resume_asked=True).step(resume_asked=False)
    assert flight.then(State.IDLE).events[0] is Event.AUTOPILOT_FAILSAFE
    flight.step(autopilot_failsafe=False).then(State.READY)


@pytest.mark.parametrize("what", ["foreign_setpoints", "parameter_fault"])
def test_somebody_who_interferes_for_half_a_second_makes_it_ask_for_hold(what: str) -> None:
    flight = flying().run(0.4375, **{what: "seen"}).then(Action.FLY_DEGRADED)
    flight.run(0.1875).then(Action.ASK_HOLD)


def test_link_lost_while_ready_needs_a_new_start_too() -> None:
    flight = ready().step(heartbeat_age_s=3.6).step(heartbeat_age_s=0.2).then(State.IDLE)
    flight.step(resume_asked=True).then(State.READY)


def test_resume_does_not_help_while_the_link_is_lost_nor_in_flight() -> None:
    flight = flying().step(heartbeat_age_s=4.0).step(resume_asked=True).step(resume_asked=False)
    flight.step(heartbeat_age_s=0.2).then(State.SILENT)
    flying().step(cameras=NONE_SEE).step(resume_asked=True).then(State.HOVER)


def test_a_glimpse_lost_for_half_a_second_is_a_hover_and_a_slow_while() -> None:
    flight = flying().run(0.5, cameras=NONE_SEE).then(State.HOVER).step(cameras=ALL_SEE).then(State.DEGRADED)
    assert not flight.events
    flight.run(2.0 - 2 * STEP_S).then(State.DEGRADED).step().then(State.NORMAL)


def test_cameras_unplugged_hover_at_most_a_second_then_hold_then_silence() -> None:
    flight = flying().run(1.0, cameras=NONE_SEE).then(State.HOVER).step().then(Action.ASK_HOLD)
    flight.run(0.5).then(Action.ASK_HOLD).step(flight_mode="hold").then(State.SILENT)
    assert flight.events[:2] == [Event.SIGHT_LOST, Event.NOT_OFFBOARD]


def test_cameras_plugged_in_again_do_not_bring_it_back_after_hold_was_asked() -> None:
    flight = flying().run(1.5, cameras=NONE_SEE).then(State.ASKING)
    flight.step(cameras=ALL_SEE).then(Action.ASK_HOLD, Event.SIGHT_LOST)
    flight.step(flight_mode="hold").run(10.0).run(10.0, flight_mode=OFFBOARD).then(State.SILENT)


def test_a_loose_plug_does_not_make_it_hover_for_ever() -> None:
    flight = flying().run(0.375, cameras=NONE_SEE).run(0.5, cameras=ALL_SEE)
    flight.run(0.375, cameras=NONE_SEE).run(0.5, cameras=ALL_SEE).then(State.DEGRADED)
    flight.run(0.25, cameras=NONE_SEE).then(State.HOVER)
    flight.step().then(Action.ASK_HOLD)  # 0.375 + 0.375 + 0.25 s of hovering


def test_after_a_while_of_flying_as_usual_it_may_hover_a_whole_second_again() -> None:
    flight = flying().run(0.875, cameras=NONE_SEE).run(3.0, cameras=ALL_SEE).then(State.NORMAL)
    flight.run(0.875, cameras=NONE_SEE).then(State.HOVER)


def test_every_flight_has_its_own_second_of_hovering_also_one_that_begins_degraded() -> None:
    flight = flying().run(0.875, cameras=NONE_SEE).step(flight_mode="position", cameras=ALL_SEE)
    flight.step(armed=False, in_air=False).step(armed=True, in_air=True, flight_mode="hold")
    flight.step(flight_mode=OFFBOARD).then(State.NORMAL).run(0.875, cameras=NONE_SEE).then(State.HOVER)
    flight = ready().step(cameras=ONE_LOST).step(flight_mode=OFFBOARD).then(State.DEGRADED)
    flight.run(1.0, cameras=NONE_SEE).then(State.HOVER)


def test_it_makes_no_difference_what_the_clock_showed_at_the_start() -> None:
    for now_s in (0.0, 1e6):
        flight = Flight(now_s=now_s).step(armed=False, in_air=False, flight_mode="hold").step(armed=True, in_air=True)
        flight.step(flight_mode=OFFBOARD).then(State.NORMAL)


@pytest.mark.parametrize("asked", ["hold_asked", "land_asked", "shutdown_asked"])
def test_an_autopilot_that_does_not_reply_is_left_to_its_failsafe_after_two_seconds(asked: str) -> None:
    flight = flying().run(2.0, **{asked: True}).then(State.ASKING).step().then(State.SILENT)
    assert Event.NO_ANSWER in flight.events
    flight.run(30.0, **{asked: False}).then(State.SILENT)


def test_a_worse_event_while_asking_asks_for_more_and_has_its_own_two_seconds() -> None:
    flight = flying().run(1.5, hold_asked=True).step(land_asked=True).then(Action.ASK_LAND)
    assert flight.events[:2] == [Event.HOLD_ASKED, Event.LAND_ASKED]
    flight.run(2.0 - STEP_S, land_asked=False).then(Action.ASK_LAND).step().then(State.SILENT)


def test_when_stopped_it_stands_still_until_hold_is_confirmed() -> None:
    flight = flying().step(shutdown_asked=True).then(Action.ASK_HOLD).run(0.5).step(flight_mode="hold")
    assert flight.then(State.SILENT).events[0] is Event.SHUTDOWN_ASKED


@pytest.mark.parametrize(
    ("mode", "action"), [("hold", Action.ASK_HOLD), ("return", Action.ASK_RETURN), ("land", Action.ASK_LAND)]
)
def test_low_battery_and_lost_position_are_answered_as_configured(
    mode: Literal["hold", "return", "land"], action: Action
) -> None:
    flying(SafetyParameters(on_battery_low=mode)).step(battery_low=True).then(action)
    flying(SafetyParameters(on_position_lost=mode)).step(position_lost=True).then(action)


def test_return_is_worse_than_hold_and_land_is_worse_than_return() -> None:
    returns = SafetyParameters(on_battery_low="return", on_position_lost="land")
    flight = flying(returns).step(hold_asked=True).then(Action.ASK_HOLD)
    flight.step(battery_low=True).then(Action.ASK_RETURN).step(position_lost=True).then(Action.ASK_LAND)


@pytest.mark.fault("alone")
def test_alone_it_flies_on_for_a_while_and_then_holds() -> None:
    flight = flying().run(10.0, neighbours_age_s=5.0).then(Action.FLY, Event.NEIGHBOURS_LOST)
    flight.step().then(Action.ASK_HOLD, Event.NEIGHBOURS_LOST)


def test_being_alone_counts_from_the_beginning_of_the_flight_and_anew_after_each_neighbour() -> None:
    flight = ready().run(60.0, neighbours_age_s=NEVER).step(flight_mode=OFFBOARD).run(10.0 - STEP_S).then(Action.FLY)
    flight.step().then(Action.ASK_HOLD)
    flight = flying().run(9.0, neighbours_age_s=5.0).step(neighbours_age_s=0.1).run(9.0, neighbours_age_s=5.0)
    flight.then(Action.FLY)


def test_a_drone_configured_to_fly_alone_does_so_for_ever() -> None:
    flying(SafetyParameters(alone_s=None)).run(120.0, neighbours_age_s=NEVER).then(Action.FLY)


@pytest.mark.fault("fence-left")
@pytest.mark.parametrize("limit", ["outside_fence", "outside_heights"])
def test_outside_its_limits_it_has_three_seconds_to_come_back(limit: str) -> None:
    flight = flying().run(3.0, **{limit: True}).then(Action.FLY_DEGRADED).run(3.0, **{limit: False}).then(Action.FLY)
    flight.run(3.0, **{limit: True}).then(Action.FLY_DEGRADED).step().then(Action.ASK_HOLD)


def test_in_too_strong_gusts_among_obstacles_hold_is_asked_for_where_there_is_room_or_after_half_a_minute() -> None:
    flight = flying().run(20.0, velocity_error_m_s=0.9, obstacle_near=True).then(Action.FLY_DEGRADED)
    assert "no obstacle is within 2 m" in flight.sentence(Event.NO_ROOM_TO_HOLD)
    flight.step(obstacle_near=False).then(Action.ASK_HOLD).run(1.0, obstacle_near=True).then(Action.ASK_HOLD)
    flight = flying().run(30.0, velocity_error_m_s=0.9, obstacle_near=True).then(Action.FLY_DEGRADED)
    flight.step().then(Action.ASK_HOLD)
    flying().run(60.0, obstacle_near=True).then(Action.FLY)


@pytest.mark.parametrize("obstacle_near", [False, True])
def test_being_off_the_own_setpoints_while_anothers_are_followed_is_no_wind(obstacle_near: bool) -> None:
    foreign = {"foreign_setpoints": "3 m/s north", "velocity_error_m_s": 3.0, "obstacle_near": obstacle_near}
    flight = flying().step(**foreign).then(Action.FLY_DEGRADED)
    flight.run(0.5, **foreign).then(Action.ASK_HOLD, Event.FOREIGN_SETPOINTS)


def test_a_degraded_drone_is_well_again_two_seconds_after_the_last_fault() -> None:
    flight = flying().run(5.0, network_faults=1).then(State.DEGRADED)
    flight.run(2.0 - STEP_S, network_faults=0).step(network_faults=1)
    flight.run(2.0 - STEP_S, network_faults=0).then(State.DEGRADED).step().then(State.NORMAL)


def test_other_bounds_on_the_ladder_are_taken_from_the_configuration() -> None:
    parameters = SafetyParameters(hover_s=0.5, recovery_s=0.0, ask_timeout_s=1.0, outside_s=1.0, alone_s=4.0)
    flight = flying(parameters).run(0.5, cameras=NONE_SEE).then(State.HOVER).step(cameras=ALL_SEE).then(State.NORMAL)
    flight.run(0.5 + STEP_S, cameras=NONE_SEE).then(Action.ASK_HOLD).run(1.0).then(State.SILENT)
    for fault, after_s in (({"outside_fence": True}, 1.0), ({"neighbours_age_s": NEVER}, 4.0)):
        flight = flying(parameters).run(after_s, **fault)
        assert flight.decision.state is not State.ASKING
        flight.step().then(Action.ASK_HOLD)


# What is noticed, and when.


def noticed_with(parameters: SafetyParameters | None = None, /, **changes: Any) -> list[Event]:
    return list(notice(quiet(**changes), parameters or SafetyParameters()))


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
    cameras = {**ALL_SEE, **dict.fromkeys(lost, UNPLUGGED)}
    assert noticed_with(SafetyParameters(max_lost_cameras=limit), cameras=cameras) == ([event] if event else [])


def test_the_reason_names_the_cameras_and_their_faults_and_without_any_nothing_is_seen() -> None:
    cameras = {
        "front": UNPLUGGED,
        "right": replace(SEES, fault="frozen"),
        "back": replace(SEES, age_s=0.2),
        "left": replace(SEES, fault="noisy"),
        "top": SEES,
    }
    for event, limit in ((Event.SIGHT_LOST, 1), (Event.CAMERA_LOST, 4)):
        sentence = notice(quiet(cameras=cameras), SafetyParameters(max_lost_cameras=limit))[event]
        assert "front unplugged, right frozen, back silent, left noisy" in sentence
        assert "top" not in sentence
    assert noticed_with(cameras={"front": UNPLUGGED}) == noticed_with(cameras={}) == [Event.SIGHT_LOST]


@pytest.mark.parametrize(
    ("age_s", "period_s", "silent"),
    [(1.5, 0.5, False), (1.51, 0.5, True), (0.1, 1 / 30, False), (0.11, 1 / 30, True), (NAN, 0.5, True),
     (NEVER, 0.5, True), (0.1, NAN, True)],
)  # fmt: skip
def test_a_camera_is_silent_after_three_of_its_own_frame_periods(age_s: float, period_s: float, silent: bool) -> None:
    camera = replace(SEES, age_s=age_s, period_s=period_s)
    assert noticed_with(cameras={**ALL_SEE, "left": camera}) == [Event.CAMERA_LOST] * silent


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
    assert noticed_with(temperature_c=None) == [], "of a computer without a thermal zone"


def test_a_link_that_was_never_there_and_a_lost_one_are_told_apart() -> None:
    for age_s, words in ((2.1, "2.1 s"), (NEVER, "yet")):
        assert notice(quiet(message_age_s=age_s), SafetyParameters())[Event.LINK_LOST].endswith(words)


def test_in_waiting_what_keeps_it_from_flying_is_reported_first() -> None:
    flight = ready().step(cameras=ONE_LOST, outside_fence=True, hold_asked=True)
    assert flight.events[:2] == [Event.HOLD_ASKED, Event.FENCE_LEFT]
    assert sorted(flight.events[2:]) == [Event.CAMERA_LOST, Event.NOT_OFFBOARD]


# Whatever the inputs are.

_OF_KIND = {kind: [field.name for field in fields(Inputs) if field.type == kind] for kind in ("float", "bool", "int")}
_SEEN = ("stream_fault", "foreign_setpoints", "parameter_fault")
"""What was seen, in words; None: nothing."""


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest overflow
def test_hostile_inputs_never_make_it_fly_without_the_pilot_a_link_and_an_estimate() -> None:
    parameters = SafetyParameters()

    @hostile(40)
    def check(random: Random) -> None:
        supervisor, now_s, inputs = Supervisor(parameters), 1000.0, QUIET
        for _ in range(random.randrange(1, 40)):
            now_s += random.choice((0.0, 0.05, 0.1, 1.0, 5.0))
            inputs = replace(inputs if random.random() < 0.7 else QUIET, **_changes(random))
            decision = supervisor.step(now_s, inputs)
            if decision.action in (Action.FLY, Action.FLY_DEGRADED):
                assert inputs.flight_mode == OFFBOARD, "flies although the pilot does"
                assert inputs.armed, "flies although it is not armed"
                assert link_lost(inputs.heartbeat_age_s, inputs.message_age_s, parameters) is None, "without a link"
                assert inputs.estimate_age_s <= parameters.estimate_timeout_s, "flies blindly"
                assert not (inputs.shutdown_asked or inputs.hold_asked or inputs.land_asked), "flies on"
            if decision.action is not Action.SILENCE and decision.state is not State.READY:
                assert inputs.flight_mode == OFFBOARD, "sends although the pilot flies"
            assert all(reason.sentence for reason in decision.reasons)

    check()


def _changes(random: Random) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for _ in range(random.choice((0, 0, 1, 2, 5))):
        match random.randrange(8):
            case 0:
                changes[random.choice(_OF_KIND["float"])] = any_float(random)
            case 1:
                changes[random.choice(_OF_KIND["bool"])] = True
            case 2:
                changes[random.choice(_OF_KIND["int"])] = random.choice((0, 1, 2, 6, 10**9))
            case 3:
                changes |= {"armed": random.choice((True, False, None)), "in_air": random.choice((True, False, None))}
            case 4:
                changes["flight_mode"] = random.choice((OFFBOARD, "hold", "", None))
            case 5:
                one = CameraHealth(any_float(random), any_float(random), random.choice(("frozen", "noisy", None)))
                changes["cameras"] = {} if random.random() < 0.1 else {"front": one, "back": one}
            case 6:
                changes |= {"armed": False, "in_air": False, "resume_asked": random.random() < 0.5}
            case 7:
                changes[random.choice(_SEEN)] = random.choice(("seen", None))
    return changes


def test_one_task_that_died_is_enough() -> None:
    assert noticed_with(dead_tasks=("telemetry",)) == [Event.TASK_DIED]


def test_a_late_answer_is_said_where_there_is_one() -> None:
    late = notice(quiet(velocity_late_s=0.5), SafetyParameters())[Event.VELOCITY_OFF]
    off = notice(quiet(velocity_error_m_s=0.7), SafetyParameters())[Event.VELOCITY_OFF]
    assert ("0.5 s later than expected" in late, "later" in off) == (True, False)
