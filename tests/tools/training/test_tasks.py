"""What the training of the first and of the second stage asks of them. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tools.training.dataset import create_part
from tools.training.networks import DistanceNet
from tools.training.tasks import DistanceTask, NeighboursTask, SigmaTask

DRONES, OTHERS = 6, 6


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


def test_what_a_run_begins_with_is_the_teacher(tmp_path: Path) -> None:
    task, weights = task_of(tmp_path), answering(2.0).state_dict()
    task.go_on_from(weights)
    assert task.teacher is not None
    assert torch.equal(task.teacher.get_parameter("head.bias"), weights["head.bias"])
    assert torch.equal(task.net.get_parameter("head.bias"), weights["head.bias"])


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


def test_with_a_teacher_crops_without_a_drone_are_mixed_with_each_other_alone(tmp_path: Path) -> None:
    torch.manual_seed(0)
    task = task_of(tmp_path)
    seen: list[Tensor] = []
    task.net.register_forward_pre_hook(lambda _net, given: seen.append(given[0]))
    task.teacher = answering(0.0).eval()
    given = batch()
    # Grey levels that light and noise cannot carry from one kind to another.
    given["picture"][:DRONES], given["picture"][DRONES:] = 30, 200
    given["picture"][DRONES] = 110
    task.loss(given)
    drones, others = seen[0][:DRONES].float(), seen[0][DRONES:].float()
    assert (drones.mean((1, 2, 3)) < 60).all()
    assert (others.mean((1, 2, 3)) > 80).all()
    kinds = (others.mean(3) < 155).float().mean((1, 2))
    assert ((kinds > 0.01) & (kinds < 0.99)).any(), "one shows a part of the darker one, or it of another"


def test_sigma_learns_how_far_sizes_are_off_and_changes_nothing_else(tmp_path: Path) -> None:
    """All drones are judged half as large as they are. Of a Laplace distribution with that mean deviation, ln 2, the
    standard deviation is root 2 times as much."""
    torch.manual_seed(0)
    given = {name: values[:4] for name, values in batch().items()}
    task = SigmaTask(data_of(tmp_path, given))
    task.begin()
    torch.nn.init.constant_(task.net.get_parameter("doubt.2.bias"), 4.6)  # 67 %: few steps are to be enough
    before = task.net(given["picture"])[0].detach()
    given["target"][:, 0], given["apparent"] = before[:, 0], before[:, 5] + np.log(2.0)
    optimiser = torch.optim.Adam([one for one in task.net.parameters() if one.requires_grad], 3e-3)
    for _ in range(25):
        optimiser.zero_grad()
        task.loss(given)[0].backward()
        optimiser.step()
    after = task.net(given["picture"])[0].detach()
    assert torch.equal(after[:, :6], before[:, :6])
    assert float(torch.exp(after[:, 6]).mean()) == pytest.approx(np.sqrt(2.0) * np.log(2.0), rel=0.1)


def test_depth_mask_and_offsets_are_drawn_towards_the_truth(tmp_path: Path) -> None:
    shape = (2, 1, 8, 8)
    depth, logit = torch.full(shape, 4.0, requires_grad=True), torch.zeros(shape, requires_grad=True)
    offset = torch.zeros((2, 2, 8, 8), requires_grad=True)
    task = NeighboursTask(data_of(tmp_path, batch()))
    answer = depth, logit, offset
    task.net = lambda image, geometry: answer
    drone = torch.zeros(shape)
    drone[1, :, :, 4:] = 1.0
    seen = {"image": torch.zeros(0), "geometry": torch.zeros(0), "depth": torch.full(shape, 5.0), "drone": drone}
    loss, _ = task.loss(seen | {"offset": torch.full((2, 2, 8, 8), 3.0)})
    loss.backward()
    assert depth.grad is not None
    assert logit.grad is not None
    assert offset.grad is not None
    assert (depth.grad < 0).all(), "5 m is more than 4 m"
    assert (logit.grad[drone == 1] < 0).all()
    assert (logit.grad[drone == 0] > 0).all()
    beside = (drone == 0).expand_as(offset)
    assert (offset.grad[~beside] < 0).all()
    assert (offset.grad[beside] == 0).all(), "only a drone's pixels point to its centre"
