"""What received MAVLink messages say, among them values that no enumeration has."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from flockd.autopilot.mavlink_messages import ENUMERATIONS, RESULTS, ReceivedMessages, result_text


def _received(*messages: tuple[str, dict[str, Any]]) -> tuple[ReceivedMessages, list[str]]:
    log: list[str] = []
    received = ReceivedMessages(log.append)
    for number, (name, fields) in enumerate(messages):
        received.add(name, fields, float(number))
    return received, log


def _values(enumeration: str) -> set[int]:
    return {value for value, entry in mavlink.enums[enumeration].items() if not entry.name.endswith("_ENUM_END")}


def test_the_enumerations_are_those_of_mavlink() -> None:
    fields = {"landed_state": "MAV_LANDED_STATE", "fix_type": "GPS_FIX_TYPE", "system_status": "MAV_STATE"}
    for (_, field), count in ENUMERATIONS.items():
        assert _values(fields[field]) == set(range(count))
    assert _values("MAV_RESULT") <= set(range(len(RESULTS)))  # pymavlink lacks the newest


@pytest.mark.parametrize("landed_state", [5, 77, 255])
def test_an_unknown_landed_state_is_unknown_counted_and_logged_once(landed_state: int) -> None:
    message = ("EXTENDED_SYS_STATE", {"landed_state": landed_state})
    received, log = _received(("EXTENDED_SYS_STATE", {"landed_state": 2}), message, message)
    status = received.status(now_s=3.0)
    assert (status.landed_state, status.in_air) == ("unknown", False)
    value = f"EXTENDED_SYS_STATE.landed_state = {landed_state}"
    assert received.unknown_values() == {value: 2}
    assert log == [f"the autopilot sends {value}, which flockd does not know; it counts as unknown"]
    received.add(*("EXTENDED_SYS_STATE", {"landed_state": 1}), 3.0)
    assert received.status(now_s=4.0).landed_state == "ground", "a known value counts again"


def test_an_unknown_fix_or_system_status_says_nothing() -> None:
    received, _ = _received(("GPS_RAW_INT", {"fix_type": 9}), ("HEARTBEAT", {"system_status": 9, "custom_mode": 0}))
    status = received.status(now_s=2.0)
    assert (status.gps_ok, status.failsafe, status.heartbeat_age_s) == (None, False, 1.0)
    assert sum(received.unknown_values().values()) == 2


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
    assert (received.unknown_values(), log) == ({}, [])


def test_a_home_that_moves_counts_on_the_ground_only_and_with_an_unknown_landed_state_never_raises() -> None:
    home = [("HOME_POSITION", {"x": 0.0, "y": 0.0, "z": float(down)}) for down in (-1, -2, -3)]
    landed = [("EXTENDED_SYS_STATE", {"landed_state": value}) for value in (2, 5)]
    received, _ = _received(home[0], landed[0], home[1])
    assert received.home_down_m == -1.0
    received, _ = _received(home[0], landed[1], home[2])
    assert received.home_down_m == -3.0


def test_an_unknown_result_of_a_command_has_words_too() -> None:
    assert result_text(4) == "failed"
    assert result_text(200) == "answered with the unknown result 200"
