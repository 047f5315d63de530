"""What the first stage learns of one image."""

from __future__ import annotations

import torch

from tools.training.dataset import PairSet
from tools.training.tasks import NeighboursTask


def test_depth_mask_and_offsets_are_drawn_towards_the_truth() -> None:
    shape = (2, 1, 8, 8)
    depth, logit = torch.full(shape, 4.0, requires_grad=True), torch.zeros(shape, requires_grad=True)
    offset = torch.zeros((2, 2, 8, 8), requires_grad=True)
    task = NeighboursTask(PairSet({}, 0))
    answer = depth, logit, offset
    task.net = lambda image, geometry: answer
    drone = torch.zeros(shape)
    drone[1, :, :, 4:] = 1.0
    batch = {"image": torch.zeros(0), "geometry": torch.zeros(0), "depth": torch.full(shape, 5.0), "drone": drone}
    loss, _ = task.loss(batch | {"offset": torch.full((2, 2, 8, 8), 3.0)})
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
