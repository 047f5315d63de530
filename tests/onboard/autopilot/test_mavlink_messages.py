"""What received MAVLink messages say, among them values that no enumeration has."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from flockd.core.messages import RangeReading
from flockd.onboard.autopilot.mavlink_messages import RESULTS, VALUES, ReceivedMessages, result_text

pytestmark = pytest.mark.fault("absurd-mavlink")


POSE = (
    ("ATTITUDE_QUATERNION", {"q1": 1.0, "q2": 0.0, "q3": 0.0, "q4": 0.0}),
    ("LOCAL_POSITION_NED", {"x": 0.0, "y": 0.0, "z": -4.0, "vx": 0.0, "vy": 0.0, "vz": 0.0}),
)


def _received(*messages: tuple[str, dict[str, Any]]) -> tuple[ReceivedMessages, list[str]]:
    log: list[str] = []
    received = ReceivedMessages(log.append)
    for number, (name, fields) in enumerate(messages):
        received.add(name, fields, float(number))
    return received, log


def _text_of(received: ReceivedMessages) -> str:
    newest = received.newest("STATUSTEXT")
    assert newest is not None
    return str(newest.fields["text"])


def _ground_range(received: ReceivedMessages) -> RangeReading:
    reading = received.ground_range
    assert reading is not None
    return reading


def _values(enumeration: str) -> set[int]:
    return {value for value, entry in mavlink.enums[enumeration].items() if not entry.name.endswith("_ENUM_END")}


def test_the_enumerations_are_those_of_mavlink() -> None:
    fields = {"landed_state": "MAV_LANDED_STATE", "fix_type": "GPS_FIX_TYPE", "system_status": "MAV_STATE"}
    for field, known in VALUES.values():
        if field in fields:
            assert _values(fields[field]) == set(known)
    assert _values("MAV_RESULT") <= set(range(len(RESULTS)))  # pymavlink lacks the newest


@pytest.mark.parametrize("landed_state", [5, 77, 255])
def test_an_unknown_landed_state_is_unknown_and_logged_once(landed_state: int) -> None:
    message = ("EXTENDED_SYS_STATE", {"landed_state": landed_state})
    received, log = _received(("EXTENDED_SYS_STATE", {"landed_state": 2}), message, message)
    status = received.status(now_s=3.0)
    assert (status.landed_state, status.in_air) == ("unknown", False)
    value = f"EXTENDED_SYS_STATE.landed_state = {landed_state}"
    assert len(log) == 1 and value in log[0]
    received.add(*("EXTENDED_SYS_STATE", {"landed_state": 1}), 3.0)
    assert received.status(now_s=4.0).landed_state == "ground", "a known value counts again"


def test_an_unknown_fix_or_system_status_says_nothing() -> None:
    received, _ = _received(("GPS_RAW_INT", {"fix_type": 9}), ("HEARTBEAT", {"system_status": 9, "custom_mode": 0}))
    status = received.status(now_s=2.0)
    assert (status.gps_ok, status.failsafe, status.heartbeat_age_s) == (None, False, 1.0)


@pytest.mark.parametrize("percent", [-128, -2, 101, 127])
def test_a_battery_that_cannot_be_is_unknown_and_not_empty(percent: int) -> None:
    received, log = _received(("SYS_STATUS", {"battery_remaining": percent}))
    assert received.status(now_s=2.0).battery_share is None
    assert len(log) == 1 and f"SYS_STATUS.battery_remaining = {percent}" in log[0]


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (1e30, 0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.0)])
def test_a_quaternion_without_direction_is_no_attitude(quaternion: tuple[float, ...]) -> None:
    fields = dict(zip(("q1", "q2", "q3", "q4"), quaternion, strict=True))
    received, _ = _received(POSE[1], ("ATTITUDE_QUATERNION", fields))
    assert received.vehicle_state() is None
    received.add(*POSE[0], 3.0)
    assert received.vehicle_state() is not None


def test_known_values_are_not_counted() -> None:
    received, log = _received(
        ("EXTENDED_SYS_STATE", {"landed_state": 4}),
        ("GPS_RAW_INT", {"fix_type": 8}),
        ("HEARTBEAT", {"system_status": 5, "custom_mode": 6 << 16}),
    )
    status = received.status(now_s=3.0)
    assert (status.landed_state, status.gps_ok, status.failsafe, status.flight_mode) == (
        "landing", True, True, "offboard",
    )  # fmt: skip
    assert log == []


def test_an_unknown_result_of_a_command_has_words_too() -> None:
    assert result_text(4) == "failed"
    assert "200" in result_text(200)


ARMED, DISARMED = {"base_mode": 128, "custom_mode": 6 << 16}, {"base_mode": 0, "custom_mode": 6 << 16}
GROUND, AIR = {"landed_state": 1}, {"landed_state": 2}


def _home(north_m: float, down_m: float) -> tuple[str, dict[str, Any]]:
    return "HOME_POSITION", {"x": north_m, "y": 0.0, "z": down_m}


@pytest.mark.fault("home-moved")
def test_home_stays_while_armed_whatever_landed_state_and_home_say_and_moves_after() -> None:
    received, log = _received(_home(0.0, 0.0), ("HEARTBEAT", ARMED), ("EXTENDED_SYS_STATE", GROUND), *POSE)
    received.add(*_home(1.0, -0.2), 6.0)
    assert received.home_down_m == -0.2, "PX4 sets home when it is armed, still on the ground"
    received.add("EXTENDED_SYS_STATE", AIR, 7.0)
    received.add("EXTENDED_SYS_STATE", GROUND, 8.0)  # a second sender with the autopilot's ids
    received.add(*_home(50.0, 20.0), 9.0)
    received.add(*_home(60.0, 20.0), 10.0)
    status, vehicle = received.status(11.0), received.vehicle_state()
    assert status.home_ned is not None and vehicle is not None
    assert list(status.home_ned) == [1.0, 0.0, -0.2]
    assert vehicle.height_m == pytest.approx(3.8)  # -0.2 + 4.0
    assert len(log) == 2 and "on the ground" in log[0]
    assert "moved by 53.0 m" in log[1]  # sqrt(49^2 + 20.2^2)
    received.add("HEARTBEAT", DISARMED, 12.0)
    received.add(*_home(2.0, -0.1), 13.0)
    assert received.home_down_m == -0.1


def test_a_home_that_is_not_finite_is_none() -> None:
    received, _ = _received(("HOME_POSITION", {"x": None, "y": 0.0, "z": 0.0}), _home(float("inf"), 0.0))
    assert received.home_down_m is None
    assert received.status(3.0).home_ned is None


def _text(chunk: str, number: int = 0, sequence: int = 0) -> tuple[str, dict[str, Any]]:
    return "STATUSTEXT", {"severity": 4, "text": chunk, "id": number, "chunk_seq": sequence}


@pytest.mark.fault("text-in-chunks")
def test_a_text_in_chunks_is_seen_whole_and_not_before() -> None:
    sentence = "Preflight Fail: the battery is far below what a take-off needs, and the compass disagrees with the yaw"
    received, _ = _received(_text("short"), _text(sentence[:50], 7, 0), _text(sentence[50:100], 7, 1))
    assert _text_of(received) == "short"
    received.add(*_text(sentence[100:], 7, 2), 3.0)
    assert _text_of(received) == sentence


def test_the_first_text_of_px4_has_the_id_of_texts_without_chunks_and_is_seen_whole() -> None:
    """As PX4 SITL 1.18 sends it after a start: id 0, and a tab at the end."""
    first, second = "Arming denied: Resolve system health failures firs", "t\t"
    received, log = _received(_text(first, 0, 0), _text(second, 0, 1))
    assert received.recent_texts(2.0, 10.0) == [f"{first}t"]
    assert len(log) == 1 and log[0].endswith(f": {first}t")


def test_a_stamp_from_the_past_is_a_restart_on_the_ground_and_nothing_in_flight() -> None:
    attitude = [("ATTITUDE_QUATERNION", {"time_boot_ms": stamp}) for stamp in (60_000, 0, 60_020)]
    armed, disarmed = [("HEARTBEAT", {"base_mode": mode, "custom_mode": 0, "system_status": 4}) for mode in (128, 0)]
    received, log = _received(armed, *attitude)
    assert (received.restarts, log) == (0, [])
    received, log = _received(disarmed, *attitude)
    assert (received.restarts, len(log)) == (1, 1)


@pytest.mark.parametrize("armed", [True, False])
@pytest.mark.parametrize(
    ("stamps", "two"),
    [
        ([60_000, 5_000, 60_020, 5_020, 60_040, 5_040], True),
        ([60_000, 59_880, 60_020, 59_900, 60_040, 59_920], True),
        ([60_000, 0, 20, 40, 60, 80, 0, 20, 40], False),
        ([60_000, 60_040, 60_020, 60_080, 60_060, 60_120, 60_100, 60_160, 60_140], False),
        ([stamp - late for stamp in range(59_800, 60_600, 20) for late in (0, 120)], False),
    ],
    ids=["far apart", "started with one switch", "restarted twice", "overtaken packets", "over a second, slower way"],
)
def test_two_autopilots_of_one_id_are_told_apart_by_their_clocks(stamps: list[int], two: bool, armed: bool) -> None:
    heartbeat = ("HEARTBEAT", {"base_mode": 128 * armed, "custom_mode": 0, "system_status": 4})
    before = range(58_000, 59_800, 20)  # one alone
    received, log = _received(
        heartbeat, *(("ATTITUDE_QUATERNION", {"time_boot_ms": stamp}) for stamp in [*before, *stamps])
    )
    assert received.are_two is two
    assert sum("two autopilots with the same system id" in text for text in log) == two


def test_a_slower_way_that_is_there_from_the_beginning_is_no_second_autopilot() -> None:
    """The first of its stamps were never heard over the faster one."""
    stamps = [stamp - late for stamp in range(60_000, 63_000, 20) for late in (0, 120)]
    received, _ = _received(*(("ATTITUDE_QUATERNION", {"time_boot_ms": stamp}) for stamp in stamps))
    assert not received.are_two


@pytest.mark.parametrize(
    ("boards", "two"),
    [([1, 1, 1], False), ([1, 2], True), ([0, 1, 0, 1], False), ([1, "restart", 2], False)],
    ids=["one", "two", "sometimes unknown", "another one after a restart"],
)
def test_two_whose_clocks_agree_are_told_apart_by_their_boards(boards: list[int | str], two: bool) -> None:
    """`uid2` of AUTOPILOT_VERSION, PX4's processor's number, of its simulator the instance's."""
    told: dict[str, list[tuple[str, Any]]] = {
        "restart": [("ATTITUDE_QUATERNION", {"time_boot_ms": stamp}) for stamp in (60_000, 0)]
    }
    messages = [told.get(str(one), [("AUTOPILOT_VERSION", {"uid2": [one] * 18})]) for one in boards]
    received, log = _received(*(message for some in messages for message in some))
    assert received.are_two is two
    assert sum("two autopilots with the same system id" in text for text in log) == two


