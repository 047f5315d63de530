"""The pure line on rendered frames, with perception answered by the truth: what is left is the pilot's own doing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.config import ScenarioConfig, load_scenario
from flockd.data import data_path
from flockd.geometry import rotation_angle_deg
from flockd.messages import UNCLASSED, BoolArray, Float32Array, FrameSet, PilotOutput, UInt8Array, VehicleState
from flockd.perception import Instance, Picture, RangeEstimate, SceneMaps
from flockd.pilot import FlockPilot, views
from flockd.pilot.outlines import Claim, Outlines
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.truth_perception import ROLES, TruthPerception
from flockd.sim.vehicles import Vehicles

STEP_S = 0.5
CRUISE = np.array([[1.0, 0.0], [0.8, 0.2]])
TURNED = np.array([0.2, 0.0])


class NoNetworks:
    """Stands where the networks would; every role is answered by the truth before it comes here."""

    picture_size = 96
    map_scale = 2
    has_distance = True

    def flow(self, camera: str, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
        raise AssertionError("asked for a learned flow")

    def scene(self, camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        raise AssertionError("asked for a learned scene")

    def ranges(self, pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        raise AssertionError("asked for a learned range")


def scenario_with(*places: tuple[float, float, float]) -> ScenarioConfig:
    scenario = load_scenario(data_path("config") / "paper_flight.yaml", {"seed": 4})
    start = scenario.vehicles[0]
    drones = tuple(start.model_copy(update={"position_m": place, "velocity_m_s": (1.0, 0.0)}) for place in places)
    return scenario.model_copy(update={"vehicles": drones})


class Flyer:
    """Drone 0 of a scenario, flying with true maps while the others fly as told."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self.scenario = scenario
        self.camera_simulator = CameraSimulator(scenario)
        self.truth = TruthPerception(NoNetworks(), frozenset(ROLES), self.camera_simulator.rig)
        self.pilot = FlockPilot(scenario.drone, self.truth)
        self.vehicles = Vehicles(scenario.vehicles, scenario.vehicle)
        self.time_s = 100.0
        self.steps = 0

    def look(self) -> tuple[FrameSet, VehicleState]:
        frames, shot = self.camera_simulator.capture(0, self.steps, self.time_s, self.vehicles)
        self.truth.show(shot)
        v = self.vehicles
        return frames, VehicleState(self.time_s, v.R_ned_body[0], -float(v.position[0, 2]), v.velocity[0])

    def step(self) -> PilotOutput:
        return self.pilot.step(*self.look())

    def move(self) -> None:
        count = len(self.scenario.vehicles)
        self.vehicles.step(CRUISE[:count], TURNED[:count], STEP_S)
        self.time_s += STEP_S
        self.steps += 1


@pytest.fixture(scope="module")
def flyer() -> Flyer:
    """A neighbour 3 m ahead to the right: after the turn on the border between the front and the right camera."""
    return Flyer(scenario_with((0.0, 0.0, -4.0), (1.8, 2.4, -3.6)))


def test_true_maps_give_true_motions(flyer: Flyer) -> None:
    first = flyer.step()
    assert first.ego_motion is None
    before = flyer.vehicles
    R_before, p_before = before.R_ned_body[0], before.position[0]
    q_before = before.position[1]
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
    (motion,) = second.neighbour_motions.values()
    assert np.allclose(R_before @ motion.velocity, (after.position[1] - q_before) / STEP_S, atol=0.1)
    (detection,) = second.detections
    assert set(detection.cameras) == {"front", "right"}


def test_a_repeated_time_stamp_restarts_the_pair_and_says_so(flyer: Flyer) -> None:
    flyer.step()
    output = flyer.step()
    assert output.ego_motion is None
    assert any("time stamps" in reason for reason in output.reasons)


def test_the_rest_of_the_rig_flies_on_without_one_camera() -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -3.6)))
    flyer.step()
    flyer.move()
    frames, state = flyer.look()
    without_left = FrameSet(frames.time_s, {n: f for n, f in frames.frames.items() if n != "left"})
    output = flyer.pilot.step(without_left, state)
    assert output.counts["camera left: no frame"] == 1
    assert output.ego_motion is not None
    assert len(output.detections) == 1


