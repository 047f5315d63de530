"""Train the detector of drones, from YOLOX-nano's weights of COCO.

    python -m tools.training.train_detector --coco yolox_nano.onnx --cutouts CUTOUTS --photographs FOLDER \
        --labelled DRONES --labelled FLYERS --worlds PAIRS --out RUN

CUTOUTS is the folder of tools.training.render_cutouts, FOLDER holds photographs and `index.jsonl`, DRONES and FLYERS
real pictures with `labels.json`, PAIRS is of tools.training.render_training_data. Resumes like tools.training.train,
and writes the same files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from tools.training.dataset import open_pairs
from tools.training.detector.loss import detection_loss
from tools.training.detector.network import NO_BOX, DroneDetector, begin_with_coco
from tools.training.detector.pictures import (
    MOST_BOXES,
    Cutouts,
    Labelled,
    Photographs,
    Scene,
    Worlds,
    filmed,
    with_drones,
)
from tools.training.samples import Sample
from tools.training.tasks import Batch, Task
from tools.training.train import add_machine, begin_with, train

SIDES_PX = {256: 24, 320: 16, 416: 9}
"""Width and height of a batch's pictures, and how many of them take about the same time."""
MIX = {"composite": 0.40, "without": 0.22, "labelled": 0.25, "worlds": 0.13}
"""Shares of the pictures. Half of those without a drone are the very backgrounds of composites of the same batch."""
KINDS = tuple(MIX)


class DetectorTask(Task):
    """Drones before everything, what flies besides them, and pictures without any."""

    def __init__(self, cutouts: Path, photographs: Path, labelled: list[Path], worlds: Path, times: int = 1) -> None:
        """``times`` as many pictures a batch as ``SIDES_PX`` says."""
        super().__init__(DroneDetector(), 16 * times, 5e-4)
        self.times = times
        self.cutouts, self.photographs = Cutouts(cutouts), Photographs(photographs)
        self.labelled, self.worlds = [Labelled(folder) for folder in labelled], Worlds(open_pairs(worlds))
        self.drawn = 0

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """See ``Task``: pictures of one size."""
        self.drawn += 1
        if self.drawn % 50 == 0:
            self.cutouts.look_for_more()
        side = int(rng.choice(list(SIDES_PX)))
        background: Scene | None = None
        samples: list[Sample] = []
        while len(samples) < self.times * SIDES_PX[side]:
            kind = str(rng.choice(KINDS, p=list(MIX.values())))
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


def _sample(scene: Scene) -> Sample:
    boxes, classes = np.zeros((MOST_BOXES, 4), np.float32), np.full(MOST_BOXES, NO_BOX)
    n = min(len(scene.boxes), MOST_BOXES)
    if n:
        low, high = scene.boxes[:n, :2], scene.boxes[:n, 2:]
        boxes[:n] = np.hstack([(low + high) / 2, high - low])
        classes[:n] = scene.classes[:n]
    return {"image": scene.image, "boxes": boxes, "classes": classes}


def main() -> None:
    """Train until the minutes are over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--coco", type=Path, required=True, help="YOLOX-nano as ONNX, of COCO's 80 classes, or a detector of models/"
    )
    parser.add_argument("--cutouts", type=Path, required=True)
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--labelled", type=Path, action="append", required=True)
    parser.add_argument("--worlds", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--start", type=Path, help="another run's checkpoint.pt")
    parser.add_argument("--minutes", type=float, default=240.0)
    parser.add_argument("--rate", type=float, help="learning rate to begin with")
    parser.add_argument("--times", type=int, default=1, help="as many pictures a batch: a GPU has room for them")
    add_machine(parser)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    task = DetectorTask(arguments.cutouts, arguments.photographs, arguments.labelled, arguments.worlds, arguments.times)
    task.rate = arguments.rate or task.rate
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.start:
        begin_with(task.net, torch.load(arguments.start, map_location="cpu")["net"])
    elif not (arguments.out / "checkpoint.pt").is_file():
        images = np.stack([sample["image"] for sample in _of_one_size(task, np.random.default_rng(arguments.seed))])
        try:
            begin_with_coco(task.net, arguments.coco, torch.from_numpy(images).permute(0, 3, 1, 2).float())
        except ValueError as error:
            raise SystemExit(f"--coco: {error}") from None
    train(task, arguments.out, 60.0 * arguments.minutes, arguments.seed, arguments.workers)


def _of_one_size(task: DetectorTask, rng: np.random.Generator) -> list[Sample]:
    """Enough pictures for the statistics of batch norms."""
    samples = task.batch_samples(rng)
    while len(samples) < 48:
        more = task.batch_samples(rng)
        if more[0]["image"].shape == samples[0]["image"].shape:
            samples += more
    return samples


if __name__ == "__main__":
    main()
