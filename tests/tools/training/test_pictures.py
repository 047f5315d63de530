"""What training is shown: worlds, crops, cut-outs and photographs."""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel
from flockd.sim.renderer.drone_models import drone_model
from tools.measure.evaluate_crops import held_out, measured
from tools.training import worlds
from tools.training.dataset import FOCAL_PX, HEIGHT, WIDTH, open_pairs
from tools.training.mine import proposed
from tools.training.own_mesh import OWN_FAMILY
from tools.training.pictures import CropFiles, Cutouts, Scene, part_of, with_drones
from tools.training.render_drone_crops import CropJob, _render_world, own_drone
from tools.training.render_training_data import PairJob, render_world
from tools.training.samples import DroneInView, crop_around, sample_of, warped

ROOT = Path(__file__).resolve().parents[3]


def _write(file: Path, family: NDArray[Any], **arrays: NDArray[Any]) -> None:
    """``arrays`` in the place of drones without any apparent size, target or mask."""
    zeros = np.zeros(len(family))
    plain = {"drone": zeros + 1.0, "apparent": zeros, "target": np.zeros((len(family), 3))}
    np.savez(file, family=family, mask=np.zeros((len(family), 1, 1)), allow_pickle=False, **{**plain, **arrays})


def test_a_family_of_few_images_is_drawn_as_often_as_one_of_many(tmp_path: Path) -> None:
    for name, families, drones in (("a", [0] * 90 + [1] * 5, 1.0), ("b", [0] * 5, 0.0), ("c", [1], 1.0)):
        values, shown = np.arange(len(families), dtype=np.float32), np.full(len(families), drones)
        _write(tmp_path / f"{name}.npz", np.array(families), apparent=values, drone=shown)
    files, rng = CropFiles(tmp_path), np.random.default_rng(0)
    drawn = [files.draw(rng) for _ in range(3000)]
    shares = [
        np.mean([sample["drone"] > 0.5 and sample["family"] == 0 for sample in drawn]),
        np.mean([sample["drone"] > 0.5 and sample["family"] == 1 for sample in drawn]),
        np.mean([sample["drone"] < 0.5 for sample in drawn]),
    ]
    assert shares == pytest.approx([0.46, 0.46, 0.08], abs=0.04)
    lonely = [sample for sample in drawn if sample["family"] == 1 and sample["drone"] > 0.5]
    assert {float(sample["apparent"]) for sample in lonely} == {0.0} | {float(n) for n in range(90, 95)}


def test_the_mask_of_a_crop_is_the_drone_that_it_faces() -> None:
    """A red drone and a blue one beside it; the picture of the red one masks what is red."""
    rng = np.random.default_rng(2)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[300:340, 220:260], image[300:340, 262:302] = (255, 0, 0), (0, 0, 255)
    mine = image[:, :, 0] > 0
    seen = DroneInView(FOCAL_PX, np.array([(240 - WIDTH / 2) / FOCAL_PX * 4, 0.0, 4.0]), np.eye(3), drone_model(0, 0))
    for _ in range(10):
        sample = sample_of(seen, crop_around(seen, rng), image, mine)
        red = sample["picture"][:, :, 0] > 127
        mask = sample["mask"] > 127
        assert red.sum() > 200
        assert (mask & red).sum() / (mask | red).sum() > 0.9


def test_a_warped_image_goes_where_its_flow_says() -> None:
    rng = np.random.default_rng(5)
    noise = rng.integers(0, 255, (160, 120, 3), dtype=np.uint8)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 3.0), np.uint8)
    for _ in range(5):
        second, flow, valid = warped(smooth, np.zeros_like(smooth), rng)
        u, v = np.meshgrid(np.arange(120, dtype=np.float32), np.arange(160, dtype=np.float32))
        fetched = cv2.remap(second, u + flow[0], v + flow[1], cv2.INTER_LINEAR)
        away = np.abs(fetched.astype(float) - smooth).max(axis=2)
        inner = cv2.erode(valid.astype(np.uint8), np.ones((5, 5))) > 0
        assert inner.mean() > 0.2
        assert np.median(away[inner]) <= 2.0
        assert np.median(np.abs(np.roll(smooth, 7, axis=1).astype(float) - smooth).max(axis=2)) > 5.0, "it has texture"