@pytest.mark.parametrize(("gone", "confirmed"), [("front", True), ("back", False)])
def test_a_neighbour_before_a_camera_that_is_gone_stays_confirmed(gone: str, confirmed: bool) -> None:
    """It flies ahead and then is not found twice: because nobody looks there, or although somebody does."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -3.6)))
    for _ in range(3):
        assert len(flyer.step().detections) == 1
        flyer.move()
    flyer.vehicles.position[1] += [0.0, 0.0, -60.0]  # far above, where no camera looks
    for _ in range(2):
        frames, state = flyer.look()
        output = flyer.pilot.step(FrameSet(frames.time_s, {n: f for n, f in frames.frames.items() if n != gone}), state)
        flyer.move()
    (neighbour,) = output.neighbours
    assert neighbour.unseen_s == pytest.approx(2 * STEP_S)
    assert neighbour.confirmed is confirmed


def test_a_network_gone_astray_costs_its_frame_only(monkeypatch: pytest.MonkeyPatch) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -3.6)))
    sound = flyer.truth.scene

    def astray(camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        if camera == "back":
            raise FloatingPointError("model x: output depth is not finite")
        return sound(camera, image, geometry)

    monkeypatch.setattr(flyer.truth, "scene", astray)
    flyer.step()
    flyer.move()
    output = flyer.step()
    assert output.counts["camera back: model x: output depth is not finite"] == 1
    assert output.ego_motion is not None


@pytest.mark.parametrize("still_there", [True, False])
def test_a_drone_that_segmentation_misses_is_seen_where_it_is_expected(
    monkeypatch: pytest.MonkeyPatch, still_there: bool
) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -3.6)))
    for _ in range(3):
        flyer.step()
        flyer.move()
    sound = flyer.truth.scene

    def blind(camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        scene = sound(camera, image, geometry)
        return SceneMaps(scene.depth, np.zeros_like(scene.labels), ())

    monkeypatch.setattr(flyer.truth, "scene", blind)
    if not still_there:
        flyer.vehicles.position[1] += [0.0, 40.0, 0.0]
    output = flyer.step()
    assert len(output.detections) == (1 if still_there else 0)
    if still_there:
        place = flyer.vehicles.R_ned_body[0] @ output.detections[0].position
        assert np.allclose(place, flyer.vehicles.position[1] - flyer.vehicles.position[0], atol=0.02)


@pytest.mark.parametrize(
    ("wrong_by", "looks"),
    [
        ((1.0,), 2),
        ((1.03, 1.0), 2),
        ((1.08, 1.0), 3),
        ((1.6, 1.0), 3),
        ((1.6, 1.3, 1.0), 4),
        ((1.6, 1.3, 1.6, 1.0), 4),
    ],
)
def test_a_drone_is_looked_at_until_the_picture_shows_it_well(
    monkeypatch: pytest.MonkeyPatch, wrong_by: tuple[float, ...], looks: int
) -> None:
    """What a badly cut picture says of the range cuts the next one; the last word counts."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.3, -4.5)))
    answers = flyer.truth.ranges
    asked: list[int] = []

    def ranges(pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        asked.append(len(pictures))
        factor = wrong_by[min(len(asked), len(wrong_by)) - 1]
        return tuple(replace(answer, range_m=factor * answer.range_m) for answer in answers(pictures))

    monkeypatch.setattr(flyer.truth, "ranges", ranges)
    (detection,) = flyer.step().detections
    assert asked == [1] * (looks + 1)
    assert np.linalg.norm(detection.position) == pytest.approx(math.hypot(3.0, 0.3), rel=0.01)


def test_the_picture_in_a_mirror_counts_by_how_sure_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a drone 3 m away: the settled look says 3 m, the mirror 6."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    answers = flyer.truth.ranges
    mirrors: list[bool] = []

    def ranges(pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        mirrors.extend(picture.in_mirror for picture in pictures)
        told = [replace(answer, relative_sigma=0.05, is_drone=0.9) for answer in answers(pictures)]
        if mirrors[-1]:
            told[0] = replace(told[0], range_m=6.0, relative_sigma=0.1, is_drone=0.85)
        return tuple(told)

    monkeypatch.setattr(flyer.truth, "ranges", ranges)
    (detection,) = flyer.step().detections
    assert mirrors == [False, False, True]
    assert np.linalg.norm(detection.position) == pytest.approx(3.0 * 2 ** (1 / 5), rel=0.005)  # 1 of 1 + 4
    assert detection.drone_probability == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("told", "seen"),
    [
        ((0.3, 0.9, 0.9), 1),
        ((0.3, 0.85, 0.85), 1),
        ((0.1, 0.9, 0.9), 0),
        ((0.9, 0.75, 0.9), 0),
        ((0.9, 0.9, 0.75), 0),
    ],
)
def test_doubts_about_the_first_picture_of_a_drone_do_not_outlive_the_next(
    monkeypatch: pytest.MonkeyPatch, told: tuple[float, ...], seen: int
) -> None:
    """Only where it is all but sure that there is none, nobody looks again; the first was not cut to this drone."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    answers, rest = flyer.truth.ranges, list(told)
    monkeypatch.setattr(
        flyer.truth, "ranges", lambda pictures: tuple(replace(a, is_drone=rest.pop(0)) for a in answers(pictures))
    )
    assert len(flyer.step().detections) == seen


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("lie", [{"range_m": math.inf}, {"range_m": math.nan}, {"relative_sigma": 0.0}])
def test_a_mirror_that_tells_nonsense_gives_no_detection(monkeypatch: pytest.MonkeyPatch, lie: dict[str, Any]) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    answers = flyer.truth.ranges

    def ranges(pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        return tuple(
            replace(answer, **lie) if picture.in_mirror else answer
            for picture, answer in zip(pictures, answers(pictures), strict=True)
        )

    monkeypatch.setattr(flyer.truth, "ranges", ranges)
    assert not flyer.step().detections


@pytest.mark.parametrize(("is_drone", "sure", "unsure"), [(0.05, 0, 0), (0.35, 255, 255), (0.9, 1, 255)])
def test_what_is_no_drone_belongs_to_the_background_again(
    monkeypatch: pytest.MonkeyPatch, is_drone: float, sure: int, unsure: int
) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -4.0)))
    frames, vehicle = flyer.look()
    answers = flyer.truth.ranges
    monkeypatch.setattr(
        flyer.truth, "ranges", lambda pictures: tuple(replace(a, is_drone=is_drone) for a in answers(pictures))
    )
    observer = views.Observer(flyer.camera_simulator.rig, flyer.truth, height_fixes_scale=False)
    maps, _ = observer.scenes(frames, vehicle)
    (name,) = [name for name, scene in maps.items() if scene.instances]
    drone = maps[name].labels > 0
    upper = drone & (np.cumsum(drone.any(axis=1)) < np.ptp(np.flatnonzero(drone.any(axis=1))) / 2)[:, None]
    maps[name] = replace(maps[name], unsure=upper)
    labels = observer.view(frames, vehicle, maps, ()).cameras[name].labels
    assert set(labels[drone & ~upper]) == {sure}
    assert set(labels[upper]) == {unsure}


def test_of_a_drone_that_the_images_border_cuts_more_is_looked_at_than_is_seen() -> None:
    camera = next(iter(CameraSimulator(scenario_with((0.0, 0.0, -4.0))).rig.cameras.values()))
    width = camera.camera.size[0]

    def half_angle(left: float) -> float:
        box = np.array([left, 300.0, left + 60.0, 340.0])
        return views._aim(camera, Instance(1, np.array([left + 30.0, 320.0]), box, 900.0))[1]

    assert half_angle(0.0) > 1.3 * half_angle(10.0)
    assert half_angle(width - 60.0) > 1.3 * half_angle(width - 70.0)
    assert half_angle(2.0) < 1.1 * half_angle(10.0), "the first stage sees a pixel in two"


def with_discs(truth: TruthPerception, height: float) -> Callable[[Sequence[Picture]], tuple[RangeEstimate, ...]]:
    """The second stage, with masks: a disc somewhat wider than the drone, so high inside and so deep outside."""
    answers = truth.ranges

    def ranges(pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        v, u = np.mgrid[0:96, 0:96] + 0.5
        masked = []
        for picture, answer in zip(pictures, answers(pictures), strict=True):
            reach_px = 0.6 * answer.size_m * picture.focal_px / answer.range_m
            inside = np.hypot(u - answer.centre[0], v - answer.centre[1]) < reach_px
            masked.append(replace(answer, mask=np.where(inside, height, -height).astype(np.float32)))
        return tuple(masked)

    return ranges


def test_two_drones_that_the_first_stage_takes_for_one_are_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """The far one's pixels count for the near one's, until the second stage says which of them are the near one's."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.3, -4.0), (6.0, -0.6, -4.0)))
    frames, vehicle = flyer.look()
    monkeypatch.setattr(flyer.truth, "ranges", with_discs(flyer.truth, 9.0))
    observer = views.Observer(flyer.camera_simulator.rig, flyer.truth, height_fixes_scale=False)
    maps, _ = observer.scenes(frames, vehicle)
    (name,) = [name for name, scene in maps.items() if scene.instances]
    near, far = maps[name].instances
    pixels = maps[name].labels > 0
    both = replace(near, box=np.concatenate([np.minimum(near.box, far.box)[:2], np.maximum(near.box, far.box)[2:]]))
    labels = np.where(pixels, np.uint8(near.label), np.uint8(0))
    logit = np.where(pixels, np.float32(3.0), np.float32(-3.0))[1::2, 1::2]
    taken_for_one = {name: replace(maps[name], labels=labels, instances=(both,), unsure=~pixels, logit=logit)}
    view = observer.view(frames, vehicle, taken_for_one, ())
    assert sorted(np.linalg.norm(s.position) for s in view.detections) == pytest.approx([3.01, 6.03], abs=0.1)
    seen = view.cameras[name].labels
    assert {*seen[maps[name].labels == near.label]} & {*seen[maps[name].labels == far.label]} <= {0, 255}


def test_a_view_draws_drones_as_their_colours_say(monkeypatch: pytest.MonkeyPatch) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.3, -4.0)))
    frames, vehicle = flyer.look()
    monkeypatch.setattr(flyer.truth, "ranges", with_discs(flyer.truth, 3.0))
    observer = views.Observer(flyer.camera_simulator.rig, flyer.truth, height_fixes_scale=False)
    maps, _ = observer.scenes(frames, vehicle)
    (name,) = [name for name, scene in maps.items() if scene.instances]
    nothing = np.zeros(maps[name].labels[1::2, 1::2].shape, np.float32)
    maps[name] = replace(maps[name], logit=nothing)

    def drawn(image: UInt8Array) -> BoolArray:
        painted = replace(frames, frames={name: replace(frames.frames[name], image=image)})
        view = observer.view(painted, vehicle, {name: maps[name]}, ())
        return np.asarray(view.cameras[name].labels == view.detections[0].label)

    meadow = np.full_like(frames.frames[name].image, 90)
    disc = drawn(meadow)
    columns = np.nonzero(disc)[1]
    sliver = disc & (np.arange(disc.shape[1]) > np.quantile(columns, 0.9))
    found = drawn(np.where((disc & ~sliver)[:, :, None], np.array([200, 30, 30], np.uint8), meadow))
    assert found[disc & ~sliver].mean() > 0.95
    assert found[sliver].mean() < 0.05, "what has the meadow's colour is the meadow"


