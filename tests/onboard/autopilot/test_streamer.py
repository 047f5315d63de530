"""When setpoints are sent and when not, told on a fake clock with a fake autopilot."""

from __future__ import annotations

import math
import re
import time
from dataclasses import replace

import numpy as np
import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.safety import SafetyParameters
from flockd.core.messages import Setpoint
from flockd.flight.safety import Request, Verdict
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.streamer import SetpointStreamer
from tests.make import autopilot_status
from tests.onboard.autopilot.flight import NORTH, let_pass, request_of

PERIOD_S = 0.05

HOVERING = autopilot_status()


class Story:
    """A streamer that is stepped by hand every 50 ms, and what it sent."""

    def __init__(self) -> None:
        self.now = 100.0
        self.status = HOVERING
        self.sent: list[tuple[float, Setpoint]] = []
        self.gate_says: Setpoint | str | None = "pass"
        self.cable_is_in = True
        self.streamer = SetpointStreamer(
            self._send,
            lambda: self.status,
            self._gate,
            AutopilotParameters(),
            SafetyParameters(),
            clock=lambda: self.now,
        )

    def _gate(self, now_s: float, request: Request) -> Verdict:
        return let_pass(now_s, request) if isinstance(self.gate_says, str) else Verdict(self.gate_says, ())

    def _send(self, setpoint: Setpoint) -> None:
        if not self.cable_is_in:
            raise AutopilotError("the cable is out")
        self.sent.append((self.now, setpoint))

    def go_on(self, duration_s: float, *, beating: bool = True, deciding: bool = True) -> int:
        """Lets time pass; how many setpoints were sent in it."""
        before = len(self.sent)
        for _ in range(round(duration_s / PERIOD_S)):
            self.now += PERIOD_S
            if deciding:
                self.streamer.offer(request_of(NORTH, self.now))
            if beating:
                self.streamer.beat()
            self.streamer.step()
        return len(self.sent) - before

    def autopilot(self, **changes: object) -> None:
        self.status = replace(self.status, **changes)  # type: ignore[arg-type]

    @property
    def silence(self) -> str | None:
        return self.streamer.report().silence


@pytest.fixture
def story() -> Story:
    return Story()


@pytest.fixture
def in_offboard(story: Story) -> Story:
    story.streamer.begin()
    assert story.go_on(1.0) == 20
    story.autopilot(flight_mode="offboard")
    assert story.go_on(1.0) == 20
    return story


def test_nothing_is_sent_before_it_is_begun(story: Story) -> None:
    assert story.go_on(1.0) == 0
    assert story.silence == "not begun"


def test_setpoints_flow_before_the_pilot_switches_to_offboard_whatever_the_mode_is(story: Story) -> None:
    story.streamer.begin()
    assert story.go_on(1.0) == 20
    story.autopilot(flight_mode="position")
    assert story.go_on(1.0) == 20
    assert not story.streamer.report().offboard


@pytest.mark.parametrize(("lacks", "within_s"), [("beating", 0.3), ("deciding", 1.0)])
def test_a_control_loop_that_is_dead_or_decides_nothing_any_more_is_silence(
    in_offboard: Story, lacks: str, within_s: float
) -> None:
    stopped_s = in_offboard.now
    in_offboard.go_on(3.0, **{lacks: False})
    assert in_offboard.sent[-1][0] - stopped_s <= within_s


def test_a_setpoint_from_the_future_or_with_no_date_is_not_sent(story: Story) -> None:
    story.streamer.begin()
    for date in (story.now + 60.0, math.nan):
        story.streamer.offer(request_of(NORTH, date))
        assert story.go_on(0.5, deciding=False) == 0
        assert story.silence is not None and "not fresh" in story.silence


def test_a_setpoint_from_before_the_beginning_is_not_sent(story: Story) -> None:
    story.go_on(0.2)
    story.streamer.begin()
    assert story.go_on(0.2, deciding=False) == 0


def test_a_short_stumble_of_the_loop_is_forgiven(in_offboard: Story) -> None:
    in_offboard.go_on(0.5, beating=False)
    assert in_offboard.go_on(1.0) == 20


@pytest.mark.fault("computer-stalls")
def test_after_a_long_one_nothing_brings_the_stream_back_but_a_new_beginning(in_offboard: Story) -> None:
    in_offboard.go_on(1.5, beating=False)
    assert in_offboard.go_on(5.0) == 0
    assert in_offboard.silence is not None and "loop is late, for more than 0.5 s" in in_offboard.silence
    in_offboard.streamer.begin()
    assert in_offboard.go_on(1.0) == 20


def test_a_process_that_was_stopped_between_two_deadlines_does_not_go_on_where_it_was(in_offboard: Story) -> None:
    in_offboard.now += 0.7
    assert in_offboard.go_on(1.0) == 0
    assert in_offboard.silence is not None and "stopped, for more than 0.5 s" in in_offboard.silence


def test_a_gap_before_offboard_ends_nothing(story: Story) -> None:
    story.streamer.begin()
    story.go_on(3.0, beating=False)
    assert story.go_on(1.0) == 20


@pytest.mark.parametrize("mode", ["position", "hold", "return", "land", "manual", "other"])
def test_when_the_pilot_takes_over_it_is_silent_at_once_and_for_good(in_offboard: Story, mode: str) -> None:
    in_offboard.autopilot(flight_mode=mode)
    assert in_offboard.go_on(1.0) == 0
    assert in_offboard.silence is not None and in_offboard.silence.endswith(f"left offboard for {mode}")
    assert in_offboard.streamer.report().fault is None
    in_offboard.autopilot(flight_mode="offboard")
    assert in_offboard.go_on(1.0) == 0
    in_offboard.streamer.begin()
    assert in_offboard.go_on(1.0) == 20


