"""Rows of named cut-outs of pictures, to look at what was found, missed and mistaken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
SIDE_PX, ACROSS = 160, 10


def cut_out(image: Array, u: float, v: float, half: float) -> Array:
    """What is within ``half`` pixels of a pixel of an image (h, w, 3), at the sheet's size; black beside the image."""
    side = max(round(2 * half), 2)
    moved = np.array([[1.0, 0.0, side / 2 - u], [0.0, 1.0, side / 2 - v]])
    part = cv2.warpAffine(image, moved, (side, side), borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(cv2.resize(part, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA), np.uint8)


def named(image: Array, text: str, *, good: bool) -> Array:
    """A copy with a text at its foot, in white or in red."""
    copy = image.copy()
    colour = (255, 255, 255) if good else (255, 60, 60)
    cv2.putText(copy, text, (3, SIDE_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(copy, text, (3, SIDE_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.38, colour, 1, cv2.LINE_AA)
    return copy


def grid(crops: Sequence[Array]) -> Array:
    """All of them in rows; (0, 0, 3) where there are none."""
    if not crops:
        return np.empty((0, 0, 3), np.uint8)
    filled = [*crops, *[np.zeros_like(crops[0])] * (-len(crops) % ACROSS)]
    return np.vstack([np.hstack(filled[k : k + ACROSS]) for k in range(0, len(filled), ACROSS)])


def write_sheet(parts: Sequence[Array], path: Path) -> None:
    """RGB images below each other, those that are not empty."""
    shown = [part for part in parts if part.size]
    wide = max((part.shape[1] for part in shown), default=0)
    padded = [cv2.copyMakeBorder(part, 0, 6, 0, wide - part.shape[1], cv2.BORDER_CONSTANT) for part in shown]
    if padded:
        cv2.imwrite(str(path), cv2.cvtColor(np.vstack(padded), cv2.COLOR_RGB2BGR))
