"""Angles modulo a turn, and the messages that hold one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import Setpoint, Wanted
from flockd.core.navigation import wrapped
from flockd.flight.mission.guidance import Guidance

DEGREES = [
    (0, 0), (90, 90), (-90, -90), (180, 180), (-180, 180), (181, -179), (359, -1), (360, 0), (450, 90), (-450, -90),
    (540, 180), (3690, 90), (-36_010, -10),
]  # fmt: skip


@pytest.mark.parametrize(("angle_deg", "same_deg"), DEGREES)
def test_every_message_holds_the_same_direction_within_half_a_turn(angle_deg: float, same_deg: float) -> None:
    angle_rad, still = math.radians(angle_deg), np.zeros(2)
    for held_rad in (
        wrapped(angle_rad),
        Wanted(still, still, angle_rad).yaw_rad,
        Setpoint(0.0, still, 3.0, angle_rad).yaw_rad,
        Guidance(still, "flies", angle_rad).course_rad,
    ):
        assert held_rad is not None
        assert -math.pi < held_rad <= math.pi
        assert abs(math.sin((held_rad - math.radians(same_deg)) / 2)) < 1e-12


def test_a_direction_stays_to_the_last_bit_and_what_is_none_is_none() -> None:
    for angle_rad in np.random.default_rng(0).uniform(-math.pi, math.pi, 1000):
        assert wrapped(angle_rad) == angle_rad
    for angle_rad in (1e300, -1e300):
        assert -math.pi < wrapped(angle_rad) <= math.pi, "a number without a direction left in it is still one"
    assert all(math.isnan(wrapped(angle_rad)) for angle_rad in (math.nan, math.inf, -math.inf))
    assert Wanted(np.zeros(2), np.zeros(2), None).yaw_rad is None
    assert Guidance(np.zeros(2), "stands").course_rad is None
