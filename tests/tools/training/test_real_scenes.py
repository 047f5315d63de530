"""What is learnt of real pictures, whose depth nobody knows and whose drones are boxes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tools.training import real_scenes
from tools.training.dataset import PairSet
from tools.training.real_scenes import RealScenes
from tools.training.tasks import NeighboursTask

SIZE = (256, 192)
GROUND, DRONE = (90, 160, 60), (250, 20, 20)


def _scenes(folder: Path, *, boxes: list[list[float]]) -> RealScenes:
    """One green picture without a drone, and one with a red square in each box (left, top, width, height)."""
    free, labelled = folder / "free", folder / "labelled"
    free.mkdir()
    labelled.mkdir()
    image = np.full((480, 640, 3), GROUND[::-1], np.uint8)
    assert cv2.imwrite(str(free / "field.png"), image)
    for left, top, width, height in boxes:
        cv2.rectangle(image, (int(left), int(top)), (int(left + width) - 1, int(top + height) - 1), DRONE[::-1], -1)
    assert cv2.imwrite(str(labelled / "drones.png"), image)
    coco = {
        "images": [{"id": 1, "file_name": "drones.png", "width": 640, "height": 480}],
        "annotations": [{"id": k, "image_id": 1, "category_id": 1, "bbox": box} for k, box in enumerate(boxes)],
        "categories": [{"id": 1, "name": "drone"}],
    }
    (labelled / "drones.json").write_text(json.dumps(coco))
    return RealScenes.of(free, labelled / "drones.json")


def test_nothing_is_learnt_of_depth_and_no_pixel_is_a_drone_where_there_is_none(tmp_path: Path) -> None:
    scenes, rng = _scenes(tmp_path, boxes=[[300.0, 200.0, 40.0, 20.0]]), np.random.default_rng(0)
    for _ in range(5):
        sample = scenes.sample_without(SIZE, rng)
        assert sample["image"].shape == (SIZE[1], SIZE[0], 3)
        assert sample["geometry"].shape == (3, SIZE[1] // 2, SIZE[0] // 2)
        assert np.isnan(sample["depth"]).all()
        assert (sample["drone"] == 0).all()


def test_a_box_says_where_a_drone_surely_is_and_where_nobody_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(real_scenes, "as_filmed", lambda image, rng: image)
    scenes, rng = _scenes(tmp_path, boxes=[[300.0, 200.0, 60.0, 30.0]]), np.random.default_rng(0)
    shown = 0
    for _ in range(30):
        sample = scenes.sample_with(SIZE, rng)
        half = sample["image"][1::2, 1::2].astype(int)
        is_red = np.abs(half - DRONE).sum(2) < 20
        is_green = np.abs(half - GROUND).sum(2) < 20
        drone, offset = sample["drone"][0], sample["offset"]
        if not is_red.any():
            assert not (drone == 1).any()
            continue
        shown += 1
        assert (drone == 1).any()
        assert is_red[drone == 1].all(), "only pixels of the drone are taught as drone"
        assert is_green[drone == 0].all(), "no pixel of the drone is taught as none"
        rows, columns = np.nonzero(is_red)
        whole = (
            columns.min() > 0 and columns.max() < SIZE[0] // 2 - 1 and rows.min() > 0 and rows.max() < SIZE[1] // 2 - 1
        )
        if whole:
            v, u = np.nonzero(drone == 1)
            at = np.stack([u, v]) + offset[:, v, u]
            middle = np.array([[columns.min() + columns.max()], [rows.min() + rows.max()]]) / 2
            assert np.abs(at - middle).max() < 1.5
    assert shown > 15


def test_a_drone_is_not_made_too_small_to_see(tmp_path: Path) -> None:
    scenes, rng = _scenes(tmp_path, boxes=[[300.0, 200.0, 8.0, 8.0]]), np.random.default_rng(0)
    widths = []
    for _ in range(40):
        columns = np.nonzero(np.isnan(scenes.sample_with(SIZE, rng)["drone"][0]).any(0))[0]
        if columns.size and columns.min() > 0 and columns.max() < SIZE[0] // 2 - 1:
            widths.append(2 * (columns.max() - columns.min() + 1))
    assert min(widths) >= 7 + 2 * 3 - 2, "box and margin, in full-size pixels, to two of them"


def test_what_is_not_known_teaches_nothing() -> None:
    shape = (2, 1, 8, 8)
    depth, logit = torch.full(shape, 4.0, requires_grad=True), torch.zeros(shape, requires_grad=True)
    task = NeighboursTask(PairSet({}, 0), RealScenes((), ()))
    answer = depth, logit, torch.zeros(2, 2, 8, 8)
    task.net = lambda image, geometry: answer
    true_depth, drone = torch.full(shape, 5.0), torch.zeros(shape)
    true_depth[1] = torch.nan
    drone[1, :, :, 4:] = torch.nan
    batch = {"image": torch.zeros(0), "geometry": torch.zeros(0), "depth": true_depth, "drone": drone}
    loss, _ = task.loss(batch | {"offset": torch.zeros(2, 2, 8, 8)})
    loss.backward()
    assert depth.grad is not None
    assert logit.grad is not None
    assert (depth.grad[0] < 0).all(), "5 m is more than 4 m"
    assert (depth.grad[1] == 0).all()
    assert (logit.grad[0] > 0).all()
    assert (logit.grad[1, :, :, :4] > 0).all()
    assert (logit.grad[1, :, :, 4:] == 0).all()
