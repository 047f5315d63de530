"""Why an autopilot refuses to arm or to fly offboard, from its messages: PX4's own events."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from flockd.onboard.autopilot.mavlink_messages import ReceivedMessages
from flockd.onboard.autopilot.refusal_reasons import NAMES, REASONS, event_number

HOLD, POSITION, LAND, OFFBOARD = (4 << 16 | 3 << 24), 3 << 16, (4 << 16 | 6 << 24), 6 << 16
ARMED = 128
ALL_MODES = 0xFFFFFFFF
SUMMARY, END = 16777216 + 11047904, 16777216 + 1914663
"""PX4 1.18's numbers, from the metadata it was built with."""


class Story:
    """What an autopilot has sent, and when."""

    def __init__(self, mode: int = HOLD, base_mode: int = 0) -> None:
        self.log: list[str] = []
        self.received = ReceivedMessages(self.log.append)
        self.now_s, self._sequence = 100.0, 65533
        self.send("HEARTBEAT", custom_mode=mode, base_mode=base_mode, system_status=3)

    def send(self, name: str, **fields: Any) -> None:
        self.received.add(name, fields, self.now_s)

    def event(self, number: int, arguments: bytes, level: int = 3) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFF
        data = list(arguments.ljust(40, b"\0"))
        self.send("EVENT", id=number, arguments=data, log_levels=level, sequence=self._sequence)

    def report(self, can_arm: int, can_run: int, *checks: tuple[int, int, int]) -> None:
        self.event(SUMMARY, struct.pack("<BIIII", 0, 0, 0, can_arm, can_run), 8)
        for number, modes, level in checks:
            self.event(16777216 + number, struct.pack("<IB", modes, 20), level)
        self.event(END, b"", 8)

    def lose_an_event(self) -> None:
        self._sequence += 1

    def sentences(self, *, streams: bool = False) -> list[str]:
        return [refusal.sentence for refusal in self.received.refusals(self.now_s, streams=streams)]


def test_numbers_follow_from_names_as_px4_makes_them() -> None:
    numbers = {"check_gyro_not_calibrated": 1326449, "check_modes_offboard_signal_lost": 11464574}
    numbers |= {"check_battery_low": 5049764, "commander_arming_check_summary": 11047904}
    assert {name: event_number(name) - 16777216 for name in numbers} == numbers
    assert len(NAMES) == len(REASONS), "no two reasons share a number"
    assert all(reason.what and reason.remedy for reason in REASONS.values())


IDLE_IN_SITL = ((11464574, 0x4000, 3), (377561, 0x8, 6), (453929, ALL_MODES, 4), (6801787, ALL_MODES, 6))
"""What PX4 SITL 1.18 sends while all is well: no setpoints, no mission, no sticks, no ground station."""


def test_a_drone_that_may_be_armed_has_nothing_to_say_while_flockd_does_not_stream() -> None:
    story = Story()
    story.report(0x807F3AB0, 0x807F3AB0, *IDLE_IN_SITL)
    assert story.sentences() == []
    (refusal,) = story.received.refusals(story.now_s, streams=True)
    assert (refusal.reason, refusal.refused) == ("check_modes_offboard_signal_lost", "offboard")
    assert "it receives no setpoints although flockd sends them; check that" in refusal.sentence


def test_landed_in_land_mode_it_cannot_be_armed_and_says_which_mode_to_select() -> None:
    story = Story(LAND)
    story.report(0x80430A90, 0x807F3AB0, *IDLE_IN_SITL, (1871713, 0x3C3020 | 1 << 18, 6))
    assert story.sentences()[0].startswith("the autopilot refuses to arm: it cannot be armed in its flight mode; ")


def test_sticks_are_missed_in_position_mode_alone() -> None:
    story = Story(POSITION)
    story.report(0x807F3AB0, 0x807F3AB0, *IDLE_IN_SITL)
    (sentence,) = story.sentences()
    assert sentence.startswith("the autopilot refuses to arm: its flight mode needs sticks")
    story.send("HEARTBEAT", custom_mode=HOLD, base_mode=0, system_status=3)
    assert story.sentences() == []


def test_the_cause_comes_first_each_reason_once_and_no_more_than_five() -> None:
    story = Story()
    missing = [f"check_{sensor}_missing" for sensor in ("gyro", "mag", "baro", "accel")]
    checks = [(event_number(name) - 16777216, ALL_MODES, 3) for name in ("check_battery_low", *missing)]
    lost = (event_number("check_estimator_missing_data") - 16777216, ALL_MODES, 3)
    story.report(0, 0, *checks, lost, lost)
    sentences = story.sentences()
    assert len(sentences) == 5
    assert "its estimator has not started" in sentences[0]
    assert "the battery is low" in sentences[1]
    assert sentences[-1].endswith("(1 further reason)")