def test_a_text_of_just_one_chunk_is_seen_when_it_does_not_go_on() -> None:
    received, log = _received(_text("a" * 50))
    received.add("SYS_STATUS", {"battery_remaining": 50}, 0.1)
    assert log == []
    received.add("SYS_STATUS", {"battery_remaining": 50}, 0.3)
    received.add("SYS_STATUS", {"battery_remaining": 50}, 0.5)
    assert log == [f"the autopilot says: {'a' * 50}"]


def test_a_chunk_that_is_lost_is_marked_and_does_not_mix_texts() -> None:
    received, _ = _received(_text("a" * 50, 7, 0), _text("end", 7, 2), _text("b" * 50, 8, 0), _text("tail", 8, 1))
    assert _text_of(received) == "b" * 50 + "tail"
    lost, _ = _received(_text("a" * 50, 7, 0), _text("end", 7, 2))
    assert _text_of(lost) == "a" * 50 + "...end"


def _distance(orientation: int, current: int, signal: int = 0) -> tuple[str, dict[str, Any]]:
    limits = {"min_distance": 15, "max_distance": 2000}
    return "DISTANCE_SENSOR", {
        **limits, "current_distance": current, "orientation": orientation, "signal_quality": signal
    }  # fmt: skip


def test_the_range_is_that_of_the_sensor_which_faces_down() -> None:
    down = int(mavlink.MAV_SENSOR_ROTATION_PITCH_270)
    received, _ = _received(*POSE, _distance(down, 412, 100), _distance(0, 90))
    reading = _ground_range(received)
    assert (reading.time_s, reading.range_m, reading.min_m, reading.max_m) == pytest.approx((2.0, 4.12, 0.15, 20.0))
    assert reading.quality == 1.0
    assert list(received.ranges_s) == [2.0]
    for signal, quality in ((0, None), (1, 0.0), (51, pytest.approx(0.505, abs=0.001))):
        received.add(*_distance(down, 412, signal), 4.0)
        assert _ground_range(received).quality == quality
