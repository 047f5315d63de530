"""Poses of before, between those that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.flight.geometry import rotation_from_euler
from flockd.sim.scenario import StartConfig, VehicleConfig
from flockd.sim.vehicles.pose_trail import FlockPose, PoseTrail
from flockd.sim.vehicles.vehicles import Vehicles


def pose(time_s: float) -> FlockPose:
    """1 m/s north, 0.5 rad/s of yaw."""
    return FlockPose(time_s, np.array([[time_s, 0.0, -3.0]]), rotation_from_euler(0.0, 0.0, 0.5 * time_s)[None])


def trail_of(*times_s: float) -> PoseTrail:
    trail = PoseTrail()
    for time_s in times_s:
        trail.add(pose(time_s))
    return trail


def test_between_two_poses_place_and_turn_go_evenly() -> None:
    trail = trail_of(0.0, 0.2, 0.4)
    for time_s in (0.0, 0.05, 0.2, 0.33, 0.4):
        np.testing.assert_allclose(trail.at(time_s).position, pose(time_s).position, atol=1e-12)
        np.testing.assert_allclose(trail.at(time_s).R_ned_body, pose(time_s).R_ned_body, atol=1e-12)
    np.testing.assert_allclose(trail.at(-1.0).position, pose(0.0).position)
    np.testing.assert_allclose(trail.at(9.0).position, pose(0.4).position)


@pytest.mark.parametrize("time_s", [0.1, 0.4])
def test_motion_is_that_of_the_moment_the_newest_included(time_s: float) -> None:
    motion = trail_of(0.0, 0.2, 0.4).motion_at(time_s)
    np.testing.assert_allclose(motion.velocity, [[1.0, 0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(motion.turn, [[0.0, 0.0, 0.5]], atol=1e-9)


def test_a_second_is_kept_and_nothing_runs_back() -> None:
    trail = trail_of(*np.arange(0.0, 5.0, 0.1).tolist())
    np.testing.assert_allclose(trail.at(3.95).position[0, 0], 3.95, atol=1e-9)
    assert trail.at(0.0).position[0, 0] > 3.5
    trail.add(FlockPose(1.0, np.full((1, 3), 99.0), np.eye(3)[None]))
    assert trail.at(9.0).position[0, 0] == pytest.approx(4.9)


def test_a_flight_begins_as_if_it_had_flown_before() -> None:
    """At 1.5 m/s north a drone was 0.3 m south 0.2 s before its start."""
    vehicles = Vehicles([StartConfig(position_m=(1.0, 2.0, -3.0), velocity_m_s=(1.5, 0.0))], VehicleConfig())
    np.testing.assert_allclose(vehicles.trail.at(-0.2).position, [[0.7, 2.0, -3.0]], atol=1e-12)
    vehicles.step(np.array([[1.5, 0.0]]), np.array([math.radians(90.0)]), 0.5)
    newest = vehicles.trail.at(0.5)
    assert np.array_equal(newest.position, vehicles.position)
    assert np.array_equal(newest.R_ned_body, vehicles.R_ned_body)
    # The yaw follows at 60 degrees a second at most; halfway it has turned less than at the end.
    assert 0.0 < vehicles.trail.motion_at(0.4).turn[0, 2] <= math.radians(60.0) + 1e-6
