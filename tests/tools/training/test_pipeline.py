"""From seeded worlds to a network that flies: rendering, training, resuming, exporting. Needs the extra `train`."""

from __future__ import annotations

import argparse
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from flockd.cli import main
from flockd.core.data import data_path
from flockd.sim.renderer.drone_models import drone_model
from tools.measure.evaluate_crops import HeldOut, measured
from tools.training import worlds
from tools.training.augment import UNTOUCHED, photometric
from tools.training.crop_files import CropFiles
from tools.training.dataset import FOCAL_PX, HEIGHT, WIDTH
from tools.training.own_mesh import OWN_FAMILY
from tools.training.render_cutouts import cut_out
from tools.training.render_drone_crops import add_mesh, own_drone
from tools.training.samples import DroneInView, crop_around, sample_of, warped

ROOT = Path(__file__).resolve().parents[3]


def run(tool: str, *options: str | Path) -> str:
    command = [sys.executable, "-m", f"tools.training.{tool}", *map(str, options)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_network_is_trained_resumed_and_exported_by_one_command_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, runs, models = tmp_path / "data", tmp_path / "runs", tmp_path / "models"
    run("render_training_data", data / "worlds", "--worlds", "1", "--pairs", "2", "--processes", "1")
    training = ("flow", "--data", data, "--out", runs, "--threads", "1")
    run("train", *training, "--minutes", "0.05")
    first = (runs / "curve.csv").read_text(encoding="utf-8").splitlines()
    run("train", *training, "--minutes", "0.1")
    second = (runs / "curve.csv").read_text(encoding="utf-8").splitlines()
    assert second[: len(first)] == first, "resumed, not begun anew"
    steps = [int(line.split(",")[0]) for line in second[1:]]
    assert steps == sorted(set(steps))
    assert cv2.imread(str(runs / "curve.png")) is not None

    run("export", "flow", "--checkpoint", runs / "checkpoint.pt", "--out", models)
    run("quantise", models / "flow.yaml", "--data", data / "worlds", "--out", models)

    further = tmp_path / "further"
    run("train", "flow", "--data", data, "--out", further, "--minutes", "0.03", "--start", models / "flow.onnx")
    begun = ("--checkpoint", further / "checkpoint.pt", "--begun-with", further / "start.pt")
    run("export", "flow", *begun, "--out", tmp_path / "once_more")
    said = [(folder / "flow.onnx").read_bytes() for folder in (models, tmp_path / "once_more")]
    assert said[0] != said[1], "it learnt"

    for name in ("neighbours", "distance"):
        for suffix in ("yaml", "onnx"):
            (models / f"{name}.{suffix}").write_bytes((data_path("models") / f"{name}.{suffix}").read_bytes())
    assert main(["models", "verify", "--dir", str(models)]) == 0, capsys.readouterr()


@pytest.mark.slow
def test_a_drone_of_a_mesh_flies_alone_and_a_network_is_measured_on_it(tmp_path: Path) -> None:
    bars = [trimesh.creation.box(size) for size in ((0.6, 0.08, 0.05), (0.08, 0.6, 0.05))]
    mesh = tmp_path / "drone.stl"
    whole: Any = trimesh.util.concatenate(bars)
    whole.export(mesh)
    said = run(
        "render_drone_crops", tmp_path / "crops", "--mesh", mesh, "--size-m", "0.62", "--worlds", "1",
        "--scenes", "40", "--held-out", "--processes", "1",
    )  # fmt: skip
    assert "has no colours for 100% of its triangles; they are painted at random" in said
    (file,) = (tmp_path / "crops").glob("*.npz")
    with np.load(file) as crops:
        assert set(crops["family"][crops["drone"] > 0.5]) == {OWN_FAMILY}
        sizes_m = np.exp(crops["apparent"] + crops["target"][:, 0])[crops["drone"] > 0.5]
    assert sizes_m == pytest.approx(0.62, rel=1e-3)
    crops = HeldOut.of(tmp_path / "crops")
    assert crops.log_size == pytest.approx(np.log(0.62), abs=1e-3)
    assert "drones called a drone" in measured(data_path("models") / "distance_int8.yaml", crops)


def test_a_mesh_without_the_drones_size_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_mesh(parser)
    with pytest.raises(SystemExit):
        own_drone(parser, parser.parse_args(["--mesh", "my.glb"]))
    assert "--mesh needs --size-m, the drone's size" in capsys.readouterr().err
    assert own_drone(parser, parser.parse_args([])) == []


@pytest.mark.slow
def test_a_cut_out_shows_the_drone_whole_and_nothing_else() -> None:
    from flockd.sim.world.world import World

    rng = np.random.default_rng(0)
    world = World.generate(worlds.TRAINING[-1], ground_relief_m=0.0, keep_out=None)
    for _ in range(3):
        solid = cut_out(world, drone_model(0, 0), rng)[..., 3] > 127
        rows, columns = np.nonzero(solid)
        assert 0.01 < solid.mean() < 0.6
        assert min(rows.min(), columns.min()) > 0, "no border cuts it"
        assert max(rows.max(), columns.max()) < 319


def test_worlds_for_training_validation_test_and_flights_never_meet() -> None:
    parts = [worlds.FLIGHTS, worlds.TRAINING, worlds.VALIDATION, worlds.TEST]
    assert all(a.stop <= b.start for a, b in pairwise(parts))
    assert not set(worlds.FAMILIES) & set(worlds.UNSEEN_FAMILIES)


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


def test_some_images_stay_clear_and_the_others_are_spoilt_each_in_its_own_way() -> None:
    rng = np.random.default_rng(3)
    image = rng.integers(60, 190, (96, 96, 3), dtype=np.uint8)
    spoilt = [photometric([image, image], rng) for _ in range(200)]
    clear = [np.array_equal(first, image) and np.array_equal(second, image) for first, second in spoilt]
    assert abs(np.mean(clear) - UNTOUCHED) < 0.15
    away = [np.abs(first.astype(float) - image).mean() for first, _ in spoilt]
    assert 3.0 < np.median([a for a, same in zip(away, clear, strict=True) if not same]) < 60.0
    assert all(part.shape == image.shape and part.dtype == np.uint8 for pair in spoilt for part in pair)


def test_images_from_before_they_had_masks_are_refused_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "1.npz", picture=np.zeros((1, 96, 96, 3), np.uint8), drone=np.ones(1, np.float32))
    with pytest.raises(ValueError, match=r"1\.npz: its crops have no masks; make the folder anew"):
        CropFiles(tmp_path)


def test_a_place_too_small_for_the_drawn_houses_gets_fewer() -> None:
    from flockd.sim.scenario import ObstaclesConfig
    from tools.training.render_training_data import _standing

    drawn = ObstaclesConfig(kind="village", extent_m=28.0, min_gap_m=2.0, houses_per_hectare=16.0)
    stands, obstacles = _standing(drawn, 3)
    assert obstacles is not None
    assert stands is not None
    assert 2.0 < stands.houses_per_hectare < 16.0
    assert _standing(None, 3) == (None, None)
