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
    away = (middles[None, None] - boxes[:, :, None, :2]).abs()
    unknown = (away < boxes[:, :, None, 2:] / 2 + strides / 2).all(3) & (classes == NOT_JUDGED)[:, :, None]
    image, cell, of, overlap = _assigned(predicted, there, kinds, boxes, classes, (away <= NEAR_CELLS * strides).all(3))
    wanted, judged = torch.zeros_like(there), (~unknown.any(1)).float()
    wanted[image, cell], judged[image, cell] = 1.0, 1.0
    box_loss = (1 - _overlap(predicted[image, cell], boxes[image, of]) ** 2).sum()
    target = F.one_hot(classes[image, of], len(CLASSES)) * overlap.clamp(min=_LEAST_TARGET)[:, None]
    class_loss = F.binary_cross_entropy_with_logits(kinds[image, cell], target, reduction="sum")
    object_loss = F.binary_cross_entropy_with_logits(there, wanted, weight=judged, reduction="sum")
    count = max(len(cell), 1)
    loss = (_BOX_WEIGHT * box_loss + object_loss + class_loss) / count
    return loss, {
        "overlap": float(overlap.mean()),
        "object": float(object_loss.detach()) / count,
        "class": float(class_loss.detach()) / count,
    }


@torch.no_grad()
def _assigned(
    predicted: Tensor, there: Tensor, kinds: Tensor, boxes: Tensor, classes: Tensor, near: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, cell, which box it answers for, and their overlap; ``near`` (n, m, cells): which may answer for which."""
    near = near & (classes >= 0)[:, :, None]
    overlap = _overlap(predicted[:, None], boxes[:, :, None])
    score = (there.sigmoid()[..., None] * kinds.sigmoid()).sqrt().clamp(1e-6, 1 - 1e-6)
    right, wrong = score.log(), (1 - score).log()
    own = F.one_hot(classes.clamp(min=0), len(CLASSES)).to(score)
    unlike = -(own @ (right - wrong).transpose(1, 2) + wrong.sum(2)[:, None])
    cost = (unlike - _OVERLAP_COST * (overlap + 1e-8).log()).where(near, _FAR_COST)
    best = overlap.where(near, 0.0).topk(_BEST, 2).values.sum(2).int().clamp(min=1)
    cheapest = cost.topk(_BEST, 2, largest=False).indices
    taken = torch.arange(_BEST, device=cost.device) < best[:, :, None]
    chosen = torch.zeros_like(near).scatter_(2, cheapest, taken) & near
    # A cell that several boxes chose answers for the one that costs it least.
    least = cost.where(chosen, _FAR_COST).argmin(1, keepdim=True)
    chosen &= torch.arange(near.shape[1], device=cost.device)[:, None] == least
    image, box, cell = chosen.nonzero(as_tuple=True)
    return image, cell, box, overlap[image, box, cell]


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of boxes (..., 4) centre and size."""
    low = torch.maximum(a[..., :2] - a[..., 2:] / 2, b[..., :2] - b[..., 2:] / 2)
    high = torch.minimum(a[..., :2] + a[..., 2:] / 2, b[..., :2] + b[..., 2:] / 2)
    both = (high - low).clamp(min=0).prod(-1)
    return both / (a[..., 2:].prod(-1) + b[..., 2:].prod(-1) - both + 1e-9)
