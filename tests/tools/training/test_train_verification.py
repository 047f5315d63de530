"""Going on with the training of a shipped verification network, as a command. Needs the extra `train`."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch

from flockd.core.data import data_path
from tools.training.networks import VerificationNet
from tools.training.real_patches import PATCH_PX
from tools.training.train_verification import HARD_ONES, HardOnes, VerificationTask

ROOT = Path(__file__).resolve().parents[3]
MODELS = data_path("models")
DRONES, PATCHES = 12, 4


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Dark bars that stand for drones, `rendered` and in `patches` of noise."""
    rng = np.random.default_rng(0)
    for folder in ("rendered", "patches"):
        (tmp_path / folder).mkdir()
    picture = rng.integers(120, 255, (DRONES, 96, 96, 3), dtype=np.uint8)
    mask = np.zeros((DRONES, 96, 96), np.uint8)
    picture[:, 36:60, 14:82], mask[:, 36:60, 14:82] = 40, 255
    np.savez(
        tmp_path / "rendered" / "1.npz", allow_pickle=False, picture=picture, mask=mask,
        target=np.tile(np.array([-3.0, 0.0, 0.0], np.float32), (DRONES, 1)),
        motors=np.zeros((DRONES, 4, 2), np.float32), family=np.zeros(DRONES, np.int64),
        apparent=np.full(DRONES, np.log(68.0), np.float32), drone=np.ones(DRONES, np.float32),
    )  # fmt: skip
    arrays: dict[str, np.ndarray] = {}
    for kind in ("negative", "place", "drone"):
        arrays[kind] = rng.integers(120, 255, (PATCHES, PATCH_PX, PATCH_PX, 3), dtype=np.uint8)
        arrays[f"{kind}_half_px"] = np.full(PATCHES, 12.0, np.float32)
        arrays[f"{kind}_box"] = np.tile(np.array([50, 68, 110, 92], np.float32), (PATCHES, 1))
    arrays["drone"][:, 68:92, 50:110] = 40
    np.savez(tmp_path / "patches" / "some.npz", allow_pickle=False, **arrays)
    return tmp_path


def train_verification(data: Path, start: Path) -> subprocess.CompletedProcess[str]:
    folders = ("--rendered", data / "rendered", "--patches", data / "patches", "--out", data / "run")
    command = [sys.executable, "-m", "tools.training.train_verification", *map(str, folders)]
    options = ["--start", str(start), "--minutes", "0.01", "--rate", "3e-4", "--threads", "1", "--workers", "1"]
    return subprocess.run(command + options, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)


def answers(weights: Path, crops: np.ndarray) -> np.ndarray:
    net = VerificationNet()
    net.load_state_dict(torch.load(weights)["net"])
    with torch.no_grad():
        return np.asarray(net.eval()(torch.from_numpy(crops)).numpy())


def test_it_begins_with_the_file_s_answers_and_learns_from_there(data: Path) -> None:
    done = train_verification(data, MODELS / "verification.onnx")
    assert done.returncode == 0, done.stderr
    crops = np.random.default_rng(1).integers(0, 255, (4, 96, 96, 3), dtype=np.uint8)
    (theirs,) = ort.InferenceSession(str(MODELS / "verification.onnx")).run(None, {"crop": crops})
    begun = answers(data / "run" / "start.pt", crops)
    assert np.abs(begun - theirs).max() < 1e-3 * np.abs(theirs).max()
    assert np.abs(answers(data / "run" / "checkpoint.pt", crops) - begun).max() > 0.0


def test_what_is_taken_for_a_drone_is_remembered(data: Path) -> None:
    """Untrained, it says a half of everything, which is more than it may of a negative."""
    task = VerificationTask(data / "rendered", data / "patches")
    samples = task.batch_samples(np.random.default_rng(0))
    task.loss({name: torch.from_numpy(np.stack([one[name] for one in samples])) for name in samples[0]})
    assert 0 < task.hard.count <= task.mix["negative"]


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


def test_another_network_s_file_is_refused_in_one_sentence(data: Path) -> None:
    done = train_verification(data, MODELS / "neighbours.onnx")
    assert done.returncode == 1
    (said,) = done.stderr.strip().splitlines()
    assert said.startswith("--start: ")
    assert "neighbours.onnx" in said
