"""A rig that is not as configured, found in flight: exact poses, an analytic world, and errors of known size."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from flockd.core.messages import CameraDeviation, FloatArray, VehicleState
from flockd.flight.geometry import (
    PointPairs,
    Rig,
    RigCalibration,
    RigCamera,
    RigidTransform,
    Seen,
    rig_faults,
    rolling,
    rotation_from_euler,
    rotation_from_vector,
    vector_from_rotation,
)
from flockd.flight.geometry.camera_motion import camera_motion, scaled_focal
from tests.flight.geometry.synthetic_world import EXACT, Flaws, World, boxes_around, four_camera_rig, seen_twice

pytestmark = pytest.mark.fault("rig-off")

STEP_S = 0.5
FLAWS = Flaws(flow_sigma_px=0.3, depth_sigma=0.1, object_bias=0.1, outliers=0.03)


@dataclass(frozen=True)
class Way:
    """How a drone flies."""

    attitude: Callable[[float], FloatArray]
    position: Callable[[float], FloatArray]

    def pose(self, time_s: float) -> RigidTransform:
        return RigidTransform(self.attitude(time_s), self.position(time_s))


def lively(random: np.random.Generator) -> Way:
    """A circle of 10 m at 1 m/s, nose ahead, that leans and sways by some degrees at 0.1-0.9 Hz."""
    hz, phase = random.uniform(0.1, 0.9, (3, 6)), random.uniform(0.0, 2 * np.pi, (3, 6))

    def attitude(t: float) -> FloatArray:
        roll, pitch, yaw = math.radians(1.5) * np.sin(2 * np.pi * hz * t + phase).sum(axis=1)
        return rotation_from_euler(roll, pitch, yaw + 0.1 * t)

    return Way(attitude, lambda t: np.array([10 * math.sin(0.1 * t), 10 - 10 * math.cos(0.1 * t), -4.5]))


STRAIGHT = Way(lambda t: np.eye(3), lambda t: np.array([t, 0.0, -4.5]))
"""At 1 m/s, and never turns."""


class Autopilot:
    """The truth with errors that drift, attitude 0.2 degrees in 30 s, velocity 0.1 m/s in 10 s, and with jitter."""

    def __init__(self, way: Way, random: np.random.Generator, jitter_deg: float = 0.0) -> None:
        self._way, self._random, self._jitter_rad = way, random, math.radians(jitter_deg)
        self._turned, self._moved = (sigma * random.normal(size=3) for sigma in (math.radians(0.2), 0.1))

    def state(self, t: float) -> VehicleState:
        self._turned = self._drift(self._turned, math.radians(0.2), 30.0)
        self._moved = self._drift(self._moved, 0.1, 10.0)
        before, after = self._way.pose(t - 1e-3), self._way.pose(t + 1e-3)
        return VehicleState(
            t,
            rotation_from_vector(self._turned + self._jitter()) @ self._way.attitude(t),
            4.5,
            (after.translation - before.translation) / 2e-3 + self._moved,
            turn_rate=vector_from_rotation(before.rotation.T @ after.rotation) / 2e-3,
        )

    def _jitter(self) -> FloatArray:
        return self._jitter_rad * self._random.normal(size=3) if self._jitter_rad else np.zeros(3)

    def _drift(self, error: FloatArray, sigma: float, time_s: float) -> FloatArray:
        keep = math.exp(-STEP_S / time_s)
        return keep * error + math.sqrt(1 - keep**2) * sigma * self._random.normal(size=3)


@dataclass(frozen=True)
class Wrong:
    """What of a rig is not as configured: turns in body axes, rad, factors of focal lengths, and late time stamps."""

    turns: dict[str, FloatArray]
    focal: dict[str, float]
    late_s: float = 0.0

    @classmethod
    def turned(cls, turns: Mapping[str, Sequence[float]]) -> Wrong:
        """In nothing but how these are mounted."""
        names = CONFIGURED.cameras
        return cls({name: np.array(turns.get(name, (0.0, 0.0, 0.0))) for name in names}, dict.fromkeys(names, 1.0))

    @classmethod
    def by(cls, deg: float, focal: float, late_s: float, random: np.random.Generator) -> Wrong:
        """Each camera about an axis and with a focal length of its own."""
        axes = {name: random.normal(size=3) for name in CONFIGURED.cameras}
        return cls(
            {name: math.radians(deg) * axis / np.linalg.norm(axis) for name, axis in axes.items()},
            {name: 1.0 + focal * float(random.choice([-1, 1])) for name in axes},
            late_s,
        )

    def rig(self) -> Rig:
        turned = {
            name: RigidTransform(
                rotation_from_vector(self.turns[name]) @ one.T_body_camera.rotation, one.T_body_camera.translation
            )
            for name, one in CONFIGURED.cameras.items()
        }
        focal = {name: math.log(factor) for name, factor in self.focal.items()}
        lenses = {name: scaled_focal(one.camera, focal[name]) for name, one in CONFIGURED.cameras.items()}
        return Rig({name: RigCamera(name, lenses[name], mount) for name, mount in turned.items()})


CONFIGURED = four_camera_rig()
AS_CONFIGURED = Wrong.turned({})


def flown(
    way: Way,
    wrong: Wrong,
    random: np.random.Generator,
    steps: int = 120,
    jitter_deg: float = 0.0,
    said: Way | None = None,
    readout_s: float = 0.0,
) -> RigCalibration:
    """The filter after so many steps of half a second; `said`: the way that the autopilot tells, if another."""
    true, calibration = wrong.rig(), RigCalibration(CONFIGURED)
    world, autopilot = boxes_around(random, 20), Autopilot(said or way, random, jitter_deg)
    before = None
    for number in range(steps + 1):
        t = number * STEP_S
        seen, pose = Seen(autopilot.state(t), t, dict.fromkeys(true.cameras, t)), way.pose(t - wrong.late_s)
        if before is not None:
            pairs = seen_twice(world, true, (before[1], pose), FLAWS, random, stride=24)
            rates = before[0].vehicle.turn_rate, seen.vehicle.turn_rate
            pairs = read_out(pairs, true, rates, readout_s) if readout_s else pairs
            calibration.update(before[0], seen, lifted_as_configured(pairs, true))
        before = seen, pose
    return calibration


def lifted_as_configured(pairs: PointPairs, true: Rig) -> PointPairs:
    """The same pixels and ranges where the configuration puts them."""
    previous = pairs.previous.copy()
    for name, one in CONFIGURED.cameras.items():
        mine = pairs.camera_names == name
        range_m = np.linalg.norm(previous[mine] - true.cameras[name].T_body_camera.translation, axis=1)
        previous[mine] = one.T_body_camera.apply(one.camera.unproject(pairs.pixels_previous[mine], range_m))
    return replace(pairs, previous=previous)


def read_out(
    pairs: PointPairs, rig: Rig, rates: tuple[FloatArray | None, FloatArray | None], readout_s: float
) -> PointPairs:
    """The pixels where columns, read from left to right, see them while the camera turns; small turns."""
    moved = []
    for pixels, rate in zip((pairs.pixels_previous, pairs.pixels_current), rates, strict=True):
        assert rate is not None
        there = pixels.copy()
        for name, one in rig.cameras.items():
            mine = pairs.camera_names == name
            rays = one.camera.rays(pixels[mine])
            passing = -np.cross(one.T_body_camera.rotation.T @ rate, rays)
            read_s = (pixels[mine, 0] / one.camera.size[0] - 0.5) * readout_s
            there[mine] += np.einsum("nij,nj->ni", one.camera.jacobian(rays), passing) * read_s[:, None]
        moved.append(there)
    return replace(pairs, pixels_previous=moved[0], pixels_current=moved[1])


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


def test_a_rig_as_configured_is_not_complained_of() -> None:
    random = np.random.default_rng(0)
    for way in (lively(random), STRAIGHT):
        for found in flown(way, AS_CONFIGURED, random, steps=60).deviations():
            assert rig_faults(found) == ()
            assert off_deg(found, np.zeros(3)) < 0.2 or way is STRAIGHT


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
        some = pairs.select(mine[np.linspace(0, len(mine) - 1, count).astype(np.int64)])
        found = camera_motion(right, some, motion, 0.0)
        assert found is not None
        told.append(float(np.trace(found.information[:3, :3])))
    assert told[1] / told[0] == pytest.approx(2.0, rel=0.1)


def test_what_says_nothing_changes_nothing() -> None:
    random = np.random.default_rng(3)
    calibration, autopilot = RigCalibration(CONFIGURED), Autopilot(STRAIGHT, random)
    first, second = (Seen(autopilot.state(t), t, dict.fromkeys(CONFIGURED.cameras, t)) for t in (0.0, 0.5))
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
    calibration.update(first, second, pairs.select(np.arange(20)))  # too few to tell
    assert all(np.linalg.norm(one.turn) == 0.0 for one in calibration.deviations())


@pytest.mark.fault("camera-elsewhere")
@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({}, ()),
        ({"front": (math.radians(20.0), 0.0, 0.0)}, ()),
        ({"front": (math.pi, 0.0, 0.0)}, ("front",)),
        ({"left": (0.0, -math.pi / 2, 0.0)}, ("left",)),
        ({"front": (0.0, 0.0, math.pi), "back": (0.0, 0.0, math.pi)}, ("front", "back")),
    ],
    ids=["as configured", "20 degrees off", "upside down", "on its side", "two swapped"],
)
def test_a_camera_that_is_upside_down_or_another_one_is_said(
    wrong: dict[str, tuple[float, ...]], named: tuple[str, ...]
) -> None:
    """The rotation vectors are in body axes."""
    random = np.random.default_rng(3)
    calibration = flown(lively(random), Wrong.turned(wrong), random, 40)
    assert calibration.elsewhere() == named
    told = [text for one in calibration.deviations() for text in rig_faults(one) if "moves otherwise" in text]
    assert [text.partition(":")[0] for text in told] == [f"camera {name}" for name in named]
    assert {one.camera for one in calibration.deviations() if one.elsewhere} == set(named)


def test_who_walks_before_a_drone_that_stands_still_makes_no_camera_one_that_is_elsewhere() -> None:
    """All that its cameras see moves."""
    random, still = np.random.default_rng(3), Way(lambda t: np.eye(3), lambda t: np.array([0.0, 0.0, -4.5]))
    found = flown(lively(random), AS_CONFIGURED, random, 40, said=still)
    assert not [one.camera for one in found.deviations() if one.elsewhere]


def test_where_most_cameras_contradict_the_autopilot_none_is_flown_without() -> None:
    random = np.random.default_rng(3)
    upside_down = dict.fromkeys(("front", "left", "back"), (math.pi, 0.0, 0.0))
    calibration = flown(lively(random), Wrong.turned(upside_down), random, 40)
    assert {one.camera for one in calibration.deviations() if one.elsewhere} == set(upside_down)
    assert calibration.elsewhere() == ()
