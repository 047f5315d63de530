"""Which drones of labelled pictures are found, by how they look, and a sheet of those that are and are not."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.ground.pictures import Labelled
from flockd.ground.pictures.scoring import centre_in_box, match
from flockd.ground.pictures.single_frame import Box
from tools.measure.contact_sheet import ACROSS, cut_out, grid, named, write_sheet

Array = NDArray[Any]
BRIGHT, CLUTTERED = 128.0, 12.0
"""Grey levels: of the middle of a drone's box, and the standard deviation around the box of what is left when a blur of
an eighth of its width is taken away, so that a smooth sky from light to dark is plain."""
_ROWS = 3


@dataclass
class Looks:
    """What became of each labelled drone and of each false detection of one set."""

    counts: dict[str, list[int]] = field(default_factory=dict)
    """By look: drones found, drones."""
    found: list[Array] = field(default_factory=list)
    missed: list[Array] = field(default_factory=list)
    false: list[Array] = field(default_factory=list)

    def add(self, image: Array, one: Labelled) -> None:
        """One picture (h, w, 3), RGB, with its boxes and detections."""
        hits, _ = match(one, centre_in_box)
        for box, hit in zip(one.boxes, hits, strict=True):
            look = look_of(image, box)
            counted = self.counts.setdefault(look, [0, 0])
            counted[0] += hit
            counted[1] += 1
            text = f"{box[2] - box[0]:.0f}px {look}"
            (self.found if hit else self.missed).append(named(_around(image, box), text, good=hit))
        for drone in one.detections:
            if all(centre_in_box(drone, box) is None for box in one.boxes):
                text = f"p {drone.probability:.2f} {drone.box[2] - drone.box[0]:.0f}px"
                self.false.append(named(_around(image, drone.box), text, good=False))

    def write(self, path: Path) -> None:
        """Some of each, evenly drawn: found, missed, false."""
        write_sheet([grid(_some(crops)) for crops in (self.found, self.missed, self.false)], path)


def look_of(image: Array, box: Box) -> str:
    """``"bright, plain"`` and so on: the drone's brightness, and the clutter around it."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    middle = _part(grey, (left + width / 4, top + height / 4, right - width / 4, bottom - height / 4))
    wide = (left - width / 2, top - height / 2, right + width / 2, bottom + height / 2)
    without = np.ones_like(grey)
    _part(without, box)[:] = 0.0
    near, without = _part(grey, wide), _part(without, wide)
    sigma = max(width / 8, 1.0)
    smooth = cv2.GaussianBlur(near * without, (0, 0), sigma) / cv2.GaussianBlur(without, (0, 0), sigma).clip(1e-6)
    ring = (near - smooth)[without > 0.0]
    is_cluttered = bool(ring.size) and float(np.sqrt(np.mean(ring**2))) > CLUTTERED
    brightness = "bright" if float(middle.mean()) > BRIGHT else "dark"
    return f"{brightness}, {'cluttered' if is_cluttered else 'plain'}"


def _part(image: Array, box: Box) -> Array:
    """The pixels of a box that lie in the image, at least one."""
    height, width = image.shape[:2]
    left, top = (int(np.clip(value, 0, most - 1)) for value, most in ((box[0], width), (box[1], height)))
    return image[top : max(int(box[3]), top + 1), left : max(int(box[2]), left + 1)]


def _around(image: Array, box: Box) -> Array:
    half = 0.75 * max(box[2] - box[0], box[3] - box[1], 16.0)
    return cut_out(image, (box[0] + box[2]) / 2, (box[1] + box[3]) / 2, half)


def _some(crops: list[Array]) -> list[Array]:
    most = _ROWS * ACROSS
    return [crops[k] for k in np.linspace(0, len(crops) - 1, min(most, len(crops))).astype(int)]
