"""How well drones are found in labelled pictures, and how often something else is taken for one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockd.ground.pictures.single_frame import Box, DetectedDrone

WIDTHS_PX = (0, 6, 12, 30, 80)
"""Where the classes of box width begin; the last one is open."""
WIDTH_CLASSES = tuple(f"{a}-{b}" for a, b in zip(WIDTHS_PX, [*map(str, WIDTHS_PX[1:]), ""], strict=True))
AP_IOU = 0.5
"""Least intersection over union with a box of ``ap50``."""

Fit = Callable[[DetectedDrone, Box], float | None]
"""How well a detection fits a box, the more the better; None: not at all."""


@dataclass(frozen=True)
class Labelled:
    """One picture's detections beside the boxes of the drones that are in it; no boxes: no drone is."""

    detections: tuple[DetectedDrone, ...]
    boxes: tuple[Box, ...] = ()


def width_class(box: Box) -> str:
    """``"6-12"`` and so on; the last class is ``"80-"``."""
    return WIDTH_CLASSES[int(np.searchsorted(WIDTHS_PX, box[2] - box[0], side="right")) - 1]


def centre_in_box(one: DetectedDrone, box: Box) -> float | None:
    """The nearer a detection's centre to the box's, the better; None where it does not lie in the box."""
    (u, v), (left, top, right, bottom) = one.centre_px, box
    if not (left <= u <= right and top <= v <= bottom):
        return None
    return -float(np.hypot(u - (left + right) / 2, v - (top + bottom) / 2))


def overlap(least: float) -> Fit:
    """By intersection over union of the boxes, at least ``least``."""

    def fit(one: DetectedDrone, box: Box) -> float | None:
        iou = intersection_over_union(one.box, box)
        return iou if iou >= least else None

    return fit


def intersection_over_union(a: Box, b: Box) -> float:
    """0 to 1."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)]
    return width * height / (sum(areas) - width * height)


def match(picture: Labelled, fit: Fit) -> tuple[list[bool], list[tuple[float, bool]]]:
    """Which boxes are found, and each detection's probability with whether it found one.

    Greedy: the most probable detection takes, of the boxes that are left, the one that it fits best.
    """
    found = [False] * len(picture.boxes)
    judged = []
    for one in sorted(picture.detections, key=lambda detection: -detection.probability):
        fits = [
            (value, -k) for k, box in enumerate(picture.boxes) if not found[k] and (value := fit(one, box)) is not None
        ]
        if fits:
            found[-max(fits)[1]] = True
        judged.append((one.probability, bool(fits)))
    return found, judged


def average_precision(judged: Sequence[tuple[float, bool]], boxes: int) -> float | None:
    """Area under the curve of the best precision at each recall or a higher one; None without boxes.

    As of PASCAL VOC since 2010 (Everingham et al. 2015), at every recall that occurs.

    Args:
        judged: of all detections the probability, and whether it found a box.
        boxes: how many there are to find.
    """
    if not boxes:
        return None
    ordered = sorted(judged, key=lambda one: -one[0])
    probabilities = np.array([probability for probability, _ in ordered])
    hits = np.cumsum([is_true for _, is_true in ordered])
    last = np.append(probabilities[1:] != probabilities[:-1], True)[: len(ordered)]  # equal ones count together
    precision = (hits / np.arange(1, len(ordered) + 1))[last]
    recall = hits[last] / boxes
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(best * np.diff(recall, prepend=0.0)))


def summary(pictures: Sequence[Labelled]) -> dict[str, Any]:
    """The summary of one set of labelled pictures.

    ``boxes``; ``by_width``: by the box's width in pixels the boxes, those ``found`` (a detection's centre lies in the
    box); ``ap50``; ``measured``: how many pictures; ``false``: detections that found no box; ``false_per_picture``.
    """
    counts = {name: {"boxes": 0, "found": 0} for name in WIDTH_CLASSES}
    false, judged = 0, list[tuple[float, bool]]()
    for one in pictures:
        by_centre, by_each = match(one, centre_in_box)
        false += sum(not is_true for _, is_true in by_each)
        judged += match(one, overlap(AP_IOU))[1]
        for box, is_found in zip(one.boxes, by_centre, strict=True):
            of_width = counts[width_class(box)]
            of_width["boxes"] += 1
            of_width["found"] += is_found
    boxes, measured = sum(len(picture.boxes) for picture in pictures), len(pictures)
    ap50 = average_precision(judged, boxes)
    return {
        "boxes": boxes,
        "by_width": counts,
        "ap50": None if ap50 is None else round(ap50, 4),
        "measured": measured,
        "false": false,
        "false_per_picture": false / measured if measured else None,
    }
