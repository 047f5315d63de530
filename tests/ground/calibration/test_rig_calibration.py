"""A rig that is not as configured, found in flight: exact poses, an analytic world, and errors of known size."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FloatArray, VehicleState
from flockd.flight.geometry import RigidTransform, rotation_from_euler, rotation_from_vector, vector_from_rotation
from flockd.ground.calibration.camera_motion import camera_motion
from flockd.ground.calibration.from_flight import calibrated
from flockd.ground.calibration.rig_calibration import CameraDeviation, RigCalibration, Seen, rig_faults, rolling
from tests.flight.geometry.synthetic_world import EXACT, World, boxes_around, seen_twice
from tests.flight.geometry.wrong_rigs import AS_CONFIGURED, CONFIGURED, STRAIGHT, Autopilot, Way, Wrong, lively, looks

pytestmark = pytest.mark.fault("rig-off")


def flown(way: Way, wrong: Wrong, random: np.random.Generator, *others: Any, **more: Any) -> RigCalibration:
    """The filter after those looks."""
    calibration = RigCalibration(CONFIGURED)
    for before, after, pairs in looks(way, wrong, random, *others, **more):
        calibration.update(seen(before), seen(after), pairs)
    return calibration


def seen(state: VehicleState) -> Seen:
    return Seen(state, state.time_s, dict.fromkeys(CONFIGURED.cameras, state.time_s))


def off_deg(found: CameraDeviation, turn: FloatArray) -> float:
    off = rotation_from_vector(found.turn) @ rotation_from_vector(turn).T
    return math.degrees(float(np.linalg.norm(vector_from_rotation(off))))


def test_two_degrees_thirty_milliseconds_and_two_percent_are_known_after_a_minute() -> None:
    random = np.random.default_rng(0)
    wrong = Wrong.by(2.0, 0.02, 0.03, random)
    for found in flown(lively(random), wrong, random).deviations():
        sigma = np.sqrt(np.diag(found.covariance))
        assert off_deg(found, wrong.turns[found.camera]) < 0.2
        assert abs(found.time_offset_s + 0.03) < 0.003
        assert found.focal_scale == pytest.approx(wrong.focal[found.camera], abs=0.003)
        # and it says how well: neither far better than it is, nor worse than would be of use
        off = vector_from_rotation(rotation_from_vector(found.turn) @ rotation_from_vector(wrong.turns[found.camera]).T)
        assert (np.abs(off) < 4.0 * sigma[:3]).all()
        assert (sigma < [math.radians(0.2)] * 3 + [0.003, 0.005]).all()
        turned, late, focal = rig_faults(found)
        assert all(text.startswith(f"camera {found.camera}: ") for text in (turned, late, focal))
        assert "turned" in turned and "time stamps" in late and "focal" in focal


def test_a_camera_that_is_wrong_for_a_second_is_left_out_by_what_the_flight_shows_later() -> None:
    """At first, while nothing is known, it would be believed; also by what these two looks themselves made known."""
    random = np.random.default_rng(2)
    flight = [
        (seen(before), seen(after), pairs) for before, after, pairs in looks(lively(random), AS_CONFIGURED, random, 20)
    ]
    for number, axis in enumerate(np.eye(2)):
        before, after, pairs = flight[number]
        shifted = pairs.pixels_current + 30.0 * axis * (pairs.camera_names == "back")[:, None]
        flight[number] = before, after, replace(pairs, pixels_current=shifted)
    first = RigCalibration(CONFIGURED)
    for look in flight:
        first.update(*look)
    assert any(rig_faults(found) for found in first.deviations())
    for found in calibrated(CONFIGURED, flight).deviations():
        assert not rig_faults(found)
        assert off_deg(found, np.zeros(3)) < 0.5


def test_a_rig_as_configured_is_not_complained_of() -> None:
    random = np.random.default_rng(0)
    for way in (lively(random), STRAIGHT):
        for found in flown(way, AS_CONFIGURED, random, steps=60).deviations():
            assert rig_faults(found) == ()
            assert off_deg(found, np.zeros(3)) < 0.2 or way is STRAIGHT


@pytest.mark.parametrize(("sigmas", "told"), [(3.5, 0), (4.5, 3)])
def test_what_differs_by_less_than_one_in_ten_thousand_right_rigs_do_is_not_told(sigmas: float, told: int) -> None:
    """Three numbers as one exceed 3.9 standard deviations once in 608 times, 4.9 once in 40,000 (chi-squared)."""
    sigma = np.array([math.radians(0.5)] * 3 + [0.01, 0.01])
    turn = np.array([(sigmas + 0.4) * sigma[0], 0.0, 0.0])
    found = CameraDeviation(
        "front", turn, sigmas * sigma[3], math.exp(sigmas * sigma[4]), np.diag(sigma**2), np.zeros(2), sigma[:2]
    )
    assert len(rig_faults(found)) == told


def test_what_the_attitude_jitters_is_learnt_and_tells_no_mountings() -> None:
    """In still air a circle says little of how mountings are turned about the vertical, with or without jitter."""
    circle = Way(lambda t: rotation_from_euler(0.0, 0.0, 0.1 * t), lively(np.random.default_rng(0)).position)
    yaw_sigmas_deg = []
    for jitter_deg in (0.0, 0.3):
        found = flown(circle, AS_CONFIGURED, np.random.default_rng(1), 60, jitter_deg).deviations()
        assert not [text for one in found for text in rig_faults(one)]
        yaw_sigmas_deg.append(min(math.degrees(math.sqrt(one.covariance[2, 2])) for one in found))
    assert yaw_sigmas_deg[1] > 0.9 * yaw_sigmas_deg[0] > 0.7


def test_rows_that_are_read_one_after_the_other_turn_no_mounting() -> None:
    """A drone that leans over within a second, as when it starts: shutters of 30 ms shear that by a degree and more."""

    def attitude(t: float) -> FloatArray:
        lean = math.radians(25.0) * math.exp((t - 4.5) / 0.5)
        return rotation_from_euler(0.7 * lean, -lean, 0.1 * t)

    starting = Way(attitude, lively(np.random.default_rng(0)).position)
    at_once, in_rows = (
        flown(starting, AS_CONFIGURED, np.random.default_rng(1), 9, readout_s=readout_s).deviations()
        for readout_s in (0.0, 0.03)
    )
    for found, readout_s in ((at_once, 0.0), (in_rows, 0.03)):
        assert found[0].readout_s == pytest.approx([readout_s, 0.0], abs=0.002)
    assert rolling(at_once[0]) == ()
    (told,) = rolling(in_rows[0])
    assert "+31 +- 4 ms" in told
    for one, other in zip(at_once, in_rows, strict=True):
        assert rig_faults(one) == rig_faults(other) == ()
        assert np.degrees(other.turn) == pytest.approx(np.degrees(one.turn), abs=0.2)
        assert other.focal_scale == pytest.approx(one.focal_scale, abs=0.005)


def test_a_flight_that_never_turns_leaves_open_what_it_does_not_show() -> None:
    random = np.random.default_rng(0)
    for found in flown(STRAIGHT, Wrong.by(2.0, 0.02, 0.03, random), random).deviations():
        roll, pitch, yaw, time, focal = np.sqrt(np.diag(found.covariance))
        # Nothing but the way it went, to the north, tells of the mountings: not how they are turned about it, and
        # about the others as badly as the autopilot knows the way: 0.1 m/s of 1 m/s are 6 degrees at a time.
        assert math.degrees(roll) > 2.5
        assert 0.5 < math.degrees(pitch) < 3.0
        assert 0.5 < math.degrees(yaw) < 3.0
        assert time > 0.05
        assert focal > 0.02
        assert rig_faults(found) == ()


def test_twice_the_matches_tell_twice_as_much_also_where_half_are_left_out() -> None:
    random, right = np.random.default_rng(5), CONFIGURED.cameras["right"]
    pairs = seen_twice(boxes_around(random), CONFIGURED, (STRAIGHT.pose(0.0), STRAIGHT.pose(0.5)), EXACT, random)
    mine = np.flatnonzero(pairs.camera_names == "right")
    motion, told = RigidTransform(np.eye(3), right.T_body_camera.rotation.T @ np.array([0.5, 0.0, 0.0])), []
    for count in (300, 600):
        some = pairs[mine[np.linspace(0, len(mine) - 1, count).astype(np.int64)]]
        found = camera_motion(right, some, motion, 0.0)
        assert found is not None
        told.append(float(np.trace(found.information[:3, :3])))
    assert told[1] / told[0] == pytest.approx(2.0, rel=0.1)


def test_what_says_nothing_changes_nothing() -> None:
    random = np.random.default_rng(3)
    calibration, autopilot = RigCalibration(CONFIGURED), Autopilot(STRAIGHT, random)
    first, second = (seen(autopilot.state(t)) for t in (0.0, 0.5))
    pairs = seen_twice(World(np.empty((0, 2, 3))), CONFIGURED, (STRAIGHT.pose(0.0), STRAIGHT.pose(0.5)), EXACT, random)
    before = calibration.deviations()
    calibration.update(second, first, pairs)  # time that runs backwards
    calibration.update(first, replace(second, vehicle=replace(second.vehicle, time_s=60.0)), pairs)
    for one, other in zip(before, calibration.deviations(), strict=True):
        assert (one.turn == other.turn).all()
        assert (one.covariance == other.covariance).all()
    fast = replace(second.vehicle, velocity_ned=np.full(3, 1e300))
    for absurd in (fast, replace(second.vehicle, turn_rate=np.full(3, 1e200))):
        calibration.update(first, replace(second, vehicle=absurd), pairs)
    assert all(np.isfinite(one.turn).all() and np.isfinite(one.covariance).all() for one in calibration.deviations())
    calibration.update(first, second, pairs[np.arange(20)])  # too few to tell
    assert all(np.linalg.norm(one.turn) == 0.0 for one in calibration.deviations())


@pytest.mark.fault("camera-elsewhere")
def test_a_camera_that_is_upside_down_is_elsewhere_and_not_one_that_is_twenty_degrees_off() -> None:
    wrong = Wrong.turned({"front": (math.pi, 0.0, 0.0), "left": (math.radians(20.0), 0.0, 0.0)})
    found = flown(lively(np.random.default_rng(3)), wrong, np.random.default_rng(3), 20).deviations()
    assert [one.camera for one in found if one.elsewhere] == ["front"]
    assert rig_faults(found[0])[0].startswith("camera front: it moves otherwise than the drone")
