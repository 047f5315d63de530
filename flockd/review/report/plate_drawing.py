"""What plates and videos draw with: OpenCV's lines and letters, in colours as style sheets write them."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import FloatArray, UInt8Array

RIG_ORDER = ("left", "front", "right", "back")
"""Reading order of the cameras: a turn to the right. Cameras of other names follow in their own order."""
PLATE, INK, MUTED = "#14181f", "#e8ecf1", "#98a3b0"
"""As dark as film under either scheme of the page, so that the images appear alike in both."""
FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
"""Fractional bits of the pixels that OpenCV draws at."""
Colour = tuple[int, int, int]
"""RGB."""


def rig_place(camera: str) -> int:
    """Its place in the reading order."""
    return RIG_ORDER.index(camera) if camera in RIG_ORDER else len(RIG_ORDER)


def rgb(colour: str) -> Colour:
    """Of a colour as in `#0072b2`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def fixed_point(pixels: FloatArray) -> UInt8Array:
    """Pixels, whose middles are at halves, as OpenCV wants them with a shift."""
    return np.round((pixels - 0.5) * (1 << _SHIFT)).astype(np.int32)


def ring(image: UInt8Array, middle: FloatArray, radius_px: float, colour: str, thick: int) -> None:
    """A circle around (2,) pixels; of thickness -1 a disc."""
    at = tuple(fixed_point(middle).tolist())
    cv2.circle(image, at, round(radius_px * (1 << _SHIFT)), rgb(colour), thick, cv2.LINE_AA, _SHIFT)


def line(image: UInt8Array, pixels: FloatArray, colour: str, thick: int) -> None:
    """Through (n, 2) pixels."""
    cv2.polylines(image, [fixed_point(pixels)], False, rgb(colour), thick, cv2.LINE_AA, _SHIFT)


def width_of(text: str, size: float) -> int:
    """Pixels."""
    return int(cv2.getTextSize(text, FONT, size, 1)[0][0])


def write(image: UInt8Array, left: float, base: float, text: str, size: float, colour: str = "#ffffff") -> None:
    """With a dark rim, to be read on anything. The font has ASCII alone; the place is that of the lower left corner."""
    shown, (x, y) = text.encode("ascii", "replace").decode(), (round(left), round(base))
    for across, down in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(image, shown, (x + across, y + down), FONT, size, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(image, shown, (x, y), FONT, size, rgb(colour), 1, cv2.LINE_AA)
