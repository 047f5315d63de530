"""Patches of real pictures (tools/training/mine_pictures.py): what is no drone, backgrounds, and real drones."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
CROP_PX = 96
PATCH_PX = 160
PATCH_REACH = 1.75
"""Half of a patch is so many times half of the pipeline's first crop."""
_CROP_SHARE = (0.45, 1.65)
"""Half of a crop around a proposal, of half the pipeline's first one: the network's own size leads there."""
_SHIFT = 0.25
"""How far a crop is aimed beside its proposal, in half the crop's width."""
_DRONE_FILL = (0.45, 0.95)
"""Share of the crop's width that a real drone's box fills."""


class RealPatches:
    """The patches of several sources, each source drawn as its weight says."""

    def __init__(self, folder: Path, kind: str, *, weights: dict[str, float] | None = None) -> None:
        """``kind``: negative, place or drone. Sources that ``weights`` leaves out count by the root of their size."""
        self._patches: list[Image] = []
        self._half_px: list[NDArray[np.float32]] = []
        self._boxes: list[NDArray[np.float32]] = []
        shares = []
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as arrays:
                if not len(arrays[kind]):
                    continue
                self._patches.append(arrays[kind])
                self._half_px.append(arrays[f"{kind}_half_px"])
                self._boxes.append(arrays[f"{kind}_box"])
                shares.append((weights or {}).get(path.stem, math.sqrt(len(arrays[kind]))))
        if not self._patches:
            raise FileNotFoundError(
                f"{folder}: no patches of kind {kind} here; make them with tools/training/mine_pictures.py"
            )
        self._shares = np.array(shares) / sum(shares)

    @property
    def count(self) -> int:
        """Number of patches of all sources."""
        return sum(map(len, self._patches))

    def draw(self, rng: np.random.Generator) -> tuple[Image, float, NDArray[np.float32]]:
        """A patch, half of the pipeline's first crop in camera pixels, and the proposal's box in the patch."""
        return self.at(self.draw_place(rng))

    def draw_place(self, rng: np.random.Generator) -> tuple[int, int]:
        """Source and row of a patch."""
        source = int(rng.choice(len(self._shares), p=self._shares))
        return source, int(rng.integers(len(self._patches[source])))

    def at(self, place: tuple[int, int]) -> tuple[Image, float, NDArray[np.float32]]:
        """The patch of that source and row, as `draw` gives it."""
        source, row = place
        return self._patches[source][row], float(self._half_px[source][row]), self._boxes[source][row]


def crop_of_negative(patch: Image, half_px: float, rng: np.random.Generator) -> tuple[Image, float]:
    """A crop (96, 96, 3) as the pipeline may aim it in one of its iterations, and camera pixels per crop pixel."""
    share = float(np.exp(rng.uniform(math.log(_CROP_SHARE[0]), math.log(_CROP_SHARE[1]))))
    half = share * PATCH_PX / 2 / PATCH_REACH
    middle = PATCH_PX / 2 + rng.uniform(-_SHIFT, _SHIFT, 2) * half
    return _cut(patch, middle, half), share * half_px / (CROP_PX / 2)


def crop_of_drone(
    patch: Image, half_px: float, box: NDArray[np.float32], rng: np.random.Generator
) -> tuple[Image, NDArray[np.float32], float]:
    """A crop (96, 96, 3) around a drone, its box there (left, top, right, bottom), and camera pixels per crop pixel."""
    long = float(max(box[2] - box[0], box[3] - box[1]))
    half = long / 2 / float(rng.uniform(*_DRONE_FILL))
    middle = np.array([box[0] + box[2], box[1] + box[3]]) / 2 + rng.uniform(-0.15, 0.15, 2) * half
    inside = (box.reshape(2, 2) - middle + half) * (CROP_PX / 2 / half)
    return (
        _cut(patch, middle, half),
        inside.reshape(4).astype(np.float32),
        half / (PATCH_PX / 2) * PATCH_REACH * (half_px / (CROP_PX / 2)),
    )


def _cut(patch: Image, middle: NDArray[np.float64], half: float) -> Image:
    """A square of ``half`` its width around ``middle`` (u, v), resampled to the crop's size."""
    step = half / (CROP_PX / 2)
    corner = middle - half + step / 2 - 0.5
    place = np.array([[step, 0.0, corner[0]], [0.0, step, corner[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(patch, place, (CROP_PX, CROP_PX), flags=flags, borderMode=cv2.BORDER_REFLECT_101), np.uint8
    )
