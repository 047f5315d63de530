"""Selects views of a board for calibration from many images, and says where the board should be held next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np

from flockd.core.messages import BoolArray, FloatArray, IntArray, UInt8Array
from flockd.ground.calibration.board import CENTRE_PX, BoardDetection, BoardFinder, CalibrationError

COLUMNS, ROWS = 8, 6
_DARK = 16
"""Grey levels: a cell that is never brighter in any image lies outside the lens's own image."""
_ENOUGH = 0.75
_TILT_DEG, _TILTED = 15.0, 4
"""Number of tilted views, and their least tilt: only they separate the focal length from the distance."""
_NEAR = 0.3
"""At least one view shows a board as wide as this share of the image."""
_PLACES = (("top left", "top", "top right"), ("left", "middle", "right"), ("bottom left", "bottom", "bottom right"))


class Coverage:
    """A grid over the image, with the number of corners in each cell."""

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
        """Takes an image (h, w), with or without a board: cells that are always dark are outside the lens's image."""
        cells = cv2.resize(grey, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
        self._brightest = np.maximum(self._brightest, cells)

    @property
    def imaged(self) -> BoolArray:
        """(ROWS, COLUMNS) mask of cells in the lens's image."""
        lit: BoolArray = (self._brightest > _DARK) | (self.counts > 0)
        return lit

    @property
    def share(self) -> float:
        """Share of the cells in the lens's image that have a corner, 0 to 1."""
        cells = int(self.imaged.sum())
        return float((self.counts > 0).sum()) / cells if cells else 0.0

    @property
    def text(self) -> tuple[str, ...]:
        """The grid as lines of characters: full with corners, dots without, blank outside the lens's image."""
        signs = np.where(self.counts > 0, "##", np.where(self.imaged, "..", "  "))
        return tuple(" ".join(row) for row in signs)

    def advice(self, tilts_deg: Sequence[float]) -> tuple[str, ...]:
        """Sentences about what is still missing, the worst first; ``tilts_deg``: tilt of the board in each view."""
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


Refusal = Literal["no board", "blurred", "moving", "like another"]
MOST_VIEWS = 100
"""Largest number of views; further ones count as duplicates."""
_SHARP_PX, _SHARP_SHARE = 4.0, 0.003
"""Widest edge of a sharp view, in pixels, or as a share of a large image's width."""
_ALIKE = 0.03
"""Two views whose corners differ by less than this share of the image's width, on average, are duplicates."""
_STILL = 0.003
"""The same for a board that is held still between two frames."""
_SAME = 0.6
"""Share of common corners below which two views show different parts of the board."""


@dataclass(frozen=True, eq=False)
class View:
    """One image of the board."""

    name: str
    """Name of the file, or the frame's number or time."""
    seen: BoardDetection
    edge_px: float
    """See `edge_width_px`."""


@dataclass(frozen=True)
class Refused:
    """An image that is not used."""

    name: str
    why: Refusal
    edge_px: float | None = None
    """Width of a blurred edge."""


class Collector:
    """Takes images of one camera one after the other. Raises CalibrationError for an image of another size."""

    def __init__(self, finder: BoardFinder) -> None:
        self._finder = finder
        self._first = ""
        self._before: BoardDetection | None = None
        self.views: list[View] = []
        self.refused: list[Refused] = []
        self.coverage: Coverage | None = None
        """None before the first image."""

    def offer(self, name: str, image: UInt8Array, *, moving: bool = False) -> Refusal | None:
        """Takes an RGB image (h, w, 3). Returns why it is refused; None: it is a new view.

        ``moving``: images of a live camera, in which a board that is moved must be refused.
        """
        self._check_size(name, (image.shape[1], image.shape[0]))
        assert self.coverage is not None
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        self.coverage.add_light(grey)
        seen = self._finder.find(grey)
        before, self._before = self._before, seen
        if seen is None:
            return self._refuse(Refused(name, "no board"))
        edge_px = edge_width_px(grey, seen, self._finder.spec.columns)
        if edge_px > max(_SHARP_PX, _SHARP_SHARE * image.shape[1]):
            return self._refuse(Refused(name, "blurred", edge_px))
        if moving and (before is None or _apart(before, seen, image.shape[1]) >= _STILL):
            return self._refuse(Refused(name, "moving"))
        if len(self.views) == MOST_VIEWS or any(
            _apart(view.seen, seen, image.shape[1]) < _ALIKE for view in self.views
        ):
            return self._refuse(Refused(name, "like another"))
        self.views.append(View(name, seen, edge_px))
        self.coverage.add(seen.pixels)
        return None

    def found_instead(self) -> str:
        """Description of the last image without a board, for people."""
        return self._finder.found_instead()

    def counts(self) -> dict[Refusal, int]:
        """Number of refused images, by reason."""
        return dict(Counter(refused.why for refused in self.refused))

    def _check_size(self, name: str, size: tuple[int, int]) -> None:
        if self.coverage is None:
            self._first, self.coverage = name, Coverage(size)
        elif size != (before := self.coverage.size):
            raise CalibrationError(
                f"{name}: is {size[0]} x {size[1]} pixels and {self._first} is {before[0]} x {before[1]}; calibrate "
                "with images of one size only"
            )

    def _refuse(self, refused: Refused) -> Refusal:
        self.refused.append(refused)
        return refused.why


def _apart(first: BoardDetection, second: BoardDetection, width: int) -> float:
    """Mean distance of common corners, as a share of the width; infinite if few are common."""
    _, a, b = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    if len(a) < _SAME * max(len(first.ids), len(second.ids)):
        return float("inf")
    return float(np.linalg.norm(first.pixels[a] - second.pixels[b], axis=1).mean()) / width


_SMALLEST_SQUARE_PX = 10.0
"""Smallest square across which an edge can be measured."""
_ACROSS, _STEP_PX = 0.35, 0.25
"""How far a profile goes to both sides, in squares, and how fine it is."""
_ALONG = np.linspace(-0.2, 0.2, 7)
"""Where along an edge its profile is taken, in squares from its middle; the average has less noise."""


def edge_width_px(grey: UInt8Array, seen: BoardDetection, columns: int) -> float:
    """Width in pixels of an edge between black and white, in the direction in which the view is blurred more.

    It is between 1 and 2 for a perfectly sharp image, and about 2.5 s for a blur of standard deviation s pixels. NaN:
    the board, with this many columns of squares, is too small in the image.
    """
    corners = columns - 1
    places = dict(zip(seen.ids.tolist(), seen.pixels, strict=True))
    widths = []
    for to_next, last in ((1, corners - 1), (corners, corners)):
        found = []
        for number, first in places.items():
            second = places.get(number + to_next) if number % corners < last else None
            if second is None or (square := float(np.linalg.norm(second - first))) < _SMALLEST_SQUARE_PX:
                continue
            along, offsets = second - first, np.arange(-_ACROSS * square, _ACROSS * square, _STEP_PX)
            middles = (first + second) / 2 + _ALONG[:, None] * along - CENTRE_PX
            at = middles[:, None] + offsets[:, None] / square * [-along[1], along[0]]
            columns_at, rows_at = np.moveaxis(at.astype(np.float32), 2, 0)
            profile = cv2.remap(grey, columns_at, rows_at, cv2.INTER_LINEAR)
            mean = np.asarray(profile, np.float64).mean(axis=0)
            if (slope := np.abs(np.diff(mean)).max() / _STEP_PX) > 0.0:
                found.append(np.ptp(mean) / slope)
        widths += [float(np.median(found))] if found else []
    return max(widths, default=float("nan"))
