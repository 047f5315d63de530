"""The pure line on rendered frames, with perception answered by the truth: what is left is the pilot's own doing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.mission import MissionParameters
from flockd.core.messages import (
    SECTORS,
    Float32Array,
    FloatArray,
    Frame,
    FrameSet,
    MissionOrder,
    Reason,
    ReasonKind,
    VehicleState,
    Wanted,
)
from flockd.flight.geometry import RigCamera, rotation_angle_deg, rotation_from_euler
from flockd.flight.perception import Observation, SceneMaps
from flockd.flight.pilot import FlockPilot
from flockd.flight.tracking import Tracker
from flockd.sim.scenario import SensorConfig, StartConfig, VehicleConfig
from flockd.sim.vehicles.vehicles import SimulatedAutopilot, Vehicles
from tests.flight.pilot.flyer import STEP_S, Flyer, SpoilableTruth, scenario_with
from tests.make import changed, detection, frames, neighbour, vehicle

NEVER_ASKED = SpoilableTruth()
"""Networks of a pilot that gets no images."""
ALONE = scenario_with((0.0, 0.0, -4.0))


@pytest.fixture
def flyer() -> Flyer:
    """With a neighbour 3 m ahead."""
    return Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -3.6)))


def without(frames: FrameSet, camera: str) -> FrameSet:
    return FrameSet(frames.time_s, {name: frame for name, frame in frames.frames.items() if name != camera})


@pytest.mark.fault("time-stamps-backwards")
def test_true_maps_give_true_motions_and_a_repeated_time_stamp_restarts_the_pair() -> None:
    """A neighbour 3 m ahead to the right: after the turn on the border between the front and the right camera."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (1.8, 2.4, -3.6)))
    first = flyer.step()
    assert first.ego_motion is None
    before = flyer.vehicles
    R_before, p_before = before.R_ned_body[0], before.position[0]
    flyer.move()
    second = flyer.step()
    after = flyer.vehicles
    assert second.ego_motion is not None
    true_translation = R_before.T @ (after.position[0] - p_before)
    assert np.allclose(second.ego_motion.translation, true_translation, atol=0.002)
    assert rotation_angle_deg(second.ego_motion.rotation.T @ R_before.T @ after.R_ned_body[0]) < 0.02
    assert second.velocity is not None
    assert np.allclose(second.velocity, (after.position[0] - p_before) / STEP_S, atol=0.005)
    assert len(second.neighbours) == 1, "a neighbour that straddles two cameras is one neighbour"
    assert np.allclose(second.neighbours[0].position, after.position[1] - after.position[0], atol=0.02)
    (detection,) = second.detections
    assert set(detection.cameras) == {"front", "right"}
    again = flyer.step()
    assert again.ego_motion is None
    assert any(reason.kind is ReasonKind.PAIR for reason in again.reasons)


@pytest.mark.parametrize(("gone", "less_probable"), [("front", False), ("back", True)])
def test_a_neighbour_before_a_camera_that_is_gone_is_as_probable_as_before(
    flyer: Flyer, gone: str, less_probable: bool
) -> None:
    """It flies ahead and then is not found twice: because no camera points there, or although one does."""
    for _ in range(3):
        (before,) = flyer.step().neighbours
        flyer.move()
    flyer.vehicles.position[1] += [0.0, 0.0, -60.0]  # far above, where no camera points
    for _ in range(2):
        frames, state = flyer.take_frames()
        output = flyer.pilot.step(without(frames, gone), state)
        flyer.move()
    (neighbour,) = output.neighbours
    assert neighbour.unseen_s == pytest.approx(2 * STEP_S)
    left = neighbour.existence_probability / before.existence_probability
    assert left == pytest.approx(np.exp(-2 * STEP_S / 60.0), rel=1e-3) or less_probable, "only leaving counts, 60 s"
    assert (left < 0.95) is less_probable


