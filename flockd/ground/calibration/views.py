"""Chooses from many images of a board those that calibrate a camera, and says why it refuses the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import cv2
import numpy as np

from flockd.core.messages import FloatArray, UInt8Array
from flockd.ground.calibration.board import BoardDetection, BoardFinder
from flockd.ground.calibration.coverage import Coverage
from flockd.ground.calibration.errors import CalibrationError
from flockd.ground.calibration.sharpness import edge_width_px

Refusal = Literal["no board", "blurred", "moving", "like another"]
_SHARP_PX, _SHARP_SHARE = 4.0, 0.003
"""Widest edge of a sharp view: so many pixels, or this share of a large image's width."""
_ALIKE = 0.03
"""Two views whose corners are this much of the image's width apart, on average, say the same."""
_STILL = 0.003
"""The same, of a board that is held still from one frame to the next."""
_SAME = 0.6
"""Views that have a smaller share of their corners in common show different parts of the board."""


@dataclass(frozen=True, eq=False)
class View:
    """One image of the board."""

    name: str
    """Name of the file, or the frame's number or time."""
    seen: BoardDetection
    edge_px: float
    """See `sharpness.edge_width_px`."""


@dataclass(frozen=True)
class Refused:
    """An image that is not used."""

    name: str
    why: Refusal
    edge_px: float | None = None
    """Width of a blurred edge."""


class Collector:
    """Takes images of one camera one after the other. All are of one size: another is a CalibrationError."""

    def __init__(self, finder: BoardFinder, most: int, max_edge_px: float | None = None) -> None:
        """Keeps at most ``most`` views: beyond that, of two that are alike one goes."""
        self._finder, self._most, self._max_edge_px = finder, most, max_edge_px
        self._first = ""
        self._before: BoardDetection | None = None
        self.size: tuple[int, int] | None = None
        """Width, height; None before the first image."""
        self.views: list[View] = []
        self.refused: list[Refused] = []
        self.coverage: Coverage | None = None

    def offer(self, name: str, image: UInt8Array, *, moving: bool = False) -> Refusal | None:
        """Takes a (h, w, 3) RGB image; gives what it is refused for, None for one that is now a view.

        ``moving``: images follow each other so fast that a board in motion shows between them.
        """
        self._check_size(name, (image.shape[1], image.shape[0]))
        assert self.coverage is not None
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        self.coverage.add_light(grey)
        seen = self._finder.find(grey)
        before, self._before = self._before, seen
        if seen is None:
            return self._refuse(Refused(name, "no board"))
        edge_px = edge_width_px(grey, seen, self._finder.spec)
        if edge_px > self.max_edge_px:
            return self._refuse(Refused(name, "blurred", edge_px))
        if moving and (before is None or not is_still(before, seen, image.shape[1])):
            return self._refuse(Refused(name, "moving"))
        if any(_apart(view.seen, seen, image.shape[1]) < _ALIKE for view in self.views):
            return self._refuse(Refused(name, "like another"))
        self.views.append(View(name, seen, edge_px))
        self.coverage.add(seen.pixels)
        if len(self.views) > self._most:
            self._drop_the_most_alike()
        return None

    @property
    def max_edge_px(self) -> float:
        """Above it a view is blurred."""
        return self._max_edge_px or sharp_px(self.size[0] if self.size else 0)

    def counts(self) -> dict[Refusal, int]:
        """How many were refused, by reason."""
        return dict(Counter(refused.why for refused in self.refused))

    def _check_size(self, name: str, size: tuple[int, int]) -> None:
        if self.size is None:
            self.size, self._first, self.coverage = size, name, Coverage(size)
        elif size != self.size:
            raise CalibrationError(
                f"{name}: is {size[0]} x {size[1]} pixels and {self._first} is {self.size[0]} x {self.size[1]}; "
                "calibrate with images of one size only"
            )

    def _refuse(self, refused: Refused) -> Refusal:
        self.refused.append(refused)
        return refused.why

    def _drop_the_most_alike(self) -> None:
        assert self.size is not None
        apart = np.full((len(self.views), len(self.views)), np.inf)
        for i, j in combinations(range(len(self.views)), 2):
            apart[i, j] = _apart(self.views[i].seen, self.views[j].seen, self.size[0])
        gone = self.views.pop(int(np.unravel_index(np.argmin(apart), apart.shape)[1]))
        self._refuse(Refused(gone.name, "like another"))


def sharp_px(width: int) -> float:
    """The widest edge of a sharp view in an image of this width."""
    return max(_SHARP_PX, _SHARP_SHARE * width)


def is_still(before: BoardDetection, now: BoardDetection, width: int) -> bool:
    """Whether a board was held still from one frame to the next, in images of this width."""
    return _apart(before, now, width) < _STILL


def all_pixels(views: Sequence[View]) -> FloatArray:
    """(n, 2) the corners of all views."""
    return np.concatenate([view.seen.pixels for view in views])


def _apart(first: BoardDetection, second: BoardDetection, width: int) -> float:
    """Mean distance of the corners that both show, as a share of the width; infinite where they show others."""
    _, a, b = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    if len(a) < _SAME * max(len(first.ids), len(second.ids)):
        return float("inf")
    return float(np.linalg.norm(first.pixels[a] - second.pixels[b], axis=1).mean()) / width
