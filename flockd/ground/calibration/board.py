"""The ChArUco board: a chessboard with a marker in each white square, so that a part of it in view is enough."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flockd.core.errors import FlockdError
from flockd.core.messages import FloatArray, IntArray, UInt8Array


class CalibrationError(FlockdError):
    """What was shown is not enough, or does not fit together, for numbers anybody should fly with."""


DICTIONARIES = tuple(
    sorted(name.removeprefix("DICT_").lower() for name in dir(cv2.aruco) if name.startswith("DICT_") and "X" in name)
)
"""As in `4x4_50`: markers of 4 by 4 cells, 50 of them."""
MIN_CORNERS = 8
"""Fewer say too little of where the board is."""
_CENTRE_PX = 0.5
"""OpenCV has pixel centres at whole numbers."""


@dataclass(frozen=True)
class BoardSpec:
    """A board as it is printed. Raises CalibrationError for one that cannot be made."""

    columns: int = 7
    rows: int = 5
    """In squares."""
    square_m: float = 0.036
    marker_m: float = 0.027
    """Sides of a chessboard square and of a marker."""
    dictionary: str = "4x4_50"

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            raise CalibrationError(f"there is no dictionary {self.dictionary!r}; take one of {', '.join(DICTIONARIES)}")
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > 50:
            raise CalibrationError(f"a board of {self.columns}x{self.rows} squares is none; take 3 to 50 each way")
        if self.corner_count < MIN_CORNERS:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares has too few corners; take 5x4 or more"
            )
        if not 0.0 < self.marker_m < self.square_m:
            raise CalibrationError("a marker has to be smaller than its square; make the marker 0.75 times as large")
        known, needed = int(self.dictionary.split("_")[1]), self.columns * self.rows // 2
        if needed > known:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares needs {needed} markers, and {self.dictionary} has "
                f"{known}; take a larger dictionary"
            )

    @property
    def corner_count(self) -> int:
        """Inner corners of the chessboard: what is found in images."""
        return (self.columns - 1) * (self.rows - 1)

    def image(self, pixels_per_square: int) -> UInt8Array:
        """(h, w) grey: the board without any margin."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(_opencv_board(self).generateImage(size, marginSize=0, borderBits=1), np.uint8)


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The board's corners that are seen in one image."""

    ids: IntArray
    """(n,) their numbers, row by row from the first corner of the board."""
    pixels: FloatArray
    """(n, 2) pixels with centres at +0.5."""
    points: FloatArray
    """(n, 3) metres on the board, z = 0."""


class BoardFinder:
    """Finds one board in images."""

    def __init__(self, spec: BoardSpec) -> None:
        self.spec = spec
        self._board = _opencv_board(spec)
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, grey: UInt8Array) -> BoardDetection | None:
        """The board in a (h, w) image; None where fewer than `MIN_CORNERS` are seen, or all in one line."""
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        # The stubs want a list of images here, which would be wrong.
        points, pixels = self._board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if min(len(np.unique(points[:, 0].round(9))), len(np.unique(points[:, 1].round(9)))) < 2:
            return None
        pixels = np.asarray(pixels, np.float64).reshape(-1, 2) + _CENTRE_PX
        return BoardDetection(np.asarray(ids, np.int64).reshape(-1), pixels, points)


def _opencv_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{spec.dictionary.upper()}"))
    return cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_m, spec.marker_m, dictionary)
