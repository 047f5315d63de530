"""How much of the image the views of a board cover, and where the board should be held next."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from flockd.core.messages import BoolArray, FloatArray, IntArray, UInt8Array

COLUMNS, ROWS = 8, 6
_DARK = 16
"""Grey levels: a cell in which no image ever shows more lies outside the lens's own image."""
_ENOUGH = 0.75
_TILT_DEG, _TILTED = 15.0, 4
"""So many views have to be tilted this much: only they tell the focal length from the distance."""
_NEAR = 0.3
"""A board in at least one view as wide as this share of the image."""
_PLACES = (("top left", "top", "top right"), ("left", "middle", "right"), ("bottom left", "bottom", "bottom right"))


class Coverage:
    """A grid over the image, with the corners that were seen in each of its cells."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.counts: IntArray = np.zeros((ROWS, COLUMNS), np.int64)
        self._brightest = np.zeros((ROWS, COLUMNS))
        self._widest = 0.0

    def add(self, pixels: FloatArray) -> None:
        """Corners (n, 2) of one more view."""
        columns = np.clip(pixels[:, 0] * COLUMNS / self.size[0], 0, COLUMNS - 1).astype(int)
        rows = np.clip(pixels[:, 1] * ROWS / self.size[1], 0, ROWS - 1).astype(int)
        np.add.at(self.counts, (rows, columns), 1)
        self._widest = max(self._widest, float(np.ptp(pixels, axis=0).max()) / max(self.size))

    def add_light(self, grey: UInt8Array) -> None:
        """A (h, w) image, with a board or without: where it is dark the lens may show nothing at all."""
        cells = cv2.resize(grey, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
        self._brightest = np.maximum(self._brightest, cells)

    @property
    def imaged(self) -> BoolArray:
        """(ROWS, COLUMNS) which cells the lens shows anything in."""
        lit: BoolArray = (self._brightest > _DARK) | (self.counts > 0)
        return lit

    @property
    def share(self) -> float:
        """0 to 1: cells with a corner, of those that the lens shows anything in."""
        cells = int(self.imaged.sum())
        return float((self.counts > 0).sum()) / cells if cells else 0.0

    @property
    def text(self) -> tuple[str, ...]:
        """The grid as lines of characters: full where corners were seen, dots where none, blank outside the lens."""
        signs = np.where(self.counts > 0, "##", np.where(self.imaged, "..", "  "))
        return tuple(" ".join(row) for row in signs)

    def advice(self, tilts_deg: Sequence[float]) -> tuple[str, ...]:
        """What is still missing, each in one sentence, the worst first; ``tilts_deg``: of the board in each view."""
        found = []
        tilted = sum(tilt > _TILT_DEG for tilt in tilts_deg)
        if tilted < _TILTED:
            found.append(
                f"tilt the board by 30 to 45 degrees, to each side and up and down: {tilted} of {len(tilts_deg)} views "
                f"are tilted by more than {_TILT_DEG:.0f} degrees"
            )
        if self.share < _ENOUGH:
            found.append(f"hold the board at the {self._emptiest()} of the image: no corner was seen there")
        if self._widest < _NEAR:
            found.append(
                f"hold the board nearer: at its largest it takes {100 * self._widest:.0f} % of the image's length"
            )
        return tuple(found)

    def _emptiest(self) -> str:
        empty = self.imaged & (self.counts == 0)
        zones = [
            (int(empty[ROWS * i // 3 : ROWS * (i + 1) // 3, a:b].sum()), abs(i - 1) + abs(j - 1), _PLACES[i][j])
            for i in range(3)
            for j, (a, b) in enumerate(pairwise((0, 3, 5, COLUMNS)))
        ]
        return max(zones)[2]
