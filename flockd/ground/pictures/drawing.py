"""What was detected, drawn into a copy of a picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flockd.core.messages import UInt8Array
from flockd.ground.pictures.single_frame import Box, DetectedDrone, PictureResult

_COLOURS = ((255, 109, 0), (0, 176, 255), (213, 0, 249), (0, 200, 83), (255, 214, 0), (255, 23, 68))
"""RGB, of one detection after the other."""
_LABELLED = (255, 255, 255)
_MASK_WEIGHT = 0.4
_REFERENCE_PX = 900.0
"""Longer side of a picture that lines of one pixel suit."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def annotated(image: UInt8Array, result: PictureResult, labelled: Sequence[Box] = ()) -> UInt8Array:
    """A copy of an image (h, w, 3), RGB, with each detection's box, mask, probability, range and size.

    ``labelled``: boxes of the drones that are known to be there, drawn in white.
    """
    height, width = image.shape[:2]
    mask = cv2.resize(result.mask, (width, height), interpolation=cv2.INTER_NEAREST)
    drawn = image.copy()
    thick = max(round(max(width, height) / _REFERENCE_PX), 1)
    for box in labelled:
        _rectangle(drawn, box, _LABELLED, thick)
    for number, one in enumerate(result.detections):
        colour = _COLOURS[number % len(_COLOURS)]
        mine = mask == one.label
        tint = (1 - _MASK_WEIGHT) * drawn[mine] + _MASK_WEIGHT * np.array(colour)
        drawn[mine] = np.round(tint).astype(np.uint8)
        _rectangle(drawn, one.box, colour, thick)
    taken: list[tuple[int, int, int, int]] = []
    for number, one in enumerate(result.detections):
        _write(drawn, one, _COLOURS[number % len(_COLOURS)], thick, taken)
    return drawn


def lines_of(one: DetectedDrone) -> tuple[str, ...]:
    """What is written beside a detection."""
    return (
        f"p {one.probability:.2f}",
        f"range {one.range_m:.2f} +- {one.range_sigma_m:.2f} m",
        f"size {one.size_m:.2f} +- {one.size_sigma_m:.2f} m",
    )


def _rectangle(image: UInt8Array, box: Box, colour: tuple[int, int, int], thick: int) -> None:
    """Around the box, not over what is in it."""
    left, top = (int(np.floor(value)) - thick for value in box[:2])
    right, bottom = (int(np.ceil(value)) + thick - 1 for value in box[2:])
    cv2.rectangle(image, (left, top), (right, bottom), colour, thick)


def _write(
    image: UInt8Array,
    one: DetectedDrone,
    colour: tuple[int, int, int],
    thick: int,
    taken: list[tuple[int, int, int, int]],
) -> None:
    """Below the box, or above it, inside the image and not over what was written before where that can be."""
    height, width = image.shape[:2]
    scale, texts = 0.42 * thick, lines_of(one)
    sizes = [cv2.getTextSize(text, _FONT, scale, thick)[0] for text in texts]
    step, wide = round(1.5 * sizes[0][1]), max(size[0] for size in sizes) + 4 * thick
    high = step * len(texts) + 4 * thick
    left = int(np.clip(one.box[0], 0, max(width - wide, 0)))
    below, above = int(one.box[3]) + 3 * thick, int(one.box[1]) - 3 * thick - high
    tops = [top for top in (below, above, *range(below + high, height, high)) if 0 <= top <= height - high]
    free = [top for top in tops if not any(_meet((left, top, left + wide, top + high), other) for other in taken)]
    top = (free or tops or [max(height - high, 0)])[0]
    taken.append((left, top, left + wide, top + high))
    part = image[top : top + high, left : left + wide]
    part[:] = part // 4  # dark, for the letters to be read on any background
    for row, text in enumerate(texts):
        place = (left + 2 * thick, top + step * (row + 1))
        cv2.putText(image, text, place, _FONT, scale, colour, thick, cv2.LINE_AA)


def _meet(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
