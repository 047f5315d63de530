"""Jumps of the frame of the autopilot's positions are taken out; turns and corrections are no jumps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.flight.geometry import quaternion_from_rotation, rotation_from_vector
from flockd.onboard.autopilot.mavlink_messages import ReceivedMessages
from flockd.onboard.autopilot.watches import LocalFrame

pytestmark = pytest.mark.fault("frame-jumps")


def _moves(frame: LocalFrame, place: FloatArray, hz: float) -> None:
    """In a circle of 3 m through ``place`` at 4 m/s, 5.3 m/s^2, with an estimator's noise and stamps of 1 ms."""
    rng = np.random.default_rng(0)
    for t in np.arange(0.0, 4.0, 1.0 / hz):
        angle = t * 4.0 / 3.0
        around = 3.0 * np.array([math.cos(angle) - 1.0, math.sin(angle), 0.0])
        velocity = 4.0 * np.array([-math.sin(angle), math.cos(angle), 0.0])
        corrected = place + around + rng.normal(0.0, 0.03, 3)
        assert frame.move(round(100.0 + t, 3), corrected.tolist(), velocity.tolist()) is None


@pytest.mark.parametrize("hz", [2.0, 10.0, 30.0, 50.0])
def test_a_tight_circle_and_an_estimators_corrections_are_no_jump(hz: float) -> None:
    frame = LocalFrame()
    _moves(frame, np.zeros(3), hz)
    assert not frame.offset.any()


@pytest.mark.parametrize(
    ("jump", "large"),
    [
        ((0.0, 0.0, 0.9), False),
        ((0.0, 0.0, -1.1), True),
        ((0.7, 0.7, 0.0), False),
        ((0.8, 0.8, 0.0), True),
        ((0.0, 0.0, 30.0), True),
    ],
)
def test_a_jump_is_said_and_taken_out(jump: tuple[float, float, float], large: bool) -> None:
    frame, velocity = LocalFrame(), (1.0, 0.0, 0.0)
    frame.move(1.0, (0.0, 0.0, 0.0), velocity)
    told = frame.move(1.1, (0.1 + jump[0], *jump[1:]), velocity)
    assert told is not None
    assert f"{jump[0]:.1f} m north, {jump[1]:.1f} m east and {jump[2]:.1f} m down" in told
    np.testing.assert_allclose(frame.offset, np.negative(jump), atol=1e-9)
    assert frame.large is large


@pytest.mark.parametrize(("degrees", "jumps"), [(8.0, False), (20.0, True), (-150.0, True)])
def test_a_heading_jumps_that_its_rate_does_not_explain(degrees: float, jumps: bool) -> None:
    """While the drone turns at 90 degrees a second, banked by 30."""
    frame, banked = LocalFrame(), rotation_from_vector(np.array([math.radians(30.0), 0.0, 0.0]))
    rate = (banked.T @ [0.0, 0.0, math.pi / 2]).tolist()

    def attitude(yaw_rad: float) -> Any:
        """Unit quaternion w x y z."""
        turned = rotation_from_vector(np.array([0.0, 0.0, yaw_rad])) @ banked
        return np.roll(quaternion_from_rotation(turned), 1).tolist()

    for number in range(10):
        assert frame.turn(0.02 * number, attitude(0.01 * math.pi * number), rate) is None
    told = frame.turn(0.2, attitude(0.1 * math.pi + math.radians(degrees)), rate)
    assert (told is not None, frame.large) == (jumps, jumps)
    assert told is None or told.endswith(f"jumped by {degrees:.0f} degrees")


def _position(stamp_ms: int, down_m: float) -> tuple[str, dict[str, Any]]:
    fields = {"x": 0.0, "y": 0.0, "z": down_m, "vx": 0.0, "vy": 0.0, "vz": 0.0}
    return "LOCAL_POSITION_NED", {"time_boot_ms": stamp_ms, **fields}


def _home(down_m: float) -> tuple[str, dict[str, Any]]:
    return "HOME_POSITION", {"x": 0.0, "y": 0.0, "z": down_m}


def test_heights_above_home_and_setpoints_go_on_through_a_jump_and_start_anew_on_the_ground() -> None:
    log: list[str] = []
    received = ReceivedMessages(log.append)
    quaternion = np.roll(quaternion_from_rotation(np.eye(3)), 1)
    attitude = "ATTITUDE_QUATERNION", dict(zip(("q1", "q2", "q3", "q4"), quaternion, strict=True))
    armed = "HEARTBEAT", {"base_mode": 128, "custom_mode": 6 << 16}
    air = "EXTENDED_SYS_STATE", {"landed_state": 2}
    for name, fields in (_home(-1.0), armed, air, attitude, _position(1000, -6.0)):
        received.add(name, fields, 0.0)
    assert received.height_m == 5.0
    for down_m in (-6.0, 24.0, 24.0):  # the origin is set 30 m higher
        received.add(*_position(1033, down_m), 1.0)
        vehicle = received.vehicle_state()
        assert vehicle is not None
        assert vehicle.height_m == pytest.approx(5.0)
    assert received.height_m == pytest.approx(5.0)
    assert received.status(1.0).frame_jumped
    received.add(*_home(-1.0), 1.1)  # as PX4 goes on saying
    received.add(*_home(29.0), 1.2)  # and as another may
    assert len(log) == 1
    received.add("HEARTBEAT", {"base_mode": 128, "custom_mode": 4 << 16 | 3 << 24}, 2.0)
    assert not received.status(2.0).frame_jumped, "the autopilot holds"
    received.add("HEARTBEAT", {"base_mode": 0, "custom_mode": 4 << 16 | 3 << 24}, 3.0)
    received.add("EXTENDED_SYS_STATE", {"landed_state": 1}, 3.0)
    received.add(*_position(1066, 24.0), 3.1)
    assert (received.home_down_m, received.height_m) == (29.0, 5.0)
