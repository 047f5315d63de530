"""YOLOX-nano in torch, and its loss (Ge et al. 2021, "YOLOX: Exceeding YOLO Series in 2021").

Depth 0.33, width 0.25, depthwise; an anchor-free detector: in each cell of three maps (strides 8, 16, 32) a box, an
objectness, and classes. Which cells answer for which box is SimOTA (sections 2.1 and 2.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tools.training.pictures import CLASSES, NOT_JUDGED

STRIDES = (8, 16, 32)
_WIDTHS = (16, 32, 64, 128, 256)
_HEAD = 64
_BN = {"eps": 1e-3, "momentum": 0.03}
NEAR_CELLS = 1.5
"""A cell may answer for a box whose centre is at most so many cells away, right and down."""
_BEST = 10
"""The sum of the best so many overlaps says how many cells answer for a box."""
_BOX_WEIGHT, _OVERLAP_COST, _FAR_COST = 5.0, 3.0, 1e6
_LEAST_TARGET = 0.75
"""Least target of a class while the box is still wrong: small boxes overlap badly for long."""


class Unit(nn.Module):
    """Convolution, batch norm, SiLU."""

    def __init__(self, into: int, out: int, size: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(into, out, size, stride, size // 2, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(out, **_BN)
        self.act = nn.SiLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        """(n, into, h, w) -> (n, out, h, w) / stride."""
        y: Tensor = self.act(self.norm(self.conv(x)))
        return y


def _separable(into: int, out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(Unit(into, into, 3, stride, groups=into), Unit(into, out))


class _Bottleneck(nn.Module):
    def __init__(self, width: int, *, shortcut: bool) -> None:
        super().__init__()
        self.first, self.second, self.shortcut = Unit(width, width), _separable(width, width), shortcut

    def forward(self, x: Tensor) -> Tensor:
        """Keeps the shape."""
        y: Tensor = self.second(self.first(x))
        return y + x if self.shortcut else y


class _CrossStage(nn.Module):
    """Cross-stage partial block: half of the channels go through bottlenecks."""

    def __init__(self, into: int, out: int, count: int = 1, *, shortcut: bool = False) -> None:
        super().__init__()
        half = out // 2
        self.through, self.past = Unit(into, half), Unit(into, half)
        self.blocks = nn.Sequential(*(_Bottleneck(half, shortcut=shortcut) for _ in range(count)))
        self.joined = Unit(2 * half, out)

    def forward(self, x: Tensor) -> Tensor:
        """(n, into, h, w) -> (n, out, h, w)."""
        through, past = self.through(x), self.past(x)
        y: Tensor = self.joined(torch.cat([self.blocks(through), past], 1))
        return y


class _Pyramid(nn.Module):
    """Spatial pyramid pooling."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.last = Unit(width, width // 2), Unit(2 * width, width)
        self.pools = nn.ModuleList(nn.MaxPool2d(size, 1, size // 2) for size in (5, 9, 13))

    def forward(self, x: Tensor) -> Tensor:
        """Keeps the shape."""
        x = self.first(x)
        y: Tensor = self.last(torch.cat([x, *(pool(x) for pool in self.pools)], 1))
        return y


class _Head(nn.Module):
    def __init__(self, into: int, classes: int) -> None:
        super().__init__()
        self.stem = Unit(into, _HEAD)
        self.cls_convs = nn.Sequential(_separable(_HEAD, _HEAD), _separable(_HEAD, _HEAD))
        self.cls = nn.Conv2d(_HEAD, classes, 1)
        self.reg_convs = nn.Sequential(_separable(_HEAD, _HEAD), _separable(_HEAD, _HEAD))
        self.reg, self.obj = nn.Conv2d(_HEAD, 4, 1), nn.Conv2d(_HEAD, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(n, into, h, w) -> (n, 5 + classes, h, w)."""
        x = self.stem(x)
        classes = self.cls(self.cls_convs(x))
        box = self.reg_convs(x)
        return torch.cat([self.reg(box), self.obj(box), classes], 1)


class DroneDetector(nn.Module):
    """(n, 3, h, w) RGB 0-255, h and w multiples of 32 -> (n, 5 + classes, h/s, w/s) for each stride s.

    Channels: centre right and down of the cell's corner, cells; log width and height, cells; logits of an object, and
    of each class given that there is one.
    """

    def __init__(self, classes: int = len(CLASSES)) -> None:
        super().__init__()
        a, b, c, d, e = _WIDTHS
        self.focus = Unit(12, a, 3)
        self.dark2 = nn.Sequential(_separable(a, b, 2), _CrossStage(b, b, 1, shortcut=True))
        self.dark3 = nn.Sequential(_separable(b, c, 2), _CrossStage(c, c, 3, shortcut=True))
        self.dark4 = nn.Sequential(_separable(c, d, 2), _CrossStage(d, d, 3, shortcut=True))
        self.dark5 = nn.Sequential(_separable(d, e, 2), _Pyramid(e), _CrossStage(e, e))
        self.lateral, self.mixed4 = Unit(e, d), _CrossStage(2 * d, d)
        self.reduce, self.mixed3 = Unit(d, c), _CrossStage(2 * c, c)
        self.down3, self.out4 = _separable(c, c, 2), _CrossStage(2 * c, d)
        self.down4, self.out5 = _separable(d, d, 2), _CrossStage(2 * d, e)
        self.heads = nn.ModuleList(_Head(width, classes) for width in (c, d, e))

    def forward(self, images: Tensor) -> list[Tensor]:
        """See the class."""
        x = images.flip(1)  # the weights were made for BGR
        x = torch.cat([x[..., ::2, ::2], x[..., 1::2, ::2], x[..., ::2, 1::2], x[..., 1::2, 1::2]], 1)
        at3 = self.dark3(self.dark2(self.focus(x)))
        at4 = self.dark4(at3)
        at5 = self.dark5(at4)
        low = self.lateral(at5)
        mixed = self.reduce(self.mixed4(torch.cat([_doubled(low), at4], 1)))
        out3 = self.mixed3(torch.cat([_doubled(mixed), at3], 1))
        out4 = self.out4(torch.cat([self.down3(out3), mixed], 1))
        out5 = self.out5(torch.cat([self.down4(out4), low], 1))
        return [head(out) for head, out in zip(self.heads, (out3, out4, out5), strict=True)]


class Boxes(nn.Module):
    """(1, h, w, 3) RGB 0-255 -> (cells, 4 + classes): centre and size in pixels, probabilities of the classes."""

    def __init__(self) -> None:
        super().__init__()
        self.detector = DroneDetector()

    def forward(self, image: Tensor) -> Tensor:
        """See the class."""
        maps = self.detector(image.permute(0, 3, 1, 2).float())
        box, there, kinds = decoded(maps)
        return torch.cat([box, there.sigmoid()[..., None] * kinds.sigmoid()], 2)[0]


def cells(maps: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Corners of all cells (a, 2) right and down, pixels, and their strides (a, 1)."""
    corners, strides = [], []
    for map_, stride in zip(maps, STRIDES, strict=True):
        one = torch.ones_like(map_[0, 0])
        corner = torch.stack([one.cumsum(1), one.cumsum(0)], -1).reshape(-1, 2) - 1
        corners.append(corner * stride)
        strides.append(one.reshape(-1, 1) * stride)
    return torch.cat(corners), torch.cat(strides)


def decoded(maps: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (n, a, 4) centre and size, pixels; logits of an object (n, a) and of classes (n, a, classes)."""
    flat = torch.cat([map_.float().flatten(2) for map_ in maps], 2).transpose(1, 2)
    corners, strides = cells(maps)
    middle = flat[..., :2] * strides + corners
    size = flat[..., 2:4].clamp(max=8.0).exp() * strides
    return torch.cat([middle, size], -1), flat[..., 4], flat[..., 5:]


def _doubled(x: Tensor) -> Tensor:
    return nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")


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
    """Image, cell, its box, and their overlap, of each assignment; ``near`` (n, m, cells): the permitted ones."""
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