@pytest.mark.parametrize(("cut_s", "goes_on"), [(0.45, True), (0.55, False), (1.5, False)])
def test_a_cut_of_the_link_that_may_outlast_the_autopilots_failsafe_is_silence_for_good(
    in_offboard: Story, cut_s: float, goes_on: bool
) -> None:
    """PX4 fails over after COM_OF_LOSS_T, and comes back to offboard at the first setpoint: it did after 1.2 s."""
    began_s = in_offboard.now
    for _ in range(round(cut_s / PERIOD_S)):
        in_offboard.autopilot(message_age_s=in_offboard.now + PERIOD_S - began_s)
        in_offboard.go_on(PERIOD_S)
    in_offboard.autopilot(message_age_s=0.02)
    assert in_offboard.go_on(2.0) == (40 if goes_on else 0)
    assert (in_offboard.silence is None) is goes_on
    if not goes_on:
        assert in_offboard.sent[-1][0] <= began_s + 0.5 + 1e-9
        assert "nothing was heard of the autopilot for 0.5 s in offboard" in str(in_offboard.streamer.report().fault)


def test_a_lost_link_is_silence_for_good(in_offboard: Story) -> None:
    in_offboard.autopilot(heartbeat_age_s=3.4)
    assert in_offboard.go_on(1.0) == 20, "two heartbeats may be lost"
    in_offboard.autopilot(heartbeat_age_s=3.6)
    assert in_offboard.go_on(1.0) == 0
    in_offboard.autopilot(heartbeat_age_s=0.1)
    assert in_offboard.go_on(1.0) == 0
    assert in_offboard.silence is not None and re.search(r"heartbeat .* 3\.6 s", in_offboard.silence)
    assert in_offboard.streamer.report().fault == in_offboard.silence
    in_offboard.streamer.begin()
    in_offboard.autopilot(message_age_s=2.1)  # without any message it is lost sooner
    assert in_offboard.go_on(1.0) == 0
    assert in_offboard.silence is not None and re.search(r"message .* 2\.1 s", in_offboard.silence)


@pytest.mark.fault("own-stall")
def test_a_stall_stays_the_cause_though_the_autopilot_has_left_offboard_meanwhile(in_offboard: Story) -> None:
    in_offboard.now += 3.0
    in_offboard.autopilot(flight_mode="hold")
    stalled = "the thread was stopped, for more than 0.5 s in offboard flight"
    assert in_offboard.streamer.report().fault == stalled, "also before its own thread has run"
    assert in_offboard.go_on(1.0) == 0
    assert in_offboard.silence == stalled
    in_offboard.streamer.end("the supervisor is silent")
    assert (in_offboard.silence, in_offboard.streamer.report().fault) == (stalled, None)


def test_a_vehicle_in_its_failsafe_is_left_alone(story: Story) -> None:
    """PX4 would go back to offboard as soon as setpoints come, though nobody asked for it."""
    story.autopilot(failsafe=True)
    story.streamer.begin()
    assert story.go_on(1.0) == 0
    assert story.silence is not None and "failsafe" in story.silence
    story.autopilot(failsafe=False)
    assert story.go_on(1.0) == 20


def test_what_the_gate_makes_of_a_setpoint_is_what_is_sent(story: Story) -> None:
    tamed = Setpoint(0.0, np.array([0.1, 0.0]), 2.0, 0.0)
    story.gate_says = tamed
    story.streamer.begin()
    story.go_on(0.1)
    assert story.sent[-1][1] is tamed


@pytest.mark.parametrize(
    ("change", "told"), [({"gate_says": None}, "the gate refused"), ({"cable_is_in": False}, "the cable is out")]
)
def test_what_is_not_sent_has_its_reason(story: Story, change: dict[str, object], told: str) -> None:
    vars(story).update(change)
    story.streamer.begin()
    assert story.go_on(1.0) == 0
    assert story.silence == told


def test_the_thread_keeps_its_rate_and_ends_when_the_gate_breaks() -> None:
    sent: list[float] = []
    gate_works = True

    def gate(now_s: float, request: Request) -> Verdict:
        if not gate_works:
            raise ZeroDivisionError("a bug")
        return let_pass(now_s, request)

    streamer = SetpointStreamer(
        lambda _: sent.append(time.monotonic()), lambda: HOVERING, gate, AutopilotParameters(), SafetyParameters()
    )

    def offer() -> None:
        streamer.offer(request_of(NORTH, time.monotonic()))
        streamer.beat()
        time.sleep(0.01)

    streamer.start()
    streamer.begin()
    while len(sent) < 20:
        offer()
    passed_s = sent[-1] - sent[0]
    assert passed_s > 18 / 20.0, "never faster than 20 Hz, but for one that was late"
    assert len(sent) - 1 + streamer.report().missed >= round(20.0 * passed_s) - 1, "a deadline missed is counted"
    gate_works = False
    while streamer.report().fault is None:
        offer()
    before = len(sent)
    assert "ZeroDivisionError('a bug')" in str(streamer.report().silence)
    time.sleep(0.2)
    assert len(sent) == before
    streamer.close()
