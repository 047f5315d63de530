"""Go on training the second stage so that it works on real pictures.

    python -m tools.train_real --rendered PICTURES --patches PATCHES --start models/distance.onnx --out RUN --minutes 60

PICTURES is the folder of tools/render_drone_crops.py, PATCHES that of tools/mine_pictures.py. Resumes like
tools/train.py, and writes the same files.
"""

from __future__ import annotations

import argparse
from collections import deque
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from tools.train import Batch, Task, _flipped, _motor_maps, _start, train
from tools.training import real_samples
from tools.training.augment import photometric
from tools.training.crop_files import CropFiles
from tools.training.networks import DistanceNet
from tools.training.real_patches import RealPatches
from tools.training.samples import Sample

MIX = {"rendered": 30, "composite": 18, "real drone": 8, "cut out": 4, "negative": 36}
"""Samples of a batch."""
KINDS = tuple(MIX)
SOFTENED_SHARE = 0.65
"""Of the rendered ones."""
PLACES_SHARE = 0.15
"""Of the negatives: cut anywhere, not where the first stage proposed a drone."""
HARD_PROBABILITY, HARD_SHARE, HARD_ONES, FEWEST_HARD = 0.3, 0.35, 4000, 200
"""A negative of more than this probability is remembered, the last so many are, and drawn so often."""


class RealTask(Task):
    """Like `tools.train.DistanceTask`, with real negatives, composites and real drones whose range is not known."""

    def __init__(self, rendered: Path, patches: Path) -> None:
        super().__init__(DistanceNet(), sum(MIX.values()), 5e-4)
        self.rendered = CropFiles(rendered)
        self.negatives = RealPatches(patches, "negative")
        self.places = RealPatches(patches, "place", weights={"skydrones": 8.0, "skyothers": 8.0})
        self.drones = RealPatches(patches, "drone")
        self.hard: deque[tuple[int, int]] = deque(maxlen=HARD_ONES)
        self._shown: list[tuple[int, int] | None] = []

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """As many of each kind as `MIX` says."""
        self.rendered.look_for_more()
        self._shown = []
        kinds = [(number, kind) for number, kind in enumerate(KINDS) for _ in range(MIX[kind])]
        return [self._of_kind(kind, rng) | {"kind": np.array(number)} for number, kind in kinds]

    def _of_kind(self, kind: str, rng: np.random.Generator) -> Sample:
        if kind == "negative":
            return self._negative(rng)
        if kind == "real drone":
            return real_samples.real_drone(self.drones, rng)
        backgrounds = self.places if rng.random() < 0.6 else self.negatives
        if kind == "cut out":
            return real_samples.real_drone(self.drones, rng, backgrounds=backgrounds)
        drawn = self.rendered.draw(rng)
        if kind == "composite":
            while drawn["drone"] < 0.5 or drawn["mask"].mean() < 8:
                drawn = self.rendered.draw(rng)
            return real_samples.composite(drawn, backgrounds, rng)
        if rng.random() < SOFTENED_SHARE:
            return real_samples.softened(drawn, rng)
        (picture,) = photometric([drawn["picture"]], rng)
        return real_samples.sharp({**drawn, "picture": picture})

    def _negative(self, rng: np.random.Generator) -> Sample:
        """Often one that was taken for a drone when it was shown before."""
        if rng.random() < PLACES_SHARE:
            self._shown.append(None)
            return real_samples.negative(*self.places.draw(rng)[:2], rng)
        is_hard = len(self.hard) >= FEWEST_HARD and rng.random() < HARD_SHARE
        place = self.hard[int(rng.integers(len(self.hard)))] if is_hard else self.negatives.draw_place(rng)
        self._shown.append(place)
        return real_samples.negative(*self.negatives.at(place)[:2], rng)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``; what is not known of a sample has no weight."""
        batch = _flipped(batch)
        out, masks, families, motors = self.net(batch["picture"])
        there, ranged = batch["drone"], batch["drone"] * batch["range_weight"]
        error = (out[:, 0] - batch["target"][:, 0]).abs()
        nll = error / torch.exp(out[:, 3]) * 1.414 + out[:, 3]
        centre = (out[:, 1:3] - batch["target"][:, 1:3]).abs().clamp(max=30).sum(1)
        family = F.cross_entropy(families, batch["family"], reduction="none")
        apparent = (out[:, 5] - batch["apparent"]).abs()
        where = -(_motor_maps(batch["motors"]) * motors).sum(2).mean(1)
        has_range = (ranged > 0).float()
        # The deviation is learnt from all of them: it has to know which ranges are poor.
        each = ranged * (2.0 * error + 0.1 * family + 2.0 * apparent + 0.2 * where) + has_range * 0.3 * nll
        ranges = each.sum() / has_range.sum().clamp(min=1)
        centres = (0.05 * centre * there * batch["centre_weight"]).sum() / there.sum().clamp(min=1)
        exists = F.binary_cross_entropy_with_logits(out[:, 4], there, weight=batch["exists_weight"])
        masks_loss = _mask_loss(masks.float(), batch["mask"].float() / 255, there, batch["mask_weight"])
        sharp = batch["range_weight"] >= 1.0
        sharp &= there > 0.5
        figures = {"median": float(error[sharp].median().detach()), "p95": float(error[sharp].quantile(0.95).detach())}
        kind, sure = batch["kind"], torch.sigmoid(out[:, 4].detach())
        shown = sure[kind == KINDS.index("negative")].tolist()
        if len(shown) == len(self._shown):
            self.hard.extend(
                p for p, s in zip(self._shown, shown, strict=True) if p is not None and s > HARD_PROBABILITY
            )
        for number, name in enumerate(KINDS):
            mine = (kind == number) & (there > 0.5) if name != "negative" else kind == number
            right = sure[mine] > 0.8
            figures[name] = float(right.float().mean())
        return ranges + centres + exists + masks_loss, figures


def _mask_loss(logits: Tensor, mask: Tensor, drone: Tensor, weight: Tensor) -> Tensor:
    """Of (n, ., .) masks; ``drone`` (n,) is 0 where there is none."""
    bce = F.binary_cross_entropy_with_logits(logits, mask, reduction="none").mean((1, 2))
    probability = torch.sigmoid(logits)
    both, either = (probability * mask).sum((1, 2)), (probability + mask).sum((1, 2))
    dice = 1 - (2 * both + 20) / (either + 20)
    return 2.0 * (bce * weight).mean() + 0.3 * (dice * drone * weight).sum() / drone.sum().clamp(min=1)


def main() -> None:
    """Train until the minutes are over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rendered", type=Path, required=True)
    parser.add_argument("--patches", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--start", type=Path, help="checkpoint.pt of another run, or an exported network")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rate", type=float, help="learning rate to begin with")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    task = RealTask(arguments.rendered, arguments.patches)
    task.rate = arguments.rate or task.rate
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.start and not (arguments.out / "checkpoint.pt").is_file():
        _start(task, arguments.start, arguments.seed)
        torch.save({"net": task.net.state_dict()}, arguments.out / "start.pt")
    train(task, arguments.out, 60.0 * arguments.minutes, arguments.seed)


if __name__ == "__main__":
    main()