def test_a_list_with_a_lost_event_is_not_believed_and_the_next_whole_one_is() -> None:
    story = Story()
    story.report(0, 0, (5049764, ALL_MODES, 3))
    story.event(SUMMARY, struct.pack("<BIIII", 0, 0, 0, ALL_MODES, ALL_MODES), 8)
    story.lose_an_event()
    story.event(END, b"", 8)
    events = story.received.check_events
    assert events.lost
    assert "the battery is low" in story.sentences()[0], "the last whole list holds"
    story.report(ALL_MODES, ALL_MODES)
    assert (story.sentences(), events.lost) == ([], False)
    story._sequence -= 3  # what comes once more changes nothing
    story.report(0, 0, (5049764, ALL_MODES, 3))
    assert (story.sentences(), events.lost) == ([], False)


@pytest.mark.parametrize(
    ("ahead", "reset", "lost"), [(0, 0, False), (-3, 0, False), (2, 0, True), (-3, 1, True), (-30, 0, True)]
)
def test_the_last_events_are_missed_by_the_number_that_the_autopilot_names(ahead: int, reset: int, lost: bool) -> None:
    story = Story()
    story.report(ALL_MODES, ALL_MODES)
    assert story._sequence == 0xFFFF, "numbers begin again after it"
    newest = (story._sequence + ahead) & 0xFFFF
    story.send("CURRENT_EVENT_SEQUENCE", sequence=newest, flags=reset)
    assert story.received.check_events.lost is lost
    story._sequence = newest if lost else story._sequence
    story.report(0, 0, (5049764, ALL_MODES, 3))
    assert "the battery is low" in story.sentences()[0]
    assert not story.received.check_events.lost


def test_a_check_without_words_here_is_told_by_its_number() -> None:
    story = Story()
    story.report(0, 0, (4711, ALL_MODES, 2))
    (sentence,) = story.sentences()
    assert "a check fails that flockd has no words for (event 16781927); read its checks" in sentence


def test_in_the_air_only_what_keeps_it_from_offboard_is_told_and_in_offboard_nothing() -> None:
    story = Story(HOLD, ARMED)
    speed = (event_number("check_modes_offboard_no_local_velocity") - 16777216, 0x4000, 3)
    story.report(0, ALL_MODES & ~0x4000, (5049764, ALL_MODES, 3), speed)
    (sentence,) = story.sentences(streams=True)
    assert sentence.startswith("the autopilot refuses offboard: it has no velocity, which flockd's setpoints need; ")
    story.send("HEARTBEAT", custom_mode=OFFBOARD, base_mode=ARMED, system_status=4)
    assert story.sentences(streams=True) == []


def test_who_switches_to_offboard_too_early_is_told_for_a_while() -> None:
    story = Story()
    story.report(ALL_MODES, ALL_MODES & ~0x4000, (11464574, 0x4000, 3))
    assert story.sentences() == []
    story.event(event_number("commander_modeswitch_not_avail"), struct.pack("<IB", OFFBOARD, 14), 2)
    (sentence,) = story.sentences()
    assert "as flockd sends none yet; fly in Hold or Position until flockd's state is ready" in sentence
    story.now_s += 20.0
    assert story.sentences() == []
    story.send("HEARTBEAT", custom_mode=HOLD, base_mode=ARMED, system_status=4)
    assert story.sentences() == [sentence], "in the air it counts whether somebody tries or not"


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ("commander_arm_denied_throttle_unsafe", "the throttle is not at its lowest; move the stick down"),
        ("commander_arm_denied_calibrating", "a calibration is under way; wait until the calibration is over"),
    ],
)
def test_arming_that_was_refused_is_told_for_a_while(event: str, words: str) -> None:
    story = Story()
    story.report(ALL_MODES, ALL_MODES)
    story.event(event_number(event), b"", 2)
    assert words in story.sentences()[0]
    story.now_s += 20.0
    assert story.sentences() == []


def test_what_it_is_busy_with_is_a_reason() -> None:
    story = Story()
    story.send("HEARTBEAT", custom_mode=HOLD, base_mode=0, system_status=2)
    assert "a calibration is under way" in story.sentences()[0]


def test_another_onboard_computer_is_a_reason_while_it_is_heard() -> None:
    story = Story(OFFBOARD, ARMED)
    story.received.add_other_heartbeat({"type": 6}, story.now_s)
    assert story.sentences() == [], "a ground station is none"
    story.received.add_other_heartbeat({"type": 18}, story.now_s)
    assert story.sentences()[0].startswith("the autopilot: another onboard computer is on its link")
    story.now_s += 6.0
    assert story.sentences() == []
