"""How many regions of one image the second stage is given, and which."""

from __future__ import annotations

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED
from flockd.flight.geometry import Rig, ZMap
from flockd.flight.perception import Instance, SceneMaps, group_instances
from flockd.flight.perception.detection.proposals import propose_instances, propose_residuals
from tests.flight.perception.cameras import SECOND_STAGE
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