def test_a_drone_painted_like_the_one_before_it_is_still_looked_for() -> None:
    """Colours give its pixels to the other one; what the networks alone say does not."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.3, -4.0), (6.0, -0.6, -4.0)))
    frames, vehicle = flyer.look()
    observer = views.Observer(flyer.camera_simulator.rig, flyer.truth, height_fixes_scale=False)
    maps, _ = observer.scenes(frames, vehicle)
    (name,) = [name for name, scene in maps.items() if scene.instances]
    near, far = (maps[name].labels == instance.label for instance in maps[name].instances)
    image = np.where((near | far)[:, :, None], np.array([200, 30, 30], np.uint8), np.array([90, 120, 160], np.uint8))
    logit = np.where(near, np.float32(3.0), np.where(far, np.float32(-3.0), np.float32(-7.0)))
    first = np.where(near | far, np.uint8(UNCLASSED), np.uint8(0))
    outlines = Outlines(first, (Claim(1, (slice(None), slice(None)), logit),))
    assert (outlines.by_colours(image) == np.where(near | far, 1, 0)).mean() > 0.99
    images, unsure = {name: image}, {name: replace(maps[name], unsure=~(near | far))}
    (found,) = observer._look_at_the_rest(images, unsure, {name: outlines})
    assert np.linalg.norm(found.position) == pytest.approx(6.03, abs=0.1)
    assert not observer._look_at_the_rest(images, unsure, {name: Outlines(outlines.by_colours(image))})


def test_an_image_full_of_ghosts_costs_no_more_than_a_few_looks() -> None:
    """What the first stage is sure of in a hundred places; only the largest are looked at, and no mere specks."""
    pixels = np.zeros((640, 480), np.bool_)
    for k in range(100):
        pixels[60 * (k // 10) : 60 * (k // 10) + 5 + k // 5, 45 * (k % 10) : 45 * (k % 10) + 20] = True
    blobs = views._blobs(pixels)
    assert [blob.area_px for blob in blobs] == [20.0 * (5 + k // 5) for k in (95, 96, 97, 98, 99, 90)]
    assert list(blobs[0].box) == [225.0, 540.0, 245.0, 564.0]
    speck = np.zeros((640, 480), np.bool_)
    speck[100:103, 200:207] = True
    assert not views._blobs(speck)


def test_blind_cameras_still_give_a_finite_command() -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0)))
    _, state = flyer.look()
    output = flyer.pilot.step(FrameSet(flyer.time_s, {}), state)
    assert output.ego_motion is None
    assert len(output.reasons) == 4
    assert np.isfinite(output.command.velocity).all()
    assert math.isfinite(output.command.yaw_rad)


def test_an_impossible_ego_motion_is_refused_but_not_for_ever() -> None:
    """No vehicle jumps 4 m in a step. If it goes on, it was the past that was wrong."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0)))
    flyer.step()
    flyer.move()
    assert flyer.step().ego_motion is not None
    known = []
    for _ in range(4):
        flyer.move()
        flyer.vehicles.position = flyer.vehicles.position + np.array([4.0, 0.0, 0.0])
        output = flyer.step()
        known.append(output.ego_motion is not None)
        assert (output.ego_motion is not None) != any("that fast" in reason for reason in output.reasons)
    assert known == [False, False, True, True]


