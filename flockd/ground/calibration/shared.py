"""Chooses from images that several cameras took together those in which a board is seen by two or more."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from flockd.core.messages import UInt8Array
from flockd.ground.calibration.board import BoardDetection, BoardFinder
from flockd.ground.calibration.extrinsics import SharedBoard
from flockd.ground.calibration.sharpness import edge_width_px
from flockd.ground.calibration.views import is_still, sharp_px


class SharedCollector:
    """Takes sets of images one after the other."""

    def __init__(self, finder: BoardFinder) -> None:
        self._finder = finder
        self._before: Mapping[str, tuple[BoardDetection, int]] = {}
        self.boards: list[SharedBoard] = []

    def offer(self, name: str, greys: Mapping[str, UInt8Array], *, moving: bool) -> None:
        """Takes the (h, w) images of one time. ``moving``: sets follow each other so fast that motion shows."""
        found = {camera: (self._finder.find(grey), grey) for camera, grey in greys.items()}
        seen = {
            camera: (board, grey.shape[1])
            for camera, (board, grey) in found.items()
            if board is not None and not edge_width_px(grey, board, self._finder.spec) > sharp_px(grey.shape[1])
        }
        before, self._before = self._before, seen
        if moving:
            seen = {
                camera: (board, width)
                for camera, (board, width) in seen.items()
                if camera in before and is_still(before[camera][0], board, width)
            }
        if len(seen) > 1:
            self.boards.append(SharedBoard(name, {camera: board for camera, (board, _) in seen.items()}))

    def links(self) -> Mapping[tuple[str, ...], int]:
        """How many boards these cameras saw together, and no other with them."""
        return Counter(tuple(sorted(board.seen)) for board in self.boards)
