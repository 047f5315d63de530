"""MAVLink messages with any values."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from flockd.onboard.autopilot.mavlink_messages import ReceivedMessages
from flockd.onboard.autopilot.mavsdk_link import RECEIVED
from tests.hostile import ABSURD_TEXTS, any_float, assert_readable, hostile

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest overflow


def test_whatever_an_autopilot_sends_is_taken_or_left() -> None:
    kinds = {name: _fields(name) for name in RECEIVED}

    @hostile(40)
    def check(random: Random) -> None:
        said: list[str] = []
        received = ReceivedMessages(said.append)
        now_s = random.uniform(0.0, 1e5)
        for _ in range(random.randrange(1, 30)):
            now_s += random.choice((0.0, 0.02, 1.0, 3.0))
            name = random.choice(RECEIVED)
            received.add(name, {field: _value(random, kind) for field, kind in kinds[name].items()}, now_s)
            if random.random() < 0.3:  # replies of TIMESYNC, whose times are whatever somebody sends
                for _ in range(random.choice((1, 6))):
                    received.clock.add(now_s, random.choice((now_s, now_s + 0.9, any_float(random))), now_s + 0.002)
            if random.random() < 0.1:
                received.add_other_heartbeat({"type": random.choice((2, 18, None, "18", 1e300))}, now_s)
        status, state = received.status(now_s), received.vehicle_state()
        for refusal in received.refusals(now_s, streams=random.random() < 0.5):
            assert_readable(refusal.sentence)
        assert status.battery_share is None or 0.0 <= status.battery_share <= 1.0, status.battery_share
        for vector in (status.position_ned, status.home_ned):
            assert vector is None or np.isfinite(vector).all()
        if state is not None:
            assert now_s - 60.0 <= state.time_s <= now_s, "a state of another time"
            R = state.R_ned_body
            assert np.allclose(R @ R.T, np.eye(3), atol=1e-6), "an attitude that is no rotation"
            assert math.isfinite(state.height_m)
        for sentence in said:
            assert_readable(sentence)

    check()


_NOT_IN_PYMAVLINK = {
    "EVENT": {
        "id": "uint32_t",
        "event_time_boot_ms": "uint32_t",
        "sequence": "uint16_t",
        "destination_component": "uint8_t",
        "destination_system": "uint8_t",
        "log_levels": "uint8_t",
        "arguments": "bytes",
    },
    "CURRENT_EVENT_SEQUENCE": {"sequence": "uint16_t", "flags": "uint8_t"},
}
"""MAVLink's EVENT, which pymavlink does not have."""


def _fields(name: str) -> dict[str, str]:
    if name in _NOT_IN_PYMAVLINK:
        return _NOT_IN_PYMAVLINK[name]
    kind = getattr(dialect, f"MAVLink_{name.lower()}_message")
    return dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))


def _value(random: Random, kind: str) -> Any:
    """What MAVSDK makes of a field of this type: any number that fits into it, NaN as null."""
    if kind == "char":
        return random.choice((*ABSURD_TEXTS, "low battery", "x" * 50)).replace("\0", "")[:50]
    if kind in ("float", "double"):
        number = any_float(random)
        return None if math.isnan(number) else max(min(number, 3.4e38), -3.4e38)
    if kind == "bytes":
        return random.choice(([random.randrange(256) for _ in range(random.choice((40, 40, 0, 3)))], None, [-1], ["a"]))
    bits, signed = int("".join(filter(str.isdigit, kind))), not kind.startswith("u")
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return random.choice((0, 1, 2, 3, 4, 5, 6, 8, low, high, random.randint(low, high)))
