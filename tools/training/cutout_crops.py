"""Crops of cut-outs (tools.training.render_cutouts), as the second stage aims them, for real backgrounds."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.training.real_patches import CROP_PX
from tools.training.samples import Sample, drawn_fill

_ROLL_DEG = 10.0
_KINDS = {"real": 0.45, "shell": 0.3, "generated": 0.25}
"""Share of each kind of drone, however many cut-outs there are of it; every drone of a kind as often as any other."""


class CutoutCrops:
    """Every cut-out of some folders, in memory."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._of_drone: dict[str, dict[str, list[tuple[Path, dict[str, Any]]]]] = {}
        self._read: dict[Path, NDArray[np.uint8]] = {}
        for folder in folders:
            for line in (folder / "index.jsonl").read_text(encoding="utf-8").splitlines():
                entry = json.loads(line)
                if entry["held_out"]:
                    raise ValueError(f"{folder}: has cut-outs of {entry['name']}, from which nothing may be learnt")
                if entry["kept"]:
                    drones = self._of_drone.setdefault(entry["kind"], {})
                    drones.setdefault(entry["name"], []).append((folder / entry["file"], entry))
        if not self._of_drone:
            raise FileNotFoundError(
                f"{', '.join(map(str, folders))}: no cut-outs here; make them with tools.training.render_cutouts"
            )
        self._kinds = list(self._of_drone)
        shares = np.array([_KINDS[kind] for kind in self._kinds])
        self._shares = shares / shares.sum()

    def draw(self, rng: np.random.Generator) -> Sample:
        """A drone for ``real_samples.composite``; where ``mask`` is 0, its ``picture`` shows nothing that counts."""
        drones = list(self._of_drone[self._kinds[int(rng.choice(len(self._kinds), p=self._shares))]].values())
        ones = drones[int(rng.integers(len(drones)))]
        path, entry = ones[int(rng.integers(len(ones)))]
        fill, off = drawn_fill(rng)
        place = (1 + off) * CROP_PX / 2
        scale = CROP_PX / (entry["size_m"] * fill) * entry["range_m"] / entry["focal_px"]
        seen = _placed(self._image(path), np.array(entry["middle_px"]), place, scale, rng)
        opaque = seen[..., 3:]
        return {
            "picture": np.clip(np.rint(seen[..., :3] / np.maximum(opaque, 1e-3)), 0, 255).astype(np.uint8),
            "mask": np.clip(np.rint(255 * opaque[..., 0]), 0, 255).astype(np.uint8),
            "apparent": np.array(math.log(CROP_PX / fill), np.float32),
            "drone": np.array(1.0, np.float32),
        }

    def _image(self, path: Path) -> NDArray[np.float32]:
        """(h, w, 4) RGB times alpha, and alpha, 0-1."""
        if path not in self._read:
            read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if read is None:
                raise FileNotFoundError(f"{path}: is no picture that can be read")
            self._read[path] = np.asarray(read, np.uint8)
        image = self._read[path].astype(np.float32)
        alpha = image[..., 3:] / 255
        return np.concatenate([image[..., 2::-1] * alpha, alpha], 2)


def _placed(
    image: NDArray[np.float32],
    middle: NDArray[np.float64],
    place: NDArray[np.float64],
    scale: float,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """(96, 96, 4) the image, ``scale`` times as large, rolled about its ``middle``, which comes to lie at ``place``."""
    while scale < 0.5:  # so that nothing is skipped when it is shrunk
        height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
        image = cv2.resize(image[:height, :width], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        middle, scale = middle / 2, scale * 2
    turn = cv2.getRotationMatrix2D((0.0, 0.0), rng.normal(0, _ROLL_DEG), scale)
    # OpenCV counts from the middle of the first pixel, we from its corner.
    turn[:, 2] = place - 0.5 - turn[:, :2] @ (middle - 0.5)
    return np.asarray(cv2.warpAffine(image, turn, (CROP_PX, CROP_PX), flags=cv2.INTER_LINEAR), np.float32)
