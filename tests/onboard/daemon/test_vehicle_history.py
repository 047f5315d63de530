"""What the vehicle's states of the last seconds tell, worked out by hand for a steady acceleration and turn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.flight.geometry import rotation_from_euler
from flockd.onboard.daemon.pilot_loop import VehicleHistory
from tests.make import vehicle


def _turning_and_gathering_speed() -> VehicleHistory:
    """From 100 s on 2 m/s^2 north and 1 m/s down, from 1 m north and 2 m east; 0.5 rad/s to the right."""
    history = VehicleHistory()
    for k in range(11):
        t = 0.1 * k
        history.add(
            vehicle(
                100.0 + t, 5.0 - t, R_ned_body=rotation_from_euler(0.0, 0.0, 0.5 * t),
                velocity_ned=[2.0 * t, 0.0, 1.0], position=[1.0 + t**2, 2.0],
            )
        )  # fmt: skip
    return history


def test_how_far_it_moved_since_then_is_the_integral_of_its_velocity() -> None:
    moved = _turning_and_gathering_speed().moved_since(100.45)
    np.testing.assert_allclose(moved, [1.0 - 0.45**2, 0.0, 0.55], atol=1e-9)


def test_before_the_first_state_and_without_velocities_nothing_moved() -> None:
    assert VehicleHistory().moved_since(1.0).tolist() == [0.0, 0.0, 0.0]
    history = VehicleHistory()
    for time_s in (1.0, 2.0):
        history.add(vehicle(time_s, velocity_ned=None))
    assert history.moved_since(1.0).tolist() == [0.0, 0.0, 0.0]


def test_between_two_states_place_velocity_height_and_attitude_are_between() -> None:
    state = _turning_and_gathering_speed().at(100.525)
    assert state is not None and state.position is not None and state.velocity_ned is not None
    assert state.turn_rate is not None
    np.testing.assert_allclose(state.position, [1.0 + 0.75 * 0.5**2 + 0.25 * 0.6**2, 2.0], atol=1e-9)
    np.testing.assert_allclose(state.velocity_ned, [1.05, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(state.turn_rate, [0.0, 0.0, 0.5], atol=1e-9)
    assert state.height_m == pytest.approx(5.0 - 0.525)
    assert math.atan2(state.R_ned_body[1, 0], state.R_ned_body[0, 0]) == pytest.approx(0.5 * 0.525)
