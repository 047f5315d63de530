"""Train the network that says whether a crop shows a drone, on rendered and real pictures.

    python -m tools.training.train_verification --rendered CROPS --patches PATCHES --start models/distance.onnx --out
    RUN

CROPS is the folder of tools.training.render_drone_crops, PATCHES that of tools.training.mine_pictures. Resumes like
tools.training.train, and writes the same files.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from tools.training import real_samples
from tools.training.augment import photometric
from tools.training.crop_files import CropFiles
from tools.training.cutout_crops import CutoutCrops
from tools.training.from_onnx import begin_with_onnx
from tools.training.networks import DistanceNet, VerificationNet
from tools.training.real_patches import RealPatches
from tools.training.samples import Sample
from tools.training.tasks import Batch, Task
from tools.training.train import add_machine, begin_with, train

MIX = {"rendered": 36, "composite": 8, "airframe": 22, "real drone": 8, "cut out": 4, "negative": 46}
"""Samples of a batch; `airframe` is a cut-out of tools.training.render_cutouts before a real background."""
KINDS = tuple(MIX)
SOFTENED_SHARE = 0.5
"""Share of the rendered crops that is softened."""
PLACES_SHARE = 0.15
"""Share of the negatives that is cut anywhere, not where the first stage proposed a drone."""
NOISE_SHARE = 0.05
"""Share of the negatives that is what a failing sensor delivers."""
NEGATIVE_WEIGHTS = {"skyothers": 150.0, "rendered": 300.0}
"""What flies besides drones, and what the first stage proposes in the worlds of the test flights, are drawn more often
than the number of their patches says."""
HARD_PROBABILITY, HARD_SHARE, HARD_ONES, FEWEST_HARD = 0.3, 0.35, 4000, 200
"""A negative of more than this probability is remembered, the last so many are, and drawn so often."""

NO_PLACE = np.array([-1, -1])
"""The place of a sample that is no negative patch."""


class HardOnes:
    """Places of the negatives that were last taken for drones; processes that draw samples see what another adds."""

    def __init__(self) -> None:
        self._places = torch.zeros(HARD_ONES, 2, dtype=torch.int64).share_memory_()
        self._added = torch.zeros(1, dtype=torch.int64).share_memory_()

    @property
    def count(self) -> int:
        """How many there are."""
        return min(int(self._added), HARD_ONES)

    def add(self, places: Tensor) -> None:
        """(n, 2) source and row; the oldest ones give way."""
        self._places[(self._added + torch.arange(len(places))) % HARD_ONES] = places.cpu()
        self._added += len(places)

    def draw(self, rng: np.random.Generator) -> tuple[int, int]:
        """Any of them."""
        source, row = self._places[int(rng.integers(self.count))].tolist()
        return source, row


class VerificationTask(Task):
    """Drones and what is none: rendered, rendered before real backgrounds, and real."""

    net: VerificationNet

    def __init__(
        self, rendered: Path, patches: Path, cutouts: Sequence[Path] = (), mix: Mapping[str, int] = MIX
    ) -> None:
        """``mix``: samples of a batch, by kinds of ``KINDS``; no `airframe` where there are no ``cutouts``."""
        mix = {kind: count for kind, count in mix.items() if cutouts or kind != "airframe"}
        super().__init__(VerificationNet(), sum(mix.values()), 6e-4)
        self.mix = mix
        self.rendered = CropFiles(rendered)
        self.negatives = RealPatches(patches, "negative", weights=NEGATIVE_WEIGHTS)
        self.places = RealPatches(patches, "place", weights={"skydrones": 8.0, "skyothers": 8.0})
        self.drones = RealPatches(patches, "drone")
        self.cutouts = CutoutCrops(cutouts) if cutouts else None
        self.hard = HardOnes()

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """As many of each kind as the mix says."""
        self.rendered.look_for_more()
        kinds = [(number, kind) for number, kind in enumerate(KINDS) for _ in range(self.mix.get(kind, 0))]
        return [{"place": NO_PLACE} | self._of_kind(kind, rng) | {"kind": np.array(number)} for number, kind in kinds]

    def _of_kind(self, kind: str, rng: np.random.Generator) -> Sample:
        if kind == "negative":
            return self._negative(rng)
        if kind == "real drone":
            return real_samples.real_drone(self.drones, rng)
        backgrounds = self.places if rng.random() < 0.6 else self.negatives
        if kind == "cut out":
            return real_samples.real_drone(self.drones, rng, backgrounds=backgrounds)
        if kind == "airframe" and self.cutouts:
            return real_samples.composite(self.cutouts.draw(rng), backgrounds, rng)
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
        if rng.random() < NOISE_SHARE:
            return real_samples.noise(*self.places.draw(rng)[:2], rng)
        if rng.random() < PLACES_SHARE:
            return real_samples.negative(*self.places.draw(rng)[:2], rng)
        is_hard = self.hard.count >= FEWEST_HARD and rng.random() < HARD_SHARE
        place = self.hard.draw(rng) if is_hard else self.negatives.draw_place(rng)
        return real_samples.negative(*self.negatives.at(place)[:2], rng) | {"place": np.array(place)}

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``. A drone that can hardly be seen has little weight."""
        crops = batch["picture"]
        mirror = torch.rand(len(crops), device=crops.device) < 0.5
        crops = torch.where(mirror[:, None, None, None], crops.flip(2), crops)
        logits, there, kind = self.net(crops)[:, 0], batch["drone"], batch["kind"]
        loss = F.binary_cross_entropy_with_logits(logits, there, weight=batch["exists_weight"])
        probability = torch.sigmoid(logits.detach())
        mistaken = (batch["place"][:, 0] >= 0) & (probability > HARD_PROBABILITY)
        self.hard.add(batch["place"][mistaken])
        figures = {"rendered none": float((probability[(kind == 0) & (there < 0.5)] > 0.8).float().mean())}
        for number, name in enumerate(KINDS):
            if name not in self.mix:
                continue
            mine = (kind == number) & (there > 0.5) if name != "negative" else kind == number
            figures[name] = float((probability[mine] > 0.8).float().mean())
        return loss, figures


