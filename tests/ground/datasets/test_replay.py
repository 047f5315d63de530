"""Datasets of others, replayed: they give the motions that were rendered, or one sentence about themselves."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.cli import main

from . import rendered_dataset
from .rendered_dataset import FRAMES, HEIGHT, WIDTH, Onlooker, Scene

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return rendered_dataset.scene()


@pytest.fixture
def onlooker(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.review.replay.dataset_flight.load_networks", lambda config: Onlooker(scene.depth))


@pytest.fixture
def folder(scene: Scene, tmp_path: Path, onlooker: None) -> Path:
    return rendered_dataset.write_rgbd_folder(scene, tmp_path / "folder")


def replayed(capsys: Capture, *arguments: str | Path) -> dict[str, Any]:
    assert main(["replay", *map(str, arguments), "--json"]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


@pytest.mark.parametrize("stride", [1, 2])
def test_it_gives_the_motions_that_were_rendered(stride: int, scene: Scene, folder: Path, capsys: Capture) -> None:
    result = replayed(capsys, folder, "--depth", "recorded", "--stride", f"{stride}", "--flow", "dis")
    assert [(pair["from"], pair["to"]) for pair in result["pairs"]] == [(k, k + stride) for k in range(FRAMES - stride)]
    for pair in result["pairs"]:
        motion = scene.motion(pair["from"], pair["to"])
        turn = np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude())
        assert pair["true_rotation_deg"] == pytest.approx(turn, abs=1e-3)
        assert pair["true_translation_m"] == pytest.approx(np.linalg.norm(motion[:3, 3]), abs=1e-4)
        assert pair["estimated"]
        assert pair["inlier_ratio"] > 0.2
    assert result["estimated_ratio"] == 1.0
    for error, most in (("rotation_error_deg", 0.1), ("translation_error_m", 0.02)):
        errors = [pair[error] for pair in result["pairs"]]
        assert max(errors) < most
        expected = {"median": np.median(errors), "p95": np.percentile(errors, 95), "max": max(errors)}
        assert result[error] == pytest.approx(expected)


def test_a_pair_without_an_estimate_says_why_and_is_no_standstill(folder: Path, capsys: Capture) -> None:
    image = sorted((folder / "images").iterdir())[3]
    cv2.imwrite(str(image), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))  # somebody's hand over the lens
    result = replayed(capsys, folder, "--depth", "recorded")
    pairs = result["pairs"]
    assert [pair["estimated"] for pair in pairs] == [True, True, False, False, True]
    for pair in pairs[2:4]:
        assert "frame 3: camera camera: no frame" in pair["reason"]
        assert pair["rotation_error_deg"] is pair["translation_error_m"] is pair["inlier_ratio"] is None
    assert result["estimated_ratio"] == pytest.approx(0.6)


def test_too_little_depth_is_no_motion(folder: Path, capsys: Capture) -> None:
    for file in (folder / "depth").iterdir():
        depth = np.zeros((HEIGHT, WIDTH), np.uint16)
        depth[100, 100] = 2000
        cv2.imwrite(str(file), depth)
    assert main(["replay", str(folder), "--depth", "recorded"]) == 1
    captured = capsys.readouterr()
    assert "estimated_ratio: 0.0" in captured.out
    assert "no motion could be estimated: ego-motion: fewer than three pairs" in captured.err


@pytest.mark.parametrize(("maps", "poses", "told"), [(5, 1, "5"), (1, 1000, "0.00")], ids=["tum", "millimetres"])
def test_depth_or_poses_in_other_units_are_told(
    maps: int, poses: int, told: str, folder: Path, capsys: Capture
) -> None:
    for file in (folder / "depth").iterdir():
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert depth is not None
        cv2.imwrite(str(file), maps * depth)
    rows = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    rows[:, :3, 3] *= poses
    np.savetxt(folder / "poses.txt", rows.reshape(-1, 16))
    assert main(["replay", str(folder), "--depth", "recorded", "--flow", "dis"]) == 1
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert sentence.startswith(f"{folder}: motions by the images are {told}")
    assert "times as long as by poses.txt; write poses in metres, and depth maps in millimetres" in sentence


# What people's files come with.


def third(folder: Path) -> Path:
    return sorted(folder.iterdir())[2]


def cut_short(folder: Path) -> None:
    file = third(folder / "images")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def flip_a_bit(folder: Path) -> None:
    file = third(folder / "images")
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def twice(folder: Path) -> None:
    shutil.copy(file := third(folder / "images"), file.with_suffix(".jpg"))


def drawn(kind: str, image: np.ndarray) -> Callable[[Path], object]:
    """In the place of the third image or depth map."""
    return lambda folder: cv2.imwrite(str(third(folder / kind)), image)


def calibrated(matrix: np.ndarray) -> Callable[[Path], object]:
    return lambda folder: np.savetxt(folder / "K.txt", matrix)


SMALL = (HEIGHT // 2, WIDTH // 2)
DOUBLED = np.diag([2.0, 2.0, 1.0]) @ rendered_dataset.OTHERS_MATRIX
ODD = "200 0 160\n0 200 120\n0 0 one\n"


@pytest.mark.parametrize(
    ("happen", "code", "words"),
    [
        (cut_short, 1, ".png: the PNG ends too early"),
        (flip_a_bit, 1, ".png: the PNG is damaged at byte"),
        (lambda folder: (folder / "images/1.heic").touch(), 1, "images: has pictures or videos of kinds that are not"),
        (twice, 1, "images: has 00016.jpg and 00016.png; delete one of them"),
        (lambda folder: third(folder / "images").unlink(), 1, "depth/00016.png: its image is missing"),
        (lambda folder: shutil.rmtree(folder / "images"), 1, "is no folder of images; it needs images/"),
        (lambda folder: third(folder / "depth").unlink(), 1, "depth/00016.png: is missing; each image needs its depth"),
        (lambda folder: np.savetxt(folder / "poses.txt", np.ones((5, 16))), 1, "poses.txt: has 5 poses, and"),
        (lambda folder: np.savetxt(folder / "poses.txt", np.ones((6, 16))), 1, "pose 1: its first three columns are"),
        (lambda folder: np.savetxt(folder / "poses.txt", np.full((6, 16), np.inf)), 1, "poses.txt:1: does not fit"),
        (drawn("depth", np.zeros((HEIGHT, WIDTH), np.uint16)), 1, ".png: its depth is 0 everywhere"),
        (drawn("depth", np.full((HEIGHT, WIDTH), 200, np.uint8)), 1, "is not a depth map; it needs one channel of 16"),
        (drawn("depth", np.full(SMALL, 2000, np.uint16)), 1, ".png: is 160 x 120 pixels, and the camera 320"),
        (drawn("images", np.zeros((*SMALL, 3), np.uint8)), 1, ".png: is 160 x 120 pixels, and the camera 320"),
        (calibrated(DOUBLED), 78, "of the image off the middle of"),
        (lambda folder: (folder / "K.txt").unlink(), 78, "K.txt: does not exist"),
        (lambda folder: (folder / "K.txt").write_text(ODD), 1, "K.txt:3: does not fit; it needs a 3x3 matrix"),
    ],
    ids=[
        "cut short", "flipped bit", "an image of no known kind", "an image twice", "no image", "no images",
        "no depth map", "a pose too few", "no rotation", "lost track", "no depth", "coarse depth", "small depth",
        "small image", "doubled calibration", "no calibration", "odd calibration",
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(
    happen: Callable[[Path], object],
    code: int,
    words: str,
    folder: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    happen(folder)
    assert main(["replay", str(folder), "--depth", "recorded", "--json"]) == code
    captured = capfd.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--diff"], "--diff is for recordings of flockd"),
        (["--stride", "6"], "has 6 frames, and none 6 after another"),
        (["--depth", "recorded"], "has no recorded depth; replay it with --depth network"),
    ],
)
def test_what_cannot_be_asked_of_a_dataset(arguments: list[str], words: str, folder: Path, capsys: Capture) -> None:
    if "recorded" in arguments:
        shutil.rmtree(folder / "depth")
    assert main(["replay", str(folder), *arguments]) == 2
    assert words in capsys.readouterr().err


def test_real_images_give_real_motions(tmp_path: Path, capsys: Capture) -> None:
    """Six frames of somebody's walk through an office, with the networks that come with flockd."""
    data = Path(os.environ.get("FLOCKD_DATA", "/nonexistent")) / "hololens"
    if not data.is_dir():
        pytest.skip("FLOCKD_DATA does not name a folder with hololens/ in it")
    for name in ("images", "depth"):
        (tmp_path / name).mkdir()
        for file in sorted((data / name).iterdir())[:6]:
            shutil.copy(file, tmp_path / name)
    (tmp_path / "poses.txt").write_text("".join((data / "poses.txt").read_text().splitlines(keepends=True)[:6]))
    shutil.copy(data / "K.txt", tmp_path)
    result = replayed(capsys, tmp_path, "--depth", "recorded", "--flow", "dis")
    assert result["estimated_ratio"] == 1.0
    assert result["rotation_error_deg"]["median"] < 0.3
    assert result["translation_error_m"]["median"] < 0.012
