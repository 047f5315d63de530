"""Training of `detector` and `verification`, on real pictures beside rendered ones.

Positives and negatives pass through the same cameras: else a network learns that what is soft is a drone.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from tools.training.camera_effects import as_filmed, drawn_effects, through_camera
from tools.training.dataset import open_pairs
from tools.training.detector import DroneDetector, detection_loss
from tools.training.networks import VerificationNet
from tools.training.pictures import (
    LEAST_SEEN,
    MOST_BOXES,
    NO_BOX,
    CropFiles,
    Cutouts,
    Image,
    Labelled,
    Photographs,
    Proposals,
    Scene,
    Worlds,
    filmed,
    looked_at,
    paste,
    with_drones,
)
from tools.training.samples import Sample, drawn_fill
from tools.training.tasks import Batch, Task

SIDES_PX = {256: 24, 320: 16, 416: 9}
"""Width and height of a batch's pictures, and how many of them take about the same time."""
MIX = {"composite": 0.40, "without": 0.22, "labelled": 0.25, "worlds": 0.13}
"""Shares of the pictures. Half of those without a drone are backgrounds of composites of the same batch."""

CROP_PX = 96
CROPS = {"rendered": 36, "composite": 30, "real drone": 12, "negative": 46}
"""Samples of a batch of `verification`."""
KINDS = tuple(CROPS)
WIDTHS_PX = (6.0, 240.0)
"""Width of a drone in the camera's image; its logarithm is uniform."""
_CROP_SHARE = (0.45, 1.65)
"""Half of a crop around a proposal, in the pipeline's first ones: the network's own size leads there."""
_PLACE_HALF_PX = (5.0, 300.0)
_PLACES_SHARE, _NOISE_SHARE = 0.15, 0.05
"""Shares of the negatives: cut anywhere, and what a failing sensor delivers."""
_DRONE_FILL = (0.45, 0.95)
"""Share of the crop's width that a real drone's box fills."""
_TRIES, _LEAST_SCALE = 6, 0.07
_SENSOR_SIGMA, _TEXTURE_SIGMA = 6.0, 30.0
"""Grey levels: what noise and compression hide at least, and the background's texture at most."""
_SURELY_VISIBLE = 40.0
"""Energy of what a drone changes in the camera's image, over the variance of what hides it. Less counts less, in
proportion: who is taught drones that cannot be seen learns to see them everywhere."""


class DetectorTask(Task):
    """Composites, labelled pictures, rendered worlds, and pictures without drones."""

    def __init__(self, data: Path) -> None:
        super().__init__(DroneDetector(), SIDES_PX[320], 5e-4)
        self.cutouts, self.photographs = Cutouts(data / "cutouts"), Photographs(data / "photographs")
        self.labelled = _labelled(data)
        self.worlds = Worlds(open_pairs(data / "worlds"))

    def batch_samples(self, rng: Generator) -> list[Sample]:
        """See ``Task``: pictures of one size."""
        side = int(rng.choice(list(SIDES_PX)))
        background: Scene | None = None
        samples: list[Sample] = []
        while len(samples) < self.batch * SIDES_PX[side] // SIDES_PX[320]:
            kind = str(rng.choice(list(MIX), p=list(MIX.values())))
            if kind == "labelled":
                scene = self.labelled[int(rng.integers(len(self.labelled)))].draw(side, rng)
                if rng.random() < 0.3:
                    scene = with_drones(scene, self.cutouts, rng)
            elif kind == "worlds":
                scene = self.worlds.draw(side, rng)
            elif kind == "without" and background is not None and rng.random() < 0.5:
                scene, background = background, None
            else:
                background = scene = self.photographs.draw(side, rng)
                if kind == "composite":
                    scene = with_drones(scene, self.cutouts, rng)
            samples.append(_sample(filmed(scene, rng, is_photograph=kind in ("composite", "without"))))
        return samples

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        images = batch["image"].permute(0, 3, 1, 2).float().contiguous(memory_format=torch.channels_last)
        return detection_loss(self.net(images), batch["boxes"], batch["classes"])


def _labelled(data: Path) -> list[Labelled]:
    folders = sorted((data / "labelled").glob("*/labels.json"))
    if not folders:
        raise FileNotFoundError(f"{data / 'labelled'}: has no folders with labels.json, pictures of real drones")
    return [Labelled(file.parent) for file in folders]


