"""How blurred a view of the board is: the width of its chessboard's edges."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import FloatArray, UInt8Array
from flockd.ground.calibration.board import BoardDetection, BoardSpec

_SMALLEST_SQUARE_PX = 10.0
"""Across smaller squares there is no room to measure an edge."""
_REACH, _STEP_PX = 0.35, 0.25
"""How far a profile goes to both sides, in squares, and how fine it is."""
_ALONG = np.linspace(-0.2, 0.2, 7)
"""Where along an edge its profile is taken, in squares from its middle; the average has less noise."""


def edge_width_px(grey: UInt8Array, seen: BoardDetection, spec: BoardSpec) -> float:
    """Pixels over which black becomes white, in the direction in which the view is blurred more.

    Of a perfectly sharp image it is between 1 and 2; of one blurred with a deviation of s pixels about 2.5 s. NaN
    where the board is too small to tell.
    """
    place = {int(number): index for index, number in enumerate(seen.ids)}
    across = spec.columns - 1
    widths = []
    for to_next, last_column in ((1, across - 1), (across, across)):
        edges = [
            (seen.pixels[place[number]], seen.pixels[place[number + to_next]])
            for number in place
            if number + to_next in place and number % across < last_column
        ]
        found = [_width(grey, first, second) for first, second in edges]
        measured = [width for width in found if np.isfinite(width)]
        if measured:
            widths.append(float(np.median(measured)))
    return max(widths) if widths else float("nan")


def _width(grey: UInt8Array, first: FloatArray, second: FloatArray) -> float:
    """Width of the edge between two neighbouring corners."""
    along = second - first
    square = float(np.linalg.norm(along))
    if square < _SMALLEST_SQUARE_PX:
        return float("nan")
    normal = np.array([-along[1], along[0]]) / square
    offsets = np.arange(-_REACH * square, _REACH * square, _STEP_PX)
    middles = (first + second) / 2 + _ALONG[:, None] * along
    samples = middles[:, None] + offsets[None, :, None] * normal - 0.5  # OpenCV has pixel centres at whole numbers
    maps = samples.astype(np.float32)
    profile = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mean = np.asarray(profile, np.float64).mean(axis=0)
    slope = float(np.abs(np.diff(mean)).max()) / _STEP_PX
    return float(np.ptp(mean)) / slope if slope > 0.0 else float("nan")
