"""What the detector of drones learns from, and what it begins with. Needs the extra `train`."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tools.training.detector.loss import detection_loss
from tools.training.detector.network import CLASSES, NO_BOX, NOT_JUDGED, decoded
from tools.training.pictures import Cutouts, Scene, part_of, with_drones

CELLS = ((8, 8), (4, 4), (2, 2))
"""Rows and columns of the maps of an image of 64 x 64 pixels."""


def maps(logit: float = -5.0) -> list[torch.Tensor]:
    """Small boxes that are nothing."""
    made = [torch.zeros(1, 5 + len(CLASSES), *cells) for cells in CELLS]
    for one in made:
        one[:, 2:4], one[:, 4:] = -3.0, logit
    return made


def test_a_cell_says_where_its_box_is_in_cells_of_its_own() -> None:
    given = maps()
    given[1][0, :4, 2, 3] = torch.tensor([0.5, 0.25, float(np.log(2.0)), 0.0])  # row 2, column 3, stride 16
    boxes, _, _ = decoded(given)
    assert boxes[0, 64 + 2 * 4 + 3].tolist() == pytest.approx([3.5 * 16, 2.25 * 16, 32.0, 16.0])


def test_the_right_answer_costs_less_than_another_box_and_than_nothing() -> None:
    box, kind = torch.tensor([[[28.0, 20.0, 16.0, 8.0]]]), torch.tensor([[0]])
    right, beside = maps(), maps()
    for made, shift in ((right, 0.0), (beside, 1.0)):
        made[0][0, :4, 2, 3] = torch.tensor([0.5 + shift, 0.5, float(np.log(2.0)), 0.0])
        made[0][0, 4:6, 2, 3] = 5.0
    costs = [float(detection_loss(one, box, kind)[0]) for one in (right, beside, maps())]
    assert costs[0] < costs[1] < costs[2]


def test_a_cell_answers_for_one_box_and_one_cell_for_a_box_that_none_overlaps() -> None:
    """By hand: 83 of 84 cells are asked for no object, one for an object, all at a logit of -5."""
    boxes = torch.tensor([[[28.0, 20.0, 40.0, 30.0], [28.0, 20.0, 30.0, 40.0]]])
    _, figures = detection_loss(maps(), boxes, torch.tensor([[0, 1]]))
    assert figures["object"] == pytest.approx(83 * np.log1p(np.exp(-5.0)) + np.log1p(np.exp(5.0)), rel=1e-4)


def test_the_class_of_the_box_is_learnt_and_no_other() -> None:
    given = [one.requires_grad_() for one in maps(0.0)]
    detection_loss(given, torch.tensor([[[28.0, 20.0, 16.0, 8.0]]]), torch.tensor([[2]]))[0].backward()
    gradient = torch.cat([one.grad.flatten(2) for one in given if one.grad is not None], 2)[0, 5:].sum(1)
    assert (gradient < 0).tolist() == [False, False, True, False]


def test_pictures_of_a_batch_are_learnt_from_apart() -> None:
    torch.manual_seed(3)
    given = [torch.randn(2, 5 + len(CLASSES), *cells) for cells in CELLS]
    boxes = torch.tensor([[[28.0, 20.0, 16.0, 8.0], [30.0, 22.0, 14.0, 8.0]], [[40.0, 40.0, 30.0, 20.0], [0.0] * 4]])
    classes = torch.tensor([[0, 1], [2, NO_BOX]])

    def gradient(which: list[int]) -> torch.Tensor:
        own = [one[which].clone().requires_grad_() for one in given]
        detection_loss(own, boxes[which], classes[which])[0].backward()
        return torch.cat([one.grad[0].flatten() for one in own if one.grad is not None])

    together, alone = gradient([0, 1]), gradient([0])
    assert together.norm() < alone.norm()  # more cells answer
    assert torch.cosine_similarity(together, alone, 0) == pytest.approx(1.0, abs=1e-5)


def test_nothing_is_learnt_of_objects_in_a_box_that_is_not_judged() -> None:
    given = maps(0.0)
    for one in given:
        one.requires_grad_()
    loss, _ = detection_loss(given, torch.tensor([[[32.0, 32.0, 20.0, 20.0]]]), torch.tensor([[NOT_JUDGED]]))
    loss.backward()
    gradient = given[0].grad
    assert gradient is not None
    assert gradient[0, 4, 3:5, 3:5].abs().max() == 0
    assert gradient[0, 4, 0, 0] > 0


def test_a_part_of_a_picture_takes_its_boxes_along() -> None:
    picture = np.zeros((300, 400, 3), np.uint8)
    picture[120:160, 200:260] = 255
    for seed in range(20):
        rng = np.random.default_rng(seed)
        scene = part_of(picture, [("drone", 200, 120, 260, 160)], 128, (0.5, 1.5), rng, aim=(230.0, 140.0))
        rows, columns = (np.flatnonzero((scene.image[..., 0] > 127).any(axis)) for axis in (1, 0))
        seen = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
        assert scene.boxes[0] == pytest.approx(seen, abs=1.5)


def test_a_drone_is_pasted_where_its_box_says(tmp_path: Path) -> None:
    cutout = np.zeros((80, 120, 4), np.uint8)
    cutout[20:60, 10:110] = (20, 200, 40, 255)
    cv2.imwrite(str(tmp_path / "a.png"), cutout)
    (tmp_path / "index.jsonl").write_text(json.dumps({"file": "a.png"}) + "\n")
    for seed in range(20):
        rng = np.random.default_rng(seed)
        before = Scene(np.full((256, 256, 3), 128, np.uint8), np.zeros((0, 4), np.float32), ())
        after = with_drones(before, Cutouts(tmp_path), rng)
        changed = (np.abs(after.image.astype(int) - 128) > 30).any(2)
        inside = np.zeros_like(changed)
        for left, top, right, bottom in np.rint(after.boxes).astype(int):
            inside[max(top - 2, 0) : bottom + 2, max(left - 2, 0) : right + 2] = True
        assert not (changed & ~inside).any()
        assert len(after.boxes) == len(after.classes)