@pytest.mark.fault("blind-sector")
@pytest.mark.parametrize("gone", ["front", "back"])
def test_the_gate_is_told_how_far_was_seen_and_the_heading_turns_to_where_a_camera_looks(
    flyer: Flyer, gone: str
) -> None:
    """The mission leads north, where the front camera looks. What was seen up to 15 m away fades in three seconds."""
    ahead_m, behind_m, turned_deg = [], [], []
    for step in range(9):
        frames, state = flyer.take_frames()
        output = flyer.pilot.step(without(frames, gone) if step >= 2 else frames, state)
        assert output.obstacles is None, "none were looked for"
        assert output.seen_m is not None and output.command.yaw_rad is not None
        ahead_m.append(float(output.seen_m[0]))
        behind_m.append(float(output.seen_m[SECTORS // 2]))
        assert output.seen_m[SECTORS // 4] == 15.0
        turned_deg.append(abs(math.degrees(output.command.yaw_rad)))
        flyer.move()
    faded_m, seen_m = (ahead_m, behind_m) if gone == "front" else (behind_m, ahead_m)
    assert seen_m == [15.0] * 9
    assert faded_m[:2] == [15.0] * 2
    assert faded_m[2] == pytest.approx(15.0 - 2.5 - 0.5 * float(np.hypot(*flyer.vehicles.velocity[0, :2])), abs=0.15)
    assert faded_m[-1] == 0.0
    assert (max(turned_deg) > 30.0) is (gone == "front")
    refused = flyer.pilot.step(frames, replace(state, height_m=math.nan))
    assert refused.command.yaw_rad == output.command.yaw_rad
    assert refused.seen_m is not None and refused.seen_m[0] == pytest.approx(ahead_m[-1])


@pytest.mark.fault("one-that-does-not-avoid")
@pytest.mark.parametrize(("east_m", "side"), [(0.0, 1.0), (99.5, -1.0)])
def test_beside_the_fence_it_makes_way_to_the_other_side(
    east_m: float, side: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One comes head-on; on the right, where it would turn to, is the fence 100 m from home."""
    monkeypatch.setattr(Tracker, "neighbours", lambda _: (neighbour([6.0, 0.0, 0.0], [-1.0, 0.0, 0.0]),))
    output = FlockPilot(ALONE.drone, NEVER_ASKED).step(frames(0.0), vehicle(position=[0.0, east_m]))
    assert side * output.command.velocity[1] > 0.3


def test_a_neighbour_pulls_by_how_long_it_has_been_seen() -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (8.0, 0.0, -3.6), sharp=True))
    other = FlockPilot(changed(flyer.scenario.drone, flocking__cohesion_time_s=None), flyer.truth)
    for step in range(4):
        frames, state = flyer.take_frames()
        ours, papers = flyer.pilot.step(frames, state), other.step(frames, state)
        flyer.move()
        if step > 1:
            (neighbour,) = ours.neighbours
            whole = 0.1 * (d := float(np.hypot(*neighbour.position[:2]))) * math.log(d / 3.5)
            lacking = papers.command.acceleration[0] - ours.command.acceleration[0]
            assert neighbour.confirmed and neighbour.age_s == pytest.approx(step * STEP_S)
            assert lacking == pytest.approx(max(whole - 2.0 * (neighbour.age_s / 5.0) ** 2, 0.0), abs=0.05)


@pytest.mark.fault("network-not-finite")
@pytest.mark.parametrize(
    ("role", "of_behind", "kind", "text"),
    [
        ("scene", lambda frame, *_: frame.camera == "back", ReasonKind.CAMERA, "camera back: model x: not finite"),
        ("flow", lambda _, second, __: second.camera == "back", ReasonKind.CAMERA, "camera back: model x: not finite"),
        (
            "ranges", lambda crops: any(crop.R_body_camera[0, 2] < 0.0 for crop in crops),
            ReasonKind.PROPOSAL, "proposal: model x: not finite",
        ),
    ],
    ids=["an output costs its frame", "a flow its camera", "a range its proposal"],
)  # fmt: skip
def test_what_is_not_finite_costs_no_more_than_what_it_is_of(
    role: str, of_behind: Callable[..., bool], kind: ReasonKind, text: str
) -> None:
    """Two neighbours, ahead and behind; the network fails on what is behind, and on any batch of crops with it."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -3.6), (-3.0, 0.0, -3.6)))
    sound = flyer.truth.sound(role)

    def spoilt(*given: Any) -> Any:
        if of_behind(*given):
            raise FloatingPointError("model x: not finite")
        return sound(*given)

    flyer.truth.instead[role] = spoilt
    flyer.step()
    flyer.move()
    output = flyer.step()
    assert Reason(kind, text) in output.reasons
    assert {reason.kind for reason in output.reasons} == {kind}
    assert output.ego_motion is not None
    ahead = [detection.position[0] > 0.0 for detection in output.detections]
    assert sorted(ahead) == ([False, True] if role == "flow" else [True])


@pytest.mark.parametrize("still_there", [True, False])
def test_a_drone_that_segmentation_misses_is_found_where_it_is_predicted(flyer: Flyer, still_there: bool) -> None:
    for _ in range(3):
        flyer.step()
        flyer.move()
    sound = flyer.truth.sound("scene")

    def blind(frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        scene = sound(frame, camera, ground)
        return SceneMaps(scene.depth, np.zeros_like(scene.labels), ())

    flyer.truth.instead["scene"] = blind
    if not still_there:
        flyer.vehicles.position[1] += [0.0, 40.0, 0.0]
    output = flyer.step()
    assert len(output.detections) == (1 if still_there else 0)
    if still_there:
        place = flyer.vehicles.R_ned_body[0] @ output.detections[0].position
        assert np.allclose(place, flyer.vehicles.position[1] - flyer.vehicles.position[0], atol=0.02)


@pytest.mark.parametrize(("height_m", "blind"), [(0.0, 2), (-0.5, 4), (-2.0, 4)], ids=["at", "below", "far below"])
def test_at_the_ground_or_below_there_is_no_depth_and_the_flight_goes_on_above(
    flyer: Flyer, height_m: float, blind: int
) -> None:
    """At a height of 0, a tilted drone has cameras on one side below the ground."""
    flyer.step()
    flyer.move()
    frames, state = flyer.take_frames()
    output = flyer.pilot.step(frames, replace(state, height_m=height_m))
    assert sum("is not above the ground" in reason.text for reason in output.reasons) >= blind
    assert output.ego_motion is None or blind < len(frames.frames)
    assert np.isfinite(output.command.velocity).all()
    flyer.move()
    flyer.step()
    flyer.move()
    assert flyer.step().ego_motion is not None


def blown_about(yaw: str, *headings_rad: float, height_m: float = 4.0) -> list[float | None]:
    """The headings that are asked for while the wind turns a drone without cameras."""
    pilot = FlockPilot(changed(ALONE.drone, yaw=yaw, mission=MissionParameters(kind="hover")), NEVER_ASKED)
    asked = []
    for i, heading_rad in enumerate(headings_rad):
        state = vehicle(float(i), height_m, R_ned_body=rotation_from_euler(0.0, 0.0, heading_rad))
        asked.append(pilot.step(frames(float(i)), state).command.yaw_rad)
    return asked


@pytest.mark.parametrize("yaw", ["hold", "course"])
@pytest.mark.parametrize(
    ("headings_rad", "height_m", "asked_rad"),
    [
        ((1.0, 1.2, 0.7, -3.0), 4.0, (1.0, 1.0, 1.0, 1.0)),  # whatever the wind makes of it
        ((2.0, 2.1), math.nan, (2.0, 2.0)),  # refused before its first good step
        ((math.nan, 2.0, 2.5), 4.0, (None, 2.0, 2.0)),  # before any good attitude
    ],
)
def test_a_heading_to_hold_is_the_first_good_one(
    yaw: str, headings_rad: tuple[float, ...], height_m: float, asked_rad: tuple[float | None, ...]
) -> None:
    """With `course`, where the mission has none."""
    assert blown_about(yaw, *headings_rad, height_m=height_m) == [one and pytest.approx(one) for one in asked_rad]


def test_an_order_turns_a_hovering_drone_no_faster_than_images_allow() -> None:
    """It looks east, and is to fly south-west: 0.2 rad/s, in steps of a second."""
    pilot, asked = FlockPilot(changed(ALONE.drone, mission=MissionParameters(kind="hover")), NEVER_ASKED), []
    for i, order in enumerate((None, MissionOrder(velocity=np.array([-1.0, -1.0])), None)):
        state = vehicle(float(i), R_ned_body=rotation_from_euler(0.0, 0.0, math.pi / 2))
        asked.append(pilot.step(frames(float(i)), state, order=order).command.yaw_rad)
    assert asked == pytest.approx([math.pi / 2 + 0.2 * i for i in range(3)])


def test_where_a_step_is_refused_the_drone_stays_at_the_height_of_its_mission() -> None:
    """Not at that of the flight's beginning, 4 m: between them may be a hill or another drone."""
    mission = MissionParameters(kind="hover", height_m=7.0)
    pilot = FlockPilot(changed(ALONE.drone, mission=mission), NEVER_ASKED)
    for state in (vehicle(0.0, 4.0), replace(vehicle(1.0, 6.9), velocity_ned=np.full(3, math.nan))):
        output = pilot.step(frames(state.time_s), state)
    assert [reason.kind for reason in output.reasons] == [ReasonKind.INPUT]
    assert output.command.height_m == 7.0


@pytest.mark.fault("ground-rises")
@pytest.mark.parametrize(
    ("slope", "speed_m_s", "climbs", "least_m"), [(0.15, 1.0, True, 0.8), (0.3, 1.2, True, 0.8), (0.2, 1.0, False, 0.2)]
)
def test_before_ground_that_rises_it_climbs_or_else_stops(
    slope: float, speed_m_s: float, climbs: bool, least_m: float
) -> None:
    """2 m above the ground, which rises from 6 m on, with the autopilot's errors and response: 1 m is to be kept. Or
    another drone above prevents the climb."""
    mission = MissionParameters(kind="velocity", velocity_m_s=(speed_m_s, 0.0))
    pilot = FlockPilot(changed(ALONE.drone, mission=mission, perception__height="best"), NEVER_ASKED)

    def ground(north: FloatArray, _: FloatArray) -> FloatArray:
        return np.maximum((north - 6.0) * slope, 0.0)

    start, sensors = StartConfig(position_m=(0.0, 0.0, -2.0), velocity_m_s=(speed_m_s, 0.0)), SensorConfig()
    flown = Vehicles([start], VehicleConfig(), sensors=sensors)
    autopilot = SimulatedAutopilot(sensors, seed=0, drone=0, ground=ground)
    commands, above_m, height_m = list[Wanted](), list[float](), 2.0
    for time_s in np.arange(0.0, 20.0, STEP_S).tolist():
        moving = flown.position[0], flown.velocity[0], flown.R_ned_body[0]
        state = autopilot.read(time_s, *moving, errors=flown.errors[0])
        commands.append(pilot.step(frames(time_s), state).command)
        for command in (commands[-2:][0], commands[-1]):  # half a step after the images
            height_m = command.height_m if climbs and command.height_m is not None else height_m
            flown.step(command.velocity[None], np.zeros(1), STEP_S / 2, np.array([height_m]))
            above_m.append(-flown.position[0, 2] - float(ground(*flown.position[0, :2])))
    assert min(above_m) >= least_m
    for lost in (replace(state, height_m=math.nan), replace(state, ground_range=None)):  # not down into the hill
        kept_m = pilot.step(frames(lost.time_s), lost).command.height_m
        assert kept_m is not None and kept_m > float(ground(*flown.position[0, :2])) + 0.8


def test_input_that_cannot_be_is_refused_and_the_next_step_is_as_if_it_had_not_come(flyer: Flyer) -> None:
    flyer.step()
    changes: dict[str, list[Any]] = {
        "frames_s": [math.nan, math.inf],
        "time_s": [math.nan],
        "R_ned_body": [np.full((3, 3), math.nan), 2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0])],
        "height_m": [-math.inf],
        "velocity_ned": [np.array([0.0, math.nan, 0.0])],
    }
    taken, state = flyer.take_frames()
    for field, value in ((field, value) for field, values in changes.items() for value in values):
        shown = FrameSet(value, taken.frames) if field == "frames_s" else taken
        output = flyer.pilot.step(shown, state if field == "frames_s" else replace(state, **{field: value}))
        (reason,) = output.reasons
        assert reason.kind is ReasonKind.INPUT
        assert {"R_ned_body": "attitude", "height_m": "height", "velocity_ned": "velocity"}.get(field, "time") in (
            reason.text
        )
        np.testing.assert_array_equal(output.command.velocity, [0.0, 0.0])
        assert output.command.yaw_rad is not None
        assert np.isfinite([output.time_s, output.command.yaw_rad]).all()
    flyer.move()
    after = flyer.step()
    assert after.reasons == ()
    assert after.ego_motion is not None
    assert after.ego_motion.interval_s == pytest.approx(STEP_S)


@pytest.mark.parametrize("off", [1e-7, 3e-5, 4e-4])
def test_an_attitude_that_is_rounded_is_flown_with(flyer: Flyer, off: float) -> None:
    """A share by which its axes are too long; 5e-4 is refused, as R R^T is then off by 1e-3."""
    for _ in range(2):
        flyer.move()
        frames, state = flyer.take_frames()
        output = flyer.pilot.step(frames, replace(state, R_ned_body=(1.0 + off) * state.R_ned_body))
    assert output.reasons == ()
    assert output.ego_motion is not None
    (neighbour,) = output.neighbours
    true = flyer.vehicles.position[1] - flyer.vehicles.position[0]
    assert np.allclose(neighbour.position, true, atol=0.02)


def test_a_detection_that_the_tracker_refuses_costs_that_neighbour_only() -> None:
    """Two neighbours: one's probability came out above 1."""
    sound = detection((3.0, 0.0, 0.0))
    spoilt = replace(detection((0.0, 3.0, 0.0), label=2), drone_probability=1.5)

    class Observer:
        last = None

        def observe(self, frames: FrameSet, vehicle: VehicleState, *_: object) -> Observation:
            return Observation(frames.time_s, vehicle, {}, (spoilt, sound), None)

    observer: Any = Observer()
    output = FlockPilot(ALONE.drone, NEVER_ASKED, observer=observer).step(frames(0.0), vehicle(height_m=4.0))
    assert [reason.kind for reason in output.reasons] == [ReasonKind.NEIGHBOUR]
    assert output.detections == (sound,)
    assert output.detection_tracks == tuple(neighbour.track for neighbour in output.neighbours)


def test_an_autopilot_that_contradicts_the_images_is_told_and_setpoints_are_corrected_within_limits() -> None:
    """It is 2 m/s wrong, which no autopilot is, and the drone is to fly at the law's limit."""
    limits = {"flocking__max_speed_m_s": 3.5, "safety__gate__max_speed_m_s": 4.0, "mission__speed_m_s": 3.5}
    drone = changed(ALONE.drone, autopilot=AutopilotParameters(max_velocity_trim_m_s=0.5), **limits)
    flyer, told = Flyer(ALONE.model_copy(update={"drone": drone})), []
    for _ in range(5):
        frames, state = flyer.take_frames()
        wrong = replace(state, velocity_ned=flyer.vehicles.velocity[0] + np.array([2.0, 0.0, 0.0]))
        output = flyer.pilot.step(frames, wrong)
        told.append((output.ego_motion is not None, *(reason.text.split()[2] for reason in output.reasons)))
        assert np.linalg.norm(output.command.velocity) <= 4.0 + 1e-12
        flyer.move()
    assert told == [(False,), (False, "show"), (True, "and"), (True, "and"), (True, "and")], "refused once"
    assert output.command.trim == pytest.approx([0.5, 0.0], abs=0.01)


class Comes:
    """Sees one that hovers 12 m north of where a drone begins, which flies at it at 2 m/s; no image shows a motion."""

    def __init__(self) -> None:
        self.last: Observation | None = None
        self.sees = True

    def observe(self, frames: FrameSet, vehicle: VehicleState, *_: object) -> Observation:
        seen = (detection((12.0 - 2.0 * frames.time_s, 0.0, 0.0)),) if self.sees else ()
        self.last = Observation(frames.time_s, vehicle, {}, seen, self.last and replace(self.last, previous=None))
        return self.last


@pytest.mark.parametrize("lost", ["own motion", "attitude"])
def test_where_images_or_attitude_are_lost_neighbours_come_on_by_the_velocity_that_is_known(lost: str) -> None:
    """Detected for two seconds, by the autopilot's velocity; then not for one: it is 6 m away, not 8."""
    observer: Any = Comes()
    pilot = FlockPilot(changed(ALONE.drone, own_velocity="autopilot"), NEVER_ASKED, observer=observer)
    for step in range(7):
        time_s = STEP_S * step
        state = vehicle(time_s, 4.0, velocity_ned=np.array([2.0, 0.0, 0.0]))
        observer.sees = step < 5
        if lost == "attitude" and step >= 5:
            state = replace(state, R_ned_body=np.full((3, 3), math.nan))
        output = pilot.step(frames(time_s), state)
    (neighbour,) = output.neighbours
    assert output.ego_motion is None and output.time_s == time_s
    assert neighbour.unseen_s == pytest.approx(1.0)
    assert neighbour.position[0] == pytest.approx(6.0, abs=0.3)
    at_last = pilot.step(frames(1e308), vehicle(1e308, 4.0, velocity_ned=np.array([2.0, 0.0, 0.0])))
    assert at_last.neighbours == () and np.isfinite(at_last.command.velocity).all(), "whatever the time is"