def begin_with_encoder(net: VerificationNet, distance: Path, run: Callable[[DistanceNet], object]) -> None:
    """The encoder of an exported ``DistanceNet``; ``run`` calls that on a batch of crops. Raises ValueError."""
    other = DistanceNet()
    begin_with_onnx(other, distance, lambda: run(other))
    layers = ("stem.", "down.", "body.", "more.")
    begin_with(net, {name: value for name, value in other.state_dict().items() if name.startswith(layers)})


def main() -> None:
    """Train until the minutes are over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rendered", type=Path, required=True)
    parser.add_argument("--patches", type=Path, required=True)
    parser.add_argument("--cutouts", type=Path, action="append", default=[], help="of tools.training.render_cutouts")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--start", type=Path, help="another run's checkpoint.pt, or verification.onnx or distance.onnx")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rate", type=float, help="learning rate to begin with")
    add_machine(parser)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    task = VerificationTask(arguments.rendered, arguments.patches, arguments.cutouts)
    task.rate = arguments.rate or task.rate
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.start and not (arguments.out / "checkpoint.pt").is_file():
        _start(task, arguments.start, arguments.seed)
        torch.save({"net": task.net.state_dict()}, arguments.out / "start.pt")
    train(task, arguments.out, 60.0 * arguments.minutes, arguments.seed, arguments.workers)


def _start(task: VerificationTask, weights: Path, seed: int) -> None:
    net = task.net
    if weights.suffix != ".onnx":
        begin_with(net, torch.load(weights, map_location="cpu")["net"])
        return
    samples = task.batch_samples(np.random.default_rng(seed))
    crops = torch.from_numpy(np.stack([sample["picture"] for sample in samples]))
    try:
        begin_with_onnx(net, weights, lambda: net(crops))
    except ValueError:
        try:
            begin_with_encoder(net, weights, lambda other: other(crops))
        except ValueError as error:
            raise SystemExit(f"--start: {error}") from None


if __name__ == "__main__":
    main()