@pytest.mark.training
def test_a_drone_of_a_mesh_flies_alone_and_a_network_is_measured_on_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bars = [trimesh.creation.box(size) for size in ((0.6, 0.05, 0.08), (0.08, 0.05, 0.6))]
    mesh = tmp_path / "drone.glb"
    whole: Any = trimesh.util.concatenate(bars)
    whole.export(mesh)
    own = own_drone(argparse.ArgumentParser(), argparse.Namespace(mesh=[mesh], size_m=0.62))
    assert "has no colours for 100% of its triangles; they get a drawn one" in capsys.readouterr().out
    job = CropJob(tmp_path / "crops.npz", worlds.TEST[-1], 40, own, measures=True)
    _render_world(job)
    with np.load(job.file) as crops:
        assert set(crops["family"][crops["drone"] > 0.5]) == {OWN_FAMILY}
        sizes_m = np.exp(crops["apparent"] + crops["target"][:, 0])[crops["drone"] > 0.5]
    assert sizes_m == pytest.approx(0.62, rel=1e-3)
    assert "drones called a drone" in measured(data_path("models") / "distance_int8.yaml", *held_out(tmp_path))


@pytest.mark.training
def test_the_second_image_of_a_pair_is_where_the_flow_says_and_drones_are_in_their_boxes(tmp_path: Path) -> None:
    render_world(PairJob(tmp_path / "part-0000", worlds.TRAINING[3], 3, worlds.FAMILIES, 0.5))
    pairs, off = open_pairs(tmp_path), []
    for pair in range(pairs.count):
        first, second = (image[1::2, 1::2].astype(np.float32) for image in pairs["image"][pair])
        flow = pairs["flow"][pair].astype(np.float32) / 2
        v, u = np.mgrid[: flow.shape[1], : flow.shape[2]].astype(np.float32)
        fetched = cv2.remap(second, u + flow[0], v + flow[1], cv2.INTER_LINEAR)
        off.append(np.abs(fetched - first).mean(2)[pairs["flow_valid"][pair]])
        for drone in np.flatnonzero(pairs["drone_pixels"][pair, 0] > 8):
            left, top, right, bottom = (pairs["drone_box"][pair, 0, drone] // 2).astype(int)
            rows, columns = np.nonzero(pairs["ids"][pair][0] == drone + 1)
            assert left - 1 <= columns.min() <= columns.max() <= right
            assert top - 1 <= rows.min() <= rows.max() <= bottom
    assert np.median(np.concatenate(off)) < 6.0


def test_a_drone_is_whole_inside_the_image_and_behind_nothing() -> None:
    """A box of 0.6 x 0.2 x 0.6 m, 4 m ahead; something else before it, its own pixels, and something at 2 m."""
    corners = np.array([[x, y, 4.0 + z] for x in (-0.3, 0.3) for y in (-0.1, 0.1) for z in (-0.3, 0.3)])
    lens = np.array([[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HEIGHT / 2], [0.0, 0.0, 1.0]])
    view = SimpleNamespace(ids=np.zeros((HEIGHT, WIDTH), np.uint8), depth=np.full((HEIGHT, WIDTH), 50.0))
    assert worlds.is_whole(corners, view, lens, 1, 0.6)
    assert not worlds.is_whole(corners + np.array([4.2, 0.0, 0.0]), view, lens, 1, 0.6), "cut by the border"
    view.ids[310:330, 230:250] = 2
    assert not worlds.is_whole(corners, view, lens, 1, 0.6)
    view.ids[view.ids == 2] = 1
    assert worlds.is_whole(corners, view, lens, 1, 0.6)
    view.depth[315:325, 235:245] = 2.0
    assert not worlds.is_whole(corners, view, lens, 1, 0.6)


def test_worlds_for_training_validation_test_and_flights_never_meet() -> None:
    parts = [worlds.FLIGHTS, worlds.TRAINING, worlds.VALIDATION, worlds.TEST]
    assert all(a.stop <= b.start for a, b in pairwise(parts))
    assert not set(worlds.FAMILIES) & set(worlds.UNSEEN_FAMILIES)


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


@pytest.mark.parametrize("network", ["detector", "neighbours_int8"])
def test_what_is_proposed_is_a_negative_but_beside_a_drone(network: str) -> None:
    """The picture of the documentation, with two drones in it."""
    image = cv2.imread(str(ROOT / "docs/pictures/detected.webp"), cv2.IMREAD_COLOR_RGB)
    assert image is not None
    height, width = (side // 32 * 32 for side in image.shape[:2])
    cut: np.ndarray = np.ascontiguousarray(image[:height, :width], np.uint8)
    model = OnnxModel(data_path("models") / f"{network}.yaml", threads=1)
    found = proposed(model, cut, [])
    assert found
    assert len(proposed(model, cut, found[:1])) < len(found)
