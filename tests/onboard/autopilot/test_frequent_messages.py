"""What is taken out of a serial port's bytes, against what pymavlink packs."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from flockd.onboard.autopilot.frequent_messages import FrequentMessages

NAN = math.nan
MESSAGES = [
    mavlink.MAVLink_attitude_quaternion_message(1234, 0.5, -0.5, 0.5, -0.5, 0.125, -0.25, 0.375),
    mavlink.MAVLink_local_position_ned_message(2**32 - 1, 1.5, -2.5, NAN, 0.25, math.inf, 0.0),
    mavlink.MAVLink_position_target_local_ned_message(7, 1, 0, NAN, NAN, NAN, 1.5, -0.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0),
    mavlink.MAVLink_distance_sensor_message(9, 20, 3000, 253, 0, 3, 25, 255, 0.1, 0.2, [1.0, 0, 0, 0], 87),
    mavlink.MAVLink_distance_sensor_message(9, 20, 3000, 250, 0, 3, 25, 0),
]
OTHERS = [
    mavlink.MAVLink_heartbeat_message(2, 12, 81, 50593792, 4, 3),
]


def _packed(message: Any, *, system: int = 1, component: int = 1, key: bytes = b"") -> bytes:
    sender = mavlink.MAVLink(None, system, component)
    if key:
        sender.signing.secret_key, sender.signing.sign_outgoing = key, True
    return bytes(message.pack(sender))


@pytest.mark.parametrize("chunk", [1, 7, 4096])
@pytest.mark.parametrize("key", [b"", bytes(range(32))], ids=["unsigned", "signed"])
def test_what_pymavlink_packs_is_read_and_the_rest_goes_on(chunk: int, key: bytes) -> None:
    taken: list[tuple[str, dict[str, Any]]] = []
    frequent = FrequentMessages(1, 1, lambda *message: taken.append(message))
    foreign = [_packed(MESSAGES[0], system=2), _packed(MESSAGES[1], component=191), b"noise"]
    others = [_packed(message, key=key) for message in OTHERS] + foreign
    frames = [_packed(message, key=key) for message in MESSAGES]
    data = b"".join(one for pair in zip(frames, [*others, b""], strict=True) for one in pair)
    rest = b"".join(frequent.without(data[at : at + chunk]) for at in range(0, len(data), chunk))
    assert rest == b"".join(others)
    assert [name for name, _ in taken] == [message.get_type() for message in MESSAGES]
    for (_, fields), message in zip(taken, MESSAGES, strict=True):
        said = {name: getattr(message, name) for name in fields}
        assert fields == {name: value if math.isfinite(value) else None for name, value in said.items()}


@pytest.mark.parametrize("at", [3, 12, -1])
def test_a_damaged_frame_is_left_to_mavsdk(at: int) -> None:
    taken: list[object] = []
    damaged = bytearray(_packed(MESSAGES[0]))
    damaged[at] ^= 0x10
    whole = _packed(MESSAGES[1])
    frequent = FrequentMessages(1, 1, lambda name, _: taken.append(name))
    assert frequent.without(bytes(damaged) + whole) == bytes(damaged)
    assert taken == ["LOCAL_POSITION_NED"]
