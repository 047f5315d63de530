"""What YOLOX learns by: which cells answer for which box (SimOTA), and how wrong their answers are.

Ge et al. 2021, "YOLOX: Exceeding YOLO Series in 2021", sections 2.1 and 2.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from tools.training.detector.network import CLASSES, NOT_JUDGED, cells, decoded

NEAR_CELLS = 1.5
"""A cell may answer for a box whose centre is at most so many cells away, right and down."""
_BEST = 10
"""The sum of the best so many overlaps says how many cells answer for a box."""
_BOX_WEIGHT, _OVERLAP_COST, _FAR_COST = 5.0, 3.0, 1e6
_LEAST_TARGET = 0.75
"""A class is learnt as at least so probable, where the box is still wrong: small boxes overlap badly for long."""


def detection_loss(maps: Sequence[Tensor], boxes: Tensor, classes: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Loss and figures; boxes (n, m, 4) centre and size, pixels, classes (n, m), of ``CLASSES``, ``NO_BOX``
    or ``NOT_JUDGED``.

    Cells whose centre lies in a box that is not judged learn nothing of whether there is an object.
    """
    predicted, there, kinds = decoded(maps)
    corners, strides = cells(maps)
    middles = corners + strides / 2
    wanted = torch.zeros_like(there)
    judged = torch.ones_like(there)
    box_loss, class_loss, count = predicted.new_zeros(()), predicted.new_zeros(()), 0
    overlaps = []
    for k in range(len(boxes)):
        for box in boxes[k][classes[k] == NOT_JUDGED]:
            judged[k][((middles - box[:2]).abs() < box[2:] / 2 + strides / 2).all(1)] = 0
        real = classes[k] >= 0
        if not real.any():
            continue
        truth, kind = boxes[k][real], classes[k][real]
        cell, of, overlap = _assigned(predicted[k], there[k], kinds[k], truth, kind, middles, strides)
        if not len(cell):
            continue
        wanted[k, cell], judged[k, cell] = 1.0, 1.0
        box_loss = box_loss + (1 - _overlap(predicted[k, cell], truth[of]) ** 2).sum()
        target = F.one_hot(kind[of], len(CLASSES)) * overlap.clamp(min=_LEAST_TARGET)[:, None]
        class_loss = class_loss + F.binary_cross_entropy_with_logits(kinds[k, cell], target, reduction="sum")
        count += len(cell)
        overlaps.append(overlap)
    object_loss = F.binary_cross_entropy_with_logits(there, wanted, weight=judged, reduction="sum")
    loss = (_BOX_WEIGHT * box_loss + object_loss + class_loss) / max(count, 1)
    return loss, {
        "overlap": float(torch.cat(overlaps).mean()) if overlaps else float("nan"),
        "object": float(object_loss.detach()) / max(count, 1),
        "class": float(class_loss.detach()) / max(count, 1),
    }


@torch.no_grad()
def _assigned(
    predicted: Tensor, there: Tensor, kinds: Tensor, truth: Tensor, kind: Tensor, middles: Tensor, strides: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells, which box each answers for, and their overlap."""
    away = (middles[None] - truth[:, None, :2]).abs()
    near = (away <= NEAR_CELLS * strides[None]).all(-1)
    some = near.any(0).nonzero()[:, 0]
    if not len(some):
        return some, some, middles.new_zeros(0)
    near = near[:, some]
    overlap = _overlap(predicted[some][None], truth[:, None])
    score = (there[some].sigmoid()[:, None] * kinds[some].sigmoid()).sqrt().clamp(1e-6, 1 - 1e-6)
    one_hot = F.one_hot(kind, len(CLASSES)).float()
    wrong = -(one_hot[:, None] * score.log() + (1 - one_hot[:, None]) * (1 - score).log()).sum(-1)
    cost = wrong - _OVERLAP_COST * (overlap + 1e-8).log() + _FAR_COST * ~near
    chosen = torch.zeros_like(near)
    for j in range(len(truth)):
        best = overlap[j][near[j]].topk(min(_BEST, int(near[j].sum()))).values
        number = max(int(best.sum()), 1)
        chosen[j, cost[j].topk(min(number, len(some)), largest=False).indices] = True
    chosen &= near
    twice = chosen.sum(0) > 1
    if twice.any():
        of = cost[:, twice].argmin(0)
        chosen[:, twice] = False
        chosen[of, twice.nonzero()[:, 0]] = True
    box, cell = chosen.nonzero(as_tuple=True)
    return some[cell], box, overlap[box, cell]


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of boxes (..., 4) centre and size."""
    low = torch.maximum(a[..., :2] - a[..., 2:] / 2, b[..., :2] - b[..., 2:] / 2)
    high = torch.minimum(a[..., :2] + a[..., 2:] / 2, b[..., :2] + b[..., 2:] / 2)
    both = (high - low).clamp(min=0).prod(-1)
    return both / (a[..., 2:].prod(-1) + b[..., 2:].prod(-1) - both + 1e-9)
