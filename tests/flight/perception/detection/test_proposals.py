"""How many regions of one image the second stage is given, and which."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED, Float32Array
from flockd.flight.geometry import Rig, ZMap
from flockd.flight.perception import Instance, SceneMaps, group_instances
from flockd.flight.perception.detection.proposals import propose_instances, propose_residuals
from tests.flight.perception.shipped import SECOND_STAGE
from tests.make import rig_camera

RULES = SECOND_STAGE.rules
SIZE = (160, 120)
RIG = Rig({"front": rig_camera(100.0, SIZE)})


def scene_of(*scores: float) -> SceneMaps:
    """Squares of 8 x 8 pixels in a row, one for each score, and certain of all."""
    labels = np.zeros(SIZE[::-1], np.uint8)
    instances = []
    for k, score in enumerate(scores):
        left, top = 4 + 14 * (k % 11), 10 + 30 * (k // 11)
        labels[top : top + 8, left : left + 8] = k + 1
        box = np.array([left, top, left + 8, top + 8], np.float64)
        instances.append(Instance(k + 1, box.reshape(2, 2).mean(0), box, 64.0, score))
    uncertain = np.zeros(labels.shape, np.bool_)
    return SceneMaps(ZMap(np.full(labels.shape, 5.0, np.float32)), labels, tuple(instances), uncertain=uncertain)


def proposed(scene: SceneMaps, parameters: DetectionParameters) -> list[int]:
    proposals = propose_instances(RIG, {"front": scene}, RULES, parameters)
    return [one.instance.label for one in proposals if one.instance]


def test_the_score_is_the_highest_logit_over_the_threshold() -> None:
    logit = np.full((30, 40), -5.0, np.float32)
    logit[10:16, 10:16] = 1.0
    logit[12, 13] = 3.5
    offset = np.stack([12.5 - np.arange(40.0) * np.ones((30, 1)), 12.5 - np.arange(30.0)[:, None] * np.ones((1, 40))])
    _, (one,) = group_instances(logit, offset.astype(np.float32), scale=2)
    assert one.score == 3.5


def test_of_too_many_the_best_are_proposed_in_their_order() -> None:
    scene = scene_of(3.0, 0.5, 2.0, 4.0, 1.0, 2.0)
    assert proposed(scene, DetectionParameters()) == [1, 2, 3, 4, 5, 6]
    assert proposed(scene, DetectionParameters(max_proposals=3)) == [1, 3, 4]
    assert proposed(scene, DetectionParameters(max_proposals=1)) == [4]


def test_residuals_count_among_the_proposals_and_bring_nothing_back() -> None:
    """No mask explains any of eight certain instances, as where the second stage had no mask for them."""
    scene = scene_of(*range(8, 0, -1))
    masks = {"front": np.where(scene.labels > 0, np.uint8(UNCLASSED), np.uint8(0))}

    def residuals(most: int) -> list[float]:
        parameters = DetectionParameters(max_proposals=most, max_residuals=6)
        found = propose_residuals(RIG, {"front": scene}, masks, RULES, parameters)
        return sorted(one.instance.box[0] for one in found if one.instance)

    assert len(residuals(12)) == 4
    assert len(residuals(30)) == 6
    assert residuals(8) == []


# Two drones in one mask are told apart by the centres that their pixels vote for.


def painted(
    shape: tuple[int, int], discs: list[tuple[float, float, float]], error_px: float = 0.0
) -> tuple[Float32Array, Float32Array]:
    """Logit and offset maps of discs (u, v, radius); the later covers the earlier."""
    rng = np.random.default_rng(1)
    logit = np.full(shape, -5.0, np.float32)
    offset = np.zeros((2, *shape), np.float32)
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    for cu, cv, radius in discs:
        inside = (u - cu) ** 2 + (v - cv) ** 2 < radius**2
        logit[inside] = 5.0
        offset[0][inside] = (cu - u)[inside]
        offset[1][inside] = (cv - v)[inside]
    offset += rng.normal(0, error_px, offset.shape).astype(np.float32)
    return logit, offset


@pytest.mark.parametrize("discs", [[], [(30.5, 30.5, 0.6)]], ids=["nothing", "a speck"])
def test_an_empty_mask_and_specks_are_no_drones(discs: list[tuple[float, float, float]]) -> None:
    labels, instances = group_instances(*painted((60, 80), discs), scale=2)
    assert instances == ()
    assert not labels.any()


def test_overlapping_drones_are_two() -> None:
    logit, offset = painted((120, 160), [(60.0, 60.0, 20.0), (84.0, 64.0, 14.0)], error_px=0.7)
    labels, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 2
    assert np.allclose(instances[0].centre, [120.0, 120.0], atol=2.0)
    assert np.allclose(instances[1].centre, [168.0, 128.0], atol=2.0)
    assert labels[60, 45] == instances[0].label
    assert labels[64, 90] == instances[1].label


def test_one_large_drone_stays_one_though_its_votes_scatter() -> None:
    logit, offset = painted((240, 320), [(150.0, 120.0, 60.0)], error_px=4.0)
    _, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 1


def test_a_drone_cut_by_the_border_points_outside() -> None:
    logit, offset = painted((100, 100), [(-6.0, 50.0, 15.0)])
    _, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 1
    assert np.allclose(instances[0].centre, [-12.0, 100.0], atol=2.0)
    assert instances[0].box[0] == 0.0


def test_a_dozen_drones_keep_their_own_pixels() -> None:
    discs = [(30.0 + 50 * (i % 4), 30.0 + 50 * (i // 4), 6.0 + i) for i in range(12)]
    logit, offset = painted((160, 220), discs)
    v, u = np.mgrid[:160, :220] + 0.5
    labels, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 12
    for instance, (cu, cv, radius) in zip(instances, reversed(discs), strict=True):  # the largest first
        own = (u - cu) ** 2 + (v - cv) ** 2 < radius**2
        assert np.array_equal(labels == instance.label, own)
        assert instance.area_px == 4 * own.sum()
        assert instance.centre.tolist() == [2 * cu, 2 * cv]
        rows, columns = np.nonzero(own)
        assert instance.box.tolist() == [2 * columns.min(), 2 * rows.min(), 2 * columns.max() + 2, 2 * rows.max() + 2]
