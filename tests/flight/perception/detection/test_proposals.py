"""Regions of interest: of instances, of a detector's boxes and of residuals; how wide, how many, which are alike."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import Rig, RigCamera, WideAngleCamera, ZMap
from flockd.flight.perception import SceneMaps
from flockd.flight.perception.detection.boxes import BoxRules, kept_boxes, probable_boxes, with_boxes
from flockd.flight.perception.detection.instances import Instance, group_instances
from flockd.flight.perception.detection.proposals import (
    Proposal,
    proposals_of_instances,
    propose_instances,
    propose_predictions,
)
from flockd.flight.perception.detection.refinement import Estimates, unseen
from flockd.flight.tracking import Prediction
from tests.flight.perception.cameras import SECOND_STAGE
from tests.make import rig_camera, vehicle

RULES = SECOND_STAGE.rules
CAMERA = rig_camera(320.0, (640, 480))
SIZE = (160, 120)
RIG = Rig({"front": rig_camera(100.0, SIZE)})


def instance(label: int, box: tuple[float, ...] | FloatArray, area_px: float = 100.0, score: float = 1.0) -> Instance:
    corners = np.array(box, float)
    return Instance(label, (corners[:2] + corners[2:]) / 2, corners, area_px, score)


def region_of(box: tuple[float, ...], camera: RigCamera = CAMERA) -> Proposal | None:
    return next(iter(proposals_of_instances(camera, [instance(1, box)], RULES)), None)


# How wide.


def test_of_a_drone_that_the_images_border_cuts_a_wider_region_is_taken() -> None:
    def half_angle(left: float) -> float:
        region = region_of((left, 220.0, left + 60.0, 260.0))
        assert region is not None
        return region.half_angle

    assert half_angle(0.0) > 1.3 * half_angle(10.0)
    assert half_angle(640 - 60.0) > 1.3 * half_angle(640 - 70.0)
    assert half_angle(2.0) < 1.1 * half_angle(10.0), "the first stage's maps have two image pixels a pixel"


def test_where_a_lens_images_nothing_the_rest_of_a_box_counts() -> None:
    """A lens of 60 degrees in a circle of 160 px radius; a corner of the box lies outside it, or all of it does."""
    matrix = np.array([[160.0 / (math.pi / 3), 0.0, 320.0], [0.0, 160.0 / (math.pi / 3), 240.0], [0.0, 0.0, 1.0]])
    lens = WideAngleCamera(matrix, (640, 480), (-1.0 / (3.0 * (math.pi / 3) ** 2), 0.0, 0.0, 0.0))
    camera = RigCamera("front", lens, CAMERA.T_body_camera)
    radius = 160.0 * (1.0 - 1.0 / 3.0)  # where the polynomial turns
    assert np.isnan(lens.rays(np.array([[320.0 + 1.01 * radius, 240.0]]))).all()
    partly = region_of((370.0, 290.0, 410.0, 330.0), camera)
    assert partly is not None
    assert np.isfinite([*partly.direction, partly.half_angle]).all()
    assert region_of((600.0, 440.0, 640.0, 480.0), camera) is None


@pytest.mark.parametrize(("range_m", "searched"), [(3.2, 0), (9.0, 1), (1.0, 1)])
def test_a_neighbour_is_searched_for_though_another_range_is_detected_there(range_m: float, searched: int) -> None:
    """It is predicted 3 m ahead; what was detected two degrees beside it is it, or far behind it, or hides it."""
    front = Rig({"front": CAMERA})
    ahead = CAMERA.T_body_camera.rotation @ [0.0, 0.0, 1.0]
    beside = CAMERA.T_body_camera.rotation @ [math.sin(math.radians(2.0)), 0.0, math.cos(math.radians(2.0))]
    near, _ = propose_predictions(front, vehicle(), [Prediction(3.0 * ahead, 0.5)], RULES)
    assert near[0].range_m == pytest.approx(3.0)
    shown = Estimates(beside[None], np.array([math.log(range_m)]), *np.ones((4, 1)))
    assert unseen(near, shown).tolist() == [bool(searched)]


# How many.


def scene_of(*scores: float) -> SceneMaps:
    """Squares of 8 x 8 pixels in a row, one for each score."""
    labels, instances = np.zeros(SIZE[::-1], np.uint8), []
    for k, score in enumerate(scores):
        left, top = 4 + 14 * (k % 11), 10 + 30 * (k // 11)
        labels[top : top + 8, left : left + 8] = k + 1
        instances.append(instance(k + 1, (left, top, left + 8, top + 8), 64.0, score))
    return SceneMaps(ZMap(np.full(labels.shape, 5.0, np.float32)), labels, tuple(instances))


@pytest.mark.parametrize(("most", "kept"), [(None, [1, 2, 3, 4, 5, 6]), (3, [1, 3, 4]), (1, [4])])
def test_of_too_many_the_best_are_proposed_in_their_order(most: int | None, kept: list[int]) -> None:
    parameters = DetectionParameters() if most is None else DetectionParameters(max_proposals=most)
    scenes = {"front": scene_of(3.0, 0.5, 2.0, 4.0, 1.0, 2.0)}
    proposals = propose_instances(RIG, scenes, RULES, parameters)
    assert [one.instance.label for one in proposals if one.instance] == kept


# Two drones in one mask are told apart by the centres that their pixels vote for.


def painted(
    shape: tuple[int, int], *discs: tuple[float, float, float], error_px: float = 0.0
) -> tuple[Float32Array, Float32Array]:
    """Logit and offset maps of discs (u, v, radius); the later covers the earlier."""
    logit, offset = np.full(shape, -5.0, np.float32), np.zeros((2, *shape), np.float32)
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    for cu, cv, radius in discs:
        inside = (u - cu) ** 2 + (v - cv) ** 2 < radius**2
        logit[inside] = 5.0
        offset[:, inside] = (cu - u)[inside], (cv - v)[inside]
    offset += np.random.default_rng(1).normal(0, error_px, offset.shape).astype(np.float32)
    return logit, offset


@pytest.mark.parametrize(
    ("maps", "centres"),
    [
        pytest.param(painted((60, 80)), [], id="nothing"),
        pytest.param(painted((60, 80), (30.5, 30.5, 0.6)), [], id="a speck"),
        pytest.param(
            painted((120, 160), (60.0, 60.0, 20.0), (84.0, 64.0, 14.0), error_px=0.7), [(120, 120), (168, 128)],
            id="overlapping",
        ),
        pytest.param(painted((240, 320), (150.0, 120.0, 60.0), error_px=4.0), [(300, 240)], id="scattered votes"),
        pytest.param(painted((100, 100), (-6.0, 50.0, 15.0)), [(-12, 100)], id="cut by the border"),
    ],
)  # fmt: skip
def test_drones_are_as_many_as_centres(maps: tuple[Float32Array, Float32Array], centres: list[tuple[int, int]]) -> None:
    labels, instances = group_instances(*maps, scale=2)
    found = np.reshape([one.centre for one in instances], (-1, 2))
    np.testing.assert_allclose(found, np.reshape(centres, (-1, 2)), atol=2.0)
    assert {*np.unique(labels)} == {0, *(one.label for one in instances)}
    assert all(one.box.min() >= 0.0 for one in instances)


def test_a_dozen_drones_keep_their_own_pixels_and_the_score_is_the_highest_logit() -> None:
    discs = [(30.0 + 50 * (i % 4), 30.0 + 50 * (i // 4), 6.0 + i) for i in range(12)]
    logit, offset = painted((160, 220), *discs)
    logit[30, 30] = 7.5  # of the smallest
    v, u = np.mgrid[:160, :220] + 0.5
    labels, instances = group_instances(logit, offset, scale=2)
    assert [one.score for one in instances] == [5.0] * 11 + [7.5]
    for one, (cu, cv, radius) in zip(instances, reversed(discs), strict=True):  # the largest first
        own = (u - cu) ** 2 + (v - cv) ** 2 < radius**2
        assert np.array_equal(labels == one.label, own)
        assert one.area_px == 4 * own.sum()
        assert one.centre.tolist() == [2 * cu, 2 * cv]
        rows, columns = np.nonzero(own)
        assert one.box.tolist() == [2 * columns.min(), 2 * rows.min(), 2 * columns.max() + 2, 2 * rows.max() + 2]


# A detector's boxes beside the instances of the segmentation.

BOXES = BoxRules(
    box_probability=0.05, overlap=0.5, evidence_gain=0.5, large_box_evidence=4.0, small_box_evidence=3.0,
    no_box_evidence=-2.0,
)  # fmt: skip
DRONE = (100.0, 50.0, 140.0, 70.0)


@pytest.mark.parametrize(
    ("rows", "scale", "kept", "odds"),
    [
        pytest.param(
            [(50, 40, 20, 10, 0.6), (51, 40, 20, 10, 0.8), (90, 40, 20, 10, 0.5)], (1.0, 1.0),
            [(41, 35, 61, 45), (80, 35, 100, 45)], [math.log(4.0), 0.0], id="of two boxes of one drone the surer one",
        ),
        pytest.param(
            [(50, 40, 20, 10, 1.0)], (1.0, 1.0), [(40, 35, 60, 45)], [math.log(19.0)], id="never surer than 19 of 20"
        ),
        pytest.param([(50, 40, 20, 10, 0.5)], (0.5, 0.25), [(80, 140, 120, 180)], [0.0], id="pixels of the image"),
        pytest.param([(50, 40, 20, 10, 0.04)], (1.0, 1.0), [], [], id="improbable"),
    ],
)  # fmt: skip
def test_boxes_that_are_kept(
    rows: list[tuple[float, ...]], scale: tuple[float, float], kept: list[tuple[float, ...]], odds: list[float]
) -> None:
    """Of a detector that gives centre, size and probability."""
    names = ("centre_right_px", "centre_down_px", "width_px", "height_px", "drone_probability")
    given = dict(zip(names, np.array(rows, np.float32).T, strict=True))
    boxes, found = kept_boxes(*probable_boxes(given, BOXES, scale), BOXES)
    assert boxes == pytest.approx(np.reshape(np.array(kept, float), (-1, 4)))
    assert found == pytest.approx(odds, abs=1e-6)


def merged(
    instances: tuple[Instance, ...], boxes: list[tuple[float, ...]], odds: list[float], labels: UInt8Array | None = None
) -> tuple[UInt8Array, tuple[Instance, ...]]:
    empty = np.zeros((100, 200), np.uint8)
    corners = np.reshape(np.array(boxes, float), (-1, 4))
    return with_boxes(empty if labels is None else labels, instances, corners, np.array(odds), BOXES)


def labelled(*boxes: tuple[int, int, int, int]) -> UInt8Array:
    """Each box with its number."""
    labels = np.zeros((100, 200), np.uint8)
    for number, (left, top, right, bottom) in enumerate(boxes, 1):
        labels[top:bottom, left:right] = number
    return labels


def test_an_instance_takes_the_box_that_is_the_same_drone_and_keeps_its_label() -> None:
    marked, (drone,) = merged((instance(1, (105, 55, 135, 65)),), [DRONE], [2.0], labelled((105, 55, 135, 65)))
    assert (drone.label, drone.area_px) == (1, 100.0)
    assert drone.box == pytest.approx(DRONE)
    assert drone.centre == pytest.approx([120, 60])
    assert drone.evidence == pytest.approx(0.5 * 2.0)
    assert set(np.unique(marked)) == {0, 1}


def test_the_parts_of_a_large_drone_are_one_with_it() -> None:
    parts = (101, 52, 108, 56), (131, 52, 139, 56)
    marked, (drone,) = merged((instance(1, parts[0]), instance(2, parts[1])), [DRONE], [3.0], labelled(*parts))
    assert set(np.unique(marked)) == {0, drone.label}
    assert (marked == drone.label).sum() == 4 * 7 + 4 * 8


@pytest.mark.parametrize(
    ("width_px", "added"),
    [(5, 3.0), (8, 3.0), (160**0.5, 1.5), (20, 0.0), (40, 0.0), (40 * 7.5**0.5, 2.0), (300, 4.0), (600, 4.0)],
)
def test_what_the_second_stage_says_against_a_small_or_a_large_box_counts_less(width_px: float, added: float) -> None:
    box = np.array([0.0, 0.0, width_px, 20.0])
    assert BOXES.evidence(box, -4.0) == pytest.approx(0.5 * -4.0 + added)
    for odds in (2.0, math.log(19.0)):
        assert width_px > 8 or BOXES.evidence(box, odds) == pytest.approx(0.5 * math.log(19.0)), "no more than surest"
