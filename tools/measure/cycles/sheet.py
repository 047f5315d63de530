"""One picture of many: drones that were found and missed, and what was taken for one, each cut out and named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.geometry import Rig
from tools.measure.contact_sheet import cut_out, grid, named, write_sheet
from tools.measure.cycles.card import Findings
from tools.measure.cycles.jobs import PROPELLER
from tools.measure.cycles.plan import Moment
from tools.measure.cycles.taken import Taken

Array = NDArray[Any]
_MOST = 30
_SCENES = 6


def contact_sheet(
    found: Findings, moments: Sequence[Moment], read: Callable[[Moment], Taken], rig: Rig, path: Path
) -> None:
    """Whole pictures on top, then crops: found (white), missed and false (red)."""
    planned = {one.number: one for one in moments}

    @lru_cache(maxsize=1)  # the crops of a moment follow each other
    def taken(number: int) -> Taken:
        return read(planned[number])

    first = [taken(one.number) for one in moments[:_SCENES]]
    parts = [np.hstack([_fitted(one.rgb[0, c % one.rgb.shape[1]], 266) for c, one in enumerate(first)])]
    for wanted in (True, False):
        crops = []
        for one in [one for one in found.sights if one.found is wanted][:_MOST]:
            said = f"{one.error:+.0%}" if wanted else "missed"
            crop = _around_drone(taken(one.number), one.k, one.drone)
            crops.append(named(crop, f"{one.range_m:.1f}m {one.width_px:.0f}px {said}", good=wanted))
        parts.append(grid(crops))
    false = [(number, _around_direction(taken(number), k, bearing, rig)) for number, k, bearing in found.false[:_MOST]]
    parts.append(grid([named(cut, f"false, moment {number}", good=False) for number, cut in false if cut is not None]))
    write_sheet(parts, path)


def _around_drone(taken: Taken, k: int, n: int) -> Array:
    of_drone = taken.ids[k] % PROPELLER == n + 1
    c = int(np.count_nonzero(of_drone, axis=(1, 2)).argmax())
    rows, columns = np.nonzero(of_drone[c])
    half = max(12, int(0.8 * max(np.ptp(rows), np.ptp(columns))))
    return cut_out(taken.rgb[k, c], (columns.min() + columns.max()) // 2, (rows.min() + rows.max()) // 2, half)


def _around_direction(taken: Taken, k: int, bearing: Array, rig: Rig) -> Array | None:
    for c, camera in enumerate(rig.cameras.values()):
        u, v = camera.pixels_of_directions(bearing[None])[0]
        if np.isfinite(u):
            return cut_out(taken.rgb[k, c], int(u), int(v), 30)
    return None


def _fitted(image: Array, high: int) -> Array:
    return cv2.resize(image, (round(image.shape[1] * high / image.shape[0]), high), interpolation=cv2.INTER_AREA)