def _sample(scene: Scene) -> Sample:
    boxes, classes = np.zeros((MOST_BOXES, 4), np.float32), np.full(MOST_BOXES, NO_BOX)
    n = min(len(scene.boxes), MOST_BOXES)
    if n:
        low, high = scene.boxes[:n, :2], scene.boxes[:n, 2:]
        boxes[:n] = np.hstack([(low + high) / 2, high - low])
        classes[:n] = scene.classes[:n]
    return {"image": scene.image, "boxes": boxes, "classes": classes}


class VerificationTask(Task):
    """Crops with and without drones: rendered, rendered before photographs, and real."""

    def __init__(self, data: Path) -> None:
        super().__init__(VerificationNet(), sum(CROPS.values()), 6e-4)
        self.rendered, self.cutouts = CropFiles(data / "crops"), Cutouts(data / "cutouts")
        self.photographs = Photographs(data / "photographs")
        self.drones = [one for one in _labelled(data) if one.drones]
        self.proposals = Proposals([data / "photographs", *sorted((data / "labelled").glob("*/"))])

    def batch_samples(self, rng: Generator) -> list[Sample]:
        """As many of each kind as ``CROPS`` says."""
        of_kind = {
            "rendered": self._rendered, "composite": self._composite, "real drone": self._real_drone,
            "negative": self._negative,
        }  # fmt: skip
        times = self.batch // sum(CROPS.values())
        return [
            of_kind[kind](rng) | {"kind": np.array(number)}
            for number, kind in enumerate(KINDS)
            for _ in range(times * CROPS[kind])
        ]

    def _rendered(self, rng: Generator) -> Sample:
        """As it is, or as a real camera shows it."""
        drawn = self.rendered.draw(rng)
        if rng.random() < 0.5:
            (picture,) = as_filmed([drawn["picture"]], rng)
            return _crop(picture, float(drawn["drone"]))
        is_drone, weight = drawn["drone"] > 0.5, 1.0
        scale = min(1.0, _drawn_width(rng) / (float(np.exp(drawn["apparent"])) if is_drone else 70.0))
        if is_drone and (drawn["mask"] == 0).any():
            around = drawn["picture"][drawn["mask"] == 0].mean(0)
            weight = visibility(
                drawn["picture"], np.where(drawn["mask"][:, :, None] > 0, around, drawn["picture"]), scale
            )
        picture = through_camera(drawn["picture"], drawn_effects(scale, rng), rng)
        return _crop(picture, float(drawn["drone"]), weight)

    def _composite(self, rng: Generator) -> Sample:
        """A cut-out before a part of a photograph, through a real camera."""
        image, scale, seen = np.zeros((CROP_PX, CROP_PX, 3), np.uint8), 1.0, 0.0
        for _ in range(_TRIES):
            behind, camera_px = self._anywhere(rng) if rng.random() < 0.6 else self._proposal(rng)
            fill, off = drawn_fill(rng)
            width = CROP_PX / fill
            # A background that is softer than the drone before it would give the drone away.
            width_px = min(_drawn_width(rng), camera_px * width)
            if width_px < WIDTHS_PX[0]:
                continue
            painted = behind.astype(np.float32)
            drone = looked_at(self.cutouts.draw(rng), width, rng)
            _, share = paste(painted, drone, (1 + off) * CROP_PX / 2, rng)
            image, scale = np.clip(np.rint(painted), 0, 255).astype(np.uint8), min(1.0, width_px / width)
            seen = visibility(image, behind, scale) * (share > LEAST_SEEN)
            if seen >= 1.0:
                break
        return _crop(through_camera(image, drawn_effects(scale, rng), rng), 1.0, seen)

    def _real_drone(self, rng: Generator) -> Sample:
        image, box = self.drones[int(rng.integers(len(self.drones)))].draw_drone(rng)
        half = max(box[2] - box[0], box[3] - box[1]) / 2 / float(rng.uniform(*_DRONE_FILL))
        middle = np.array([box[0] + box[2], box[1] + box[3]]) / 2 + rng.uniform(-0.15, 0.15, 2) * half
        return _crop(_perhaps_softer(crop_of(image, middle, half), 2 * half / CROP_PX, (0.6, 1.0), rng), 1.0)

    def _negative(self, rng: Generator) -> Sample:
        if rng.random() < _NOISE_SHARE:
            picture = self._anywhere(rng)[0] + rng.normal(0, rng.uniform(40.0, 120.0), (CROP_PX, CROP_PX, 3))
            return _crop(np.clip(picture, 0, 255).astype(np.uint8), 0.0)
        if rng.random() < _PLACES_SHARE:
            return _crop(_perhaps_softer(*self._anywhere(rng), (0.4, 1.0), rng), 0.0)
        return _crop(_perhaps_softer(*self._proposal(rng), (0.4, 1.0), rng), 0.0)

    def _proposal(self, rng: Generator) -> tuple[Image, float]:
        """A crop as the pipeline may aim it in one of its iterations, and camera pixels per crop pixel."""
        image, box = self.proposals.draw(rng)
        share = float(np.exp(rng.uniform(*np.log(_CROP_SHARE))))
        half = max(share * 0.5 * math.hypot(box[2] - box[0], box[3] - box[1]), 4.0)
        middle = np.array([box[0] + box[2], box[1] + box[3]]) / 2 + rng.uniform(-0.25, 0.25, 2) * half
        return crop_of(image, middle, half), 2 * half / CROP_PX

    def _anywhere(self, rng: Generator) -> tuple[Image, float]:
        image, _ = self.photographs.draw_whole(rng)
        half = float(np.exp(rng.uniform(*np.log(_PLACE_HALF_PX))))
        return crop_of(image, rng.uniform(0, 1, 2) * image.shape[1::-1], half), 2 * half / CROP_PX

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``. A drone that can hardly be seen has little weight."""
        crops = batch["picture"]
        mirror = torch.rand(len(crops), device=crops.device) < 0.5
        crops = torch.where(mirror[:, None, None, None], crops.flip(2), crops)
        logits, there, kind = self.net(crops)[:, 0], batch["drone"], batch["kind"]
        loss = F.binary_cross_entropy_with_logits(logits, there, weight=batch["exists_weight"])
        probability = torch.sigmoid(logits.detach())
        figures = {"rendered none": float((probability[(kind == 0) & (there < 0.5)] > 0.8).float().mean())}
        for number, name in enumerate(KINDS):
            mine = (kind == number) & (there > 0.5) if name != "negative" else kind == number
            figures[name] = float((probability[mine] > 0.8).float().mean())
        return loss, figures


def _crop(picture: Image, drone: float, weight: float = 1.0) -> Sample:
    return {
        "picture": picture, "drone": np.array(drone, np.float32), "exists_weight": np.array(weight, np.float32),
    }  # fmt: skip


def crop_of(image: Image, middle: NDArray[np.float64], half: float) -> Image:
    """(96, 96, 3): what is within ``half`` pixels, right and down, of a place (u, v) of a picture."""
    side = max(round(2 * half), 2)
    moved = np.array([[1.0, 0.0, side / 2 - middle[0]], [0.0, 1.0, side / 2 - middle[1]]])
    part = cv2.warpAffine(image, moved, (side, side), borderMode=cv2.BORDER_REFLECT_101)
    method = cv2.INTER_AREA if side > CROP_PX else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(part, (CROP_PX, CROP_PX), interpolation=method), np.uint8)


def visibility(picture: NDArray[Any], hidden: NDArray[Any], scale: float) -> float:
    """0-1: how sure one can be at a ``scale`` of the picture (h, w, 3) that it shows more than ``hidden`` does."""
    size = (max(2, round(scale * picture.shape[1])), max(2, round(scale * picture.shape[0])))
    change = cv2.resize(picture.astype(np.float32) - hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    texture = min(float(hidden.reshape(-1, 3).std(0).mean()), _TEXTURE_SIGMA)
    energy = float((change.max(2) ** 2 + change.min(2) ** 2).sum()) / 2 / (_SENSOR_SIGMA**2 + texture**2)
    # However large it is, a drone of which no pixel stands out of the noise cannot be seen.
    return min(1.0, energy / _SURELY_VISIBLE, (float(np.abs(change).max()) / (2 * _SENSOR_SIGMA)) ** 2)


def _perhaps_softer(picture: Image, camera_px: float, scales: tuple[float, float], rng: Generator) -> Image:
    """Half of the pictures pass through another camera."""
    if rng.random() < 0.5:
        return picture
    scale = max(min(1.0, camera_px) * float(rng.uniform(*scales)), _LEAST_SCALE)
    return through_camera(picture, drawn_effects(scale, rng), rng)


def _drawn_width(rng: Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(WIDTHS_PX))))
