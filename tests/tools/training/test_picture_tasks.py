"""What `verification` and `detector` are shown, and going on from a shipped network. Needs the extra `train`."""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
import pytest
import torch

from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel
from tools.training.mine import proposed
from tools.training.networks import VerificationNet
from tools.training.picture_tasks import CROPS, HARD_ONES, KINDS, HardOnes, VerificationTask, crop_of, visibility
from tools.training.pictures import Proposals

ROOT = Path(__file__).resolve().parents[3]
MODELS = data_path("models")
DRONES = 12
GREEN, DARK = (30, 160, 30), 40


def write_lines(file: Path, *entries: object) -> None:
    file.write_text("".join(json.dumps(entry) + "\n" for entry in entries), encoding="utf-8")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Dark bars that stand for drones: crops, a cut-out, one labelled in noise; and two green photographs."""
    rng = np.random.default_rng(0)
    for name in ("crops", "cutouts", "photographs", "labelled/field"):
        (tmp_path / name).mkdir(parents=True)
    picture = rng.integers(120, 255, (DRONES, 96, 96, 3), dtype=np.uint8)
    mask = np.zeros((DRONES, 96, 96), np.uint8)
    picture[:, 36:60, 14:82], mask[:, 36:60, 14:82] = DARK, 255
    np.savez(
        tmp_path / "crops" / "1.npz", allow_pickle=False, picture=picture, mask=mask,
        target=np.tile(np.array([-3.0, 0.0, 0.0], np.float32), (DRONES, 1)),
        motors=np.zeros((DRONES, 4, 2), np.float32), family=np.zeros(DRONES, np.int64),
        apparent=np.full(DRONES, np.log(68.0), np.float32), drone=np.ones(DRONES, np.float32),
    )  # fmt: skip
    cutout = np.zeros((80, 120, 4), np.uint8)
    cutout[20:60, 10:110] = (DARK, DARK, DARK, 255)
    cv2.imwrite(str(tmp_path / "cutouts" / "a.png"), cutout)
    write_lines(tmp_path / "cutouts" / "index.jsonl", {"file": "a.png"})
    index = [{"file": name, "category": "field"} for name in ("a.png", "b.png")]
    for one in index:
        cv2.imwrite(str(tmp_path / "photographs" / one["file"]), np.full((200, 300, 3), GREEN, np.uint8))
    write_lines(tmp_path / "photographs" / "index.jsonl", *index)
    write_lines(tmp_path / "photographs" / "proposals.jsonl", *({**one, "boxes": [[9, 50, 69, 90]]} for one in index))
    real = rng.integers(120, 255, (200, 300, 3), dtype=np.uint8)
    real[68:92, 50:110] = DARK
    folder = tmp_path / "labelled" / "field"
    cv2.imwrite(str(folder / "c.png"), real)
    labels = {
        "images": [{"id": 1, "file_name": "c.png"}], "categories": [{"id": 1, "name": "drone"}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": [50, 68, 60, 24]}],
    }  # fmt: skip
    (folder / "labels.json").write_text(json.dumps(labels))
    write_lines(folder / "proposals.jsonl")
    return tmp_path


def train_verification(data: Path, start: Path) -> subprocess.CompletedProcess[str]:
    folders = map(str, ("--data", data, "--out", data / "run", "--start", start))
    options = ["--minutes", "0.01", "--rate", "3e-4", "--threads", "1", "--workers", "1"]
    command = [sys.executable, "-m", "tools.training.train", "verification", *folders, *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)


def answers(weights: Path, crops: np.ndarray) -> np.ndarray:
    net = VerificationNet()
    net.load_state_dict(torch.load(weights)["net"])
    with torch.no_grad():
        return np.asarray(net.eval()(torch.from_numpy(crops)).numpy())


@pytest.mark.slow
def test_it_begins_with_the_file_s_answers_and_learns_from_there(data: Path) -> None:
    done = train_verification(data, MODELS / "verification.onnx")
    assert done.returncode == 0, done.stderr
    crops = np.random.default_rng(1).integers(0, 255, (4, 96, 96, 3), dtype=np.uint8)
    (theirs,) = ort.InferenceSession(str(MODELS / "verification.onnx")).run(None, {"crop": crops})
    begun = answers(data / "run" / "start.pt", crops)
    assert np.abs(begun - theirs).max() < 1e-3 * np.abs(theirs).max()
    assert np.abs(answers(data / "run" / "checkpoint.pt", crops) - begun).max() > 0.0


def test_every_kind_is_drawn_says_what_it_shows_and_has_the_same_parts(data: Path) -> None:
    samples = VerificationTask(data).batch_samples(np.random.default_rng(0))
    assert [int(one["kind"]) for one in samples] == [KINDS.index(kind) for kind in KINDS for _ in range(CROPS[kind])]
    assert all({n: v.shape for n, v in one.items()} == {n: v.shape for n, v in samples[0].items()} for one in samples)
    for one in samples:
        assert float(one["drone"]) == (KINDS[int(one["kind"])] != "negative")
    shown = [one for one in samples if int(one["kind"]) == KINDS.index("composite")]
    assert np.mean([one["exists_weight"] for one in shown]) > 0.8
    corners = [one["picture"][:8, :8].reshape(-1, 3).mean(0) for one in shown]
    greens = [green > 1.3 * max(red, blue) for red, green, blue in corners]
    assert np.mean(greens) > 0.7, "drones stand before the photographs"


def test_what_is_taken_for_a_drone_is_remembered(data: Path) -> None:
    """Untrained, it says a half of everything, which is more than it may of a negative."""
    task = VerificationTask(data)
    samples = task.batch_samples(np.random.default_rng(0))
    task.loss({name: torch.from_numpy(np.stack([one[name] for one in samples])) for name in samples[0]})
    assert 0 < task.hard.count <= CROPS["negative"]


def test_a_crop_shows_what_is_around_its_middle_at_one_scale() -> None:
    image = np.zeros((400, 600, 3), np.uint8)
    image[180:220, 250:350] = 255
    for half in (60.0, 200.0):
        rows, columns = np.nonzero(crop_of(image, np.array([300.0, 200.0]), half)[:, :, 0] > 127)
        assert np.ptp(columns) + 1 == pytest.approx(100 * 48 / half, abs=1.5)
        assert [rows.mean() + 0.5, columns.mean() + 0.5] == pytest.approx([48.0, 48.0], abs=1.0)


def test_what_cannot_be_seen_hardly_counts() -> None:
    grey = np.full((96, 96, 3), 200, np.uint8)
    dark, faint = grey.copy(), grey.copy()
    dark[36:60, 14:82], faint[36:60, 14:82] = 40, 199
    assert visibility(dark, grey, 0.3) == 1.0
    assert visibility(faint, grey, 0.3) < 0.15


@pytest.mark.parametrize("network", ["detector", "neighbours_int8"])
def test_what_is_proposed_is_a_negative_but_beside_a_drone(network: str) -> None:
    """The picture of the documentation, with two drones in it."""
    image = cv2.imread(str(ROOT / "docs/pictures/detected.webp"), cv2.IMREAD_COLOR_RGB)
    assert image is not None
    height, width = (side // 32 * 32 for side in image.shape[:2])
    cut: np.ndarray = np.ascontiguousarray(image[:height, :width], np.uint8)
    model = OnnxModel(MODELS / f"{network}.yaml", threads=1)
    found = proposed(model, cut, [])
    assert found
    assert len(proposed(model, cut, found[:1])) < len(found)


def test_pictures_that_were_not_looked_through_are_refused_with_the_command(data: Path) -> None:
    (data / "photographs" / "proposals.jsonl").unlink()
    with pytest.raises(FileNotFoundError, match=r"make it with `python -m tools\.training\.mine`"):
        Proposals([data / "photographs"])


def test_a_process_that_draws_samples_sees_what_another_one_found_hard() -> None:
    hard = HardOnes()
    other = multiprocessing.get_context("fork").Process(target=hard.add, args=(torch.tensor([[1, 7], [1, 7]]),))
    other.start()
    other.join()
    assert hard.count == 2
    assert hard.draw(np.random.default_rng(0)) == (1, 7)


def test_of_what_was_hard_the_oldest_gives_way() -> None:
    hard = HardOnes()
    for row in range(HARD_ONES // 100 + 1):
        hard.add(torch.full((100, 2), row))
    drawn = {hard.draw(np.random.default_rng(k))[1] for k in range(400)}
    assert hard.count == HARD_ONES
    assert 0 not in drawn
    assert HARD_ONES // 100 in drawn


@pytest.mark.slow
def test_another_network_s_file_is_refused_in_one_sentence(data: Path) -> None:
    done = train_verification(data, MODELS / "neighbours.onnx")
    assert done.returncode == 1
    (said,) = done.stderr.strip().splitlines()
    assert said.startswith("--start: ")
    assert "neighbours.onnx" in said