@pytest.mark.parametrize(
    ("range_m", "turned_deg", "same"),
    [
        (4.2, 0.5, True),  # at the same spot
        (5.4, 1.0, True),  # two cameras' opinions of one drone: one behind the other would be hidden
        (7.0, 1.0, False),  # too far behind to be the same, however hidden
        (5.4, 8.0, False),  # beside it
    ],
)
def test_two_detections_in_one_direction_are_one_drone(range_m: float, turned_deg: float, same: bool) -> None:
    ahead, turned = np.array([1.0, 0.0, 0.0]), math.radians(turned_deg)
    aside = np.array([math.cos(turned), math.sin(turned), 0.0])
    one = views._Located(views._Candidate(("front",), ahead, 0.2), 4.0 * ahead, 0.1, size_m=0.7)
    other = views._Located(views._Candidate(("left",), aside, 0.2), range_m * aside, 0.1, size_m=0.7)
    detections = views._merge([one, other]).detections
    assert len(detections) == (1 if same else 2)


@pytest.mark.parametrize(
    ("range_m", "turned_deg", "seen_m"),
    [
        (12.0, 1.0, [3.0]),  # half of a drone at an image's border: nothing could be seen there, behind the whole one
        (12.0, 6.0, [3.0, 12.0]),  # beside it
        (1.0, 1.0, [1.0, 3.0]),  # near, however unsure: that is never overlooked
        (3.5, 1.0, [3.0, 3.5]),  # the two may be one
    ],
)
def test_of_two_in_one_line_an_unsure_far_one_is_not_seen(
    range_m: float, turned_deg: float, seen_m: list[float]
) -> None:
    ahead, turned = np.array([1.0, 0.0, 0.0]), math.radians(turned_deg)
    aside = np.array([math.cos(turned), math.sin(turned), 0.0])
    sure = views._Located(views._Candidate(("front",), ahead, 0.2), 3.0 * ahead, 0.05, size_m=0.5)
    unsure = views._Located(views._Candidate(("left",), aside, 0.2), range_m * aside, 0.2 * range_m, size_m=0.5)
    kept = views._without_hidden([unsure, sure])
    assert sorted(float(np.linalg.norm(one.position)) for one in kept) == pytest.approx(seen_m)
