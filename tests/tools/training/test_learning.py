"""What the networks learn, and what is made of them. Needs torch: run with `make training`."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel, load_manifest
from tools.training.dataset import create_part
from tools.training.detector import Boxes, DroneDetector, detection_loss
from tools.training.export import draw_back, export
from tools.training.networks import DistanceNet, FlowNet, NeighboursNet, VerificationNet
from tools.training.picture_tasks import CROPS, KINDS, VerificationTask
from tools.training.pictures import CLASSES, NOT_JUDGED
from tools.training.quantise import quantise
from tools.training.samples import Sample
from tools.training.tasks import DistanceTask, FlowTask, Task
from tools.training.train import batches, start, train
from tools.training.weights import begin_with_onnx

pytestmark = pytest.mark.training

MODELS = data_path("models")
DRONES, OTHERS = 6, 6
GREEN, DARK = (30, 160, 30), 40
CELLS = ((8, 8), (4, 4), (2, 2))
"""Rows and columns of the maps of an image of 64 x 64 pixels."""
Feeds = dict[str, NDArray[Any]]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def shifted_pairs(folder: Path) -> Path:
    """One world of two pairs: smooth noise that moves 8 pixels to the right, and 4 down."""
    part = create_part(folder / "worlds" / "part-0000", 2)
    rng = np.random.default_rng(0)
    for pair in range(2):
        image = cv2.GaussianBlur(rng.integers(0, 255, (640, 480, 3), dtype=np.uint8), (0, 0), 6.0)
        part["image"][pair] = image, np.roll(image, (4, 8), (0, 1))
        part["flow"][pair] = np.array([8.0, 4.0])[:, None, None]
    part["flow_valid"][:], part["focal"][:], part["height"][:] = True, 222.0, 3.0
    part["R_ned_camera"][:] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return folder


def test_a_network_is_trained_resumed_exported_quantised_and_gone_on_from(tmp_path: Path) -> None:
    data, run, models = shifted_pairs(tmp_path / "data"), tmp_path / "run", tmp_path / "models"
    run.mkdir()
    spent_s = 0.0
    for steps in (1, 2):
        task = FlowTask(data)
        task.batch = 2
        train(task, run, spent_s + 1e-3, 1)
        state = torch.load(run / "checkpoint.pt")
        assert state["step"] == steps, "one more each time: resumed, not begun anew"
        assert state["spent"] > spent_s
        spent_s = state["spent"]
    assert len((run / "curve.csv").read_text(encoding="utf-8").splitlines()) == 3

    net = FlowNet(iterations=1)
    net.load_state_dict(state["net"])
    shipped, _ = load_manifest(MODELS / "flow.yaml")
    exported = export(net, shipped.model_dump(mode="json", exclude_defaults=True), models)
    twin, differences = quantise(exported, data / "worlds", models)
    assert OnnxModel(twin, threads=1).manifest.name == "flow_int8"
    assert max(differences.values()) < 0.1

    further = FlowTask(data)
    further.batch = 2
    start(further, models / "flow.onnx")
    before = further.net.sharpness.detach().clone()
    (tmp_path / "further").mkdir()
    train(further, tmp_path / "further", 1e-3, 1)
    assert further.net.sharpness != before, "it learns on"


def batch() -> dict[str, Tensor]:
    """Crops of noise, the first half of which are said to show drones."""
    n = DRONES + OTHERS
    there = (torch.arange(n) < DRONES).float()
    return {
        "picture": torch.randint(0, 256, (n, 96, 96, 3), dtype=torch.uint8),
        "mask": torch.zeros(n, 96, 96, dtype=torch.uint8),
        "target": torch.zeros(n, 3),
        "motors": torch.full((n, 4, 2), torch.nan),
        "family": torch.zeros(n, dtype=torch.int64),
        "apparent": torch.zeros(n),
        "drone": there,
    }


def answering(logit: float) -> DistanceNet:
    """A network that says of every crop that there is a drone in it, by this logit."""
    net = DistanceNet()
    net.head.weight.data.zero_()
    net.head.bias.data.zero_()
    net.head.bias.data[4] = logit
    return net


def data_of(folder: Path, crops: dict[str, Tensor]) -> Path:
    """One world of one pair, all zeros, and these crops."""
    create_part(folder / "worlds" / "part-0000", 1)
    (folder / "crops").mkdir()
    np.savez(folder / "crops" / "1.npz", **{name: values.numpy() for name, values in crops.items()})
    return folder


def task_of(folder: Path) -> DistanceTask:
    data = data_of(folder, batch())
    np.save(data / "worlds" / "negatives.npy", np.zeros((0, 5)))
    task = DistanceTask(data)
    task.net = answering(0.0).train()
    return task


@pytest.mark.parametrize(
    ("sure", "forgotten", "pull"),
    [(-3.0, 3.0, 0.1), (-0.5, 0.5, 0.05), (5.0, 0.0, 0.0)],
    ids=["much surer", "a little surer", "mistaken"],
)
def test_what_a_teacher_is_surer_of_is_no_drone_pulls_the_logit_down(
    tmp_path: Path, sure: float, forgotten: float, pull: float
) -> None:
    torch.manual_seed(0)
    task = task_of(tmp_path)
    task.teacher = answering(sure).eval()
    loss, figures = task.loss(batch())
    loss.backward()
    assert figures["forgotten"] == pytest.approx(forgotten)
    # Half of the crops are drones, all with the logit 0: by the labels alone it is neither to rise nor to fall.
    assert float(task.net.get_parameter("head.bias").grad[4]) == pytest.approx(pull, abs=1e-6)
    assert all(value.grad is None for value in task.teacher.parameters()), "the teacher does not learn"


def write_lines(file: Path, *entries: object) -> None:
    file.write_text("".join(json.dumps(entry) + "\n" for entry in entries), encoding="utf-8")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Dark bars that stand for drones: crops, a cut-out, one labelled in noise; and two green photographs."""
    rng = np.random.default_rng(0)
    for name in ("crops", "cutouts", "photographs", "labelled/field"):
        (tmp_path / name).mkdir(parents=True)
    picture = rng.integers(120, 255, (12, 96, 96, 3), dtype=np.uint8)
    mask = np.zeros((12, 96, 96), np.uint8)
    picture[:, 36:60, 14:82], mask[:, 36:60, 14:82] = DARK, 255
    np.savez(
        tmp_path / "crops" / "1.npz", allow_pickle=False, picture=picture, mask=mask,
        target=np.tile(np.array([-3.0, 0.0, 0.0], np.float32), (12, 1)),
        motors=np.zeros((12, 4, 2), np.float32), family=np.zeros(12, np.int64),
        apparent=np.full(12, np.log(68.0), np.float32), drone=np.ones(12, np.float32),
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


def maps(logit: float = -5.0) -> list[torch.Tensor]:
    """Small boxes that are nothing."""
    made = [torch.zeros(1, 5 + len(CLASSES), *cells) for cells in CELLS]
    for one in made:
        one[:, 2:4], one[:, 4:] = -3.0, logit
    return made


def test_the_right_answer_costs_less_than_another_box_and_than_nothing() -> None:
    box, kind = torch.tensor([[[28.0, 20.0, 16.0, 8.0]]]), torch.tensor([[0]])
    right, beside = maps(), maps()
    for made, shift in ((right, 0.0), (beside, 1.0)):
        made[0][0, :4, 2, 3] = torch.tensor([0.5 + shift, 0.5, float(np.log(2.0)), 0.0])
        made[0][0, 4:6, 2, 3] = 5.0
    costs = [float(detection_loss(one, box, kind)[0]) for one in (right, beside, maps())]
    assert costs[0] < costs[1] < costs[2]


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


def picture_of_nothing(*shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)


NETWORKS: dict[str, tuple[Callable[[], nn.Module], Feeds]] = {
    "distance": (DistanceNet, {"picture": picture_of_nothing(8, 96, 96, 3)}),
    "verification": (VerificationNet, {"crop": picture_of_nothing(8, 96, 96, 3)}),
    "neighbours": (
        NeighboursNet,
        {
            "image": picture_of_nothing(1, 96, 128, 3),
            "geometry": np.random.default_rng(2).uniform(-0.3, 0.3, (1, 3, 48, 64)).astype(np.float32),
        },
    ),
    "flow": (
        lambda: FlowNet(iterations=1),
        {"first": picture_of_nothing(1, 64, 96, 3), "second": picture_of_nothing(1, 64, 96, 3)[:, :, ::-1].copy()},
    ),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_a_shipped_network_says_the_same_in_torch_as_its_file_does(name: str) -> None:
    made, feeds = NETWORKS[name]
    net, tensors = made(), [torch.from_numpy(values) for values in feeds.values()]
    begin_with_onnx(net, MODELS / f"{name}.onnx", lambda: net(*tensors))
    net.eval()
    with torch.no_grad():
        ours = net(*tensors)
    theirs = ort.InferenceSession(str(MODELS / f"{name}.onnx")).run(None, feeds)
    for our, their in zip(ours if isinstance(ours, tuple) else (ours,), theirs, strict=True):
        assert np.abs(our.numpy() - their).max() < 1e-3 * np.abs(their).max()


def test_a_detector_goes_on_from_the_shipped_one_and_not_from_another_network() -> None:
    image, net = picture_of_nothing(1, 64, 64, 3), Boxes()
    given = torch.from_numpy(image)
    begin_with_onnx(net.detector, MODELS / "detector.onnx", lambda: net(given))
    with torch.no_grad():
        ours = net.eval()(given).numpy()
    (theirs,) = ort.InferenceSession(str(MODELS / "detector.onnx")).run(None, {"image": image})
    assert np.abs(ours - theirs).max() < 1e-3 * np.abs(theirs).max()
    for other, name in ((DroneDetector(), "flow"), (DistanceNet(), "neighbours")):
        with pytest.raises(ValueError, match=rf"{name}\.onnx: its "):
            begin_with_onnx(other, MODELS / f"{name}.onnx", lambda: None)


def test_a_network_is_exported_as_the_shipped_one_is_used_and_in_16_bits_says_the_same(tmp_path: Path) -> None:
    torch.manual_seed(0)
    shipped, _ = load_manifest(data_path("models") / "flow.yaml")
    document = shipped.model_dump(mode="json", exclude_defaults=True)
    net = FlowNet(iterations=1)
    whole, half = (OnnxModel(export(net, document, tmp_path / str(k), half=k == 1), threads=1) for k in (0, 1))
    for model in (whole, half):
        assert model.manifest.thresholds == shipped.thresholds
        assert model.manifest.image_scale == shipped.image_scale
        assert model.manifest.sha256 != shipped.sha256
    sizes = [(tmp_path / folder / "flow.onnx").stat().st_size for folder in ("1", "0")]
    assert 0.45 < sizes[0] / sizes[1] < 0.6
    assert "flow, mean difference from 32-bit weights" in half.manifest.accuracy.keys() - whole.manifest.accuracy.keys()
    images = np.random.default_rng(0).integers(0, 255, (2, 1, 64, 64, 3), dtype=np.uint8)
    was, now = (model.run(dict(zip(("first", "second"), images, strict=True)))["flow"] for model in (whole, half))
    assert 0.0 < np.abs(now - was).mean() < 0.01 * was.std()


def test_weights_are_drawn_back_a_third_of_the_way_to_what_the_run_began_with() -> None:
    net = nn.Sequential(nn.Linear(2, 1), nn.Linear(1, 1))
    nn.init.constant_(net[0].weight, 1.0)
    later = net[1].weight.item()
    draw_back(net, {"0.weight": torch.tensor([[3.0, 0.0]])})
    assert net[0].weight.tolist() == [pytest.approx([1.7, 0.65])]
    assert net[1].weight.item() == later, "a layer that the start did not have"
    with pytest.raises(SystemExit, match=r"--begun-with: its 0\.weight is not the run's"):
        draw_back(net, {"0.weight": torch.zeros(1, 3)})


class Numbers(Task):
    """Any number is a sample."""

    def __init__(self) -> None:
        super().__init__(nn.Linear(1, 1), 1, 1e-3)

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``."""
        return {"number": np.array([rng.random()])}


def drawn(seed: list[int], workers: int) -> list[float]:
    return [float(batch["number"]) for batch in islice(batches(Numbers(), seed, workers), 6)]


@pytest.mark.parametrize("workers", [1, 2])
def test_every_batch_is_another_one_and_the_same_again_from_the_same_seed(workers: int) -> None:
    first = drawn([3, 0], workers)
    assert len(set(first)) == 6
    assert first == drawn([3, 0], workers)
    assert set(first).isdisjoint(drawn([3, 1], workers))
