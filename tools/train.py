"""Train one network on rendered pairs; resumes from its last checkpoint.

    python -m tools.train neighbours --data DATA --out RUNS/neighbours --minutes 40
    python -m tools.train distance   --data DATA --out RUNS/distance --minutes 90 --crops P --negatives N.npy
    python -m tools.train flow       --data DATA --out RUNS/flow --minutes 40

Writes OUT/checkpoint.pt, OUT/curve.csv and a picture of it every few minutes. Uses a GPU where there is one.
With --start it goes on from another run's weights, or from a network of models/, and keeps them as OUT/start.pt.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel

from tools.training.augment import photometric
from tools.training.crop_files import CropFiles
from tools.training.dataset import PairSet, open_pairs
from tools.training.from_onnx import begin_with_onnx
from tools.training.networks import MAX_DEPTH_M, MAX_FAMILIES, DistanceNet, FlowNet, NeighboursNet
from tools.training.samples import (
    Sample,
    flow_sample,
    neighbours_sample,
    no_drone_sample,
)

Batch = dict[str, Tensor]
NO_NAME = -1
"""Of a shape that is no family of its own in the training's hint."""


class Task:
    """What is trained, on what, against what."""

    def __init__(self, net: nn.Module, batch: int, rate: float) -> None:
        self.net, self.batch, self.rate = net, batch, rate

    def sample(self, rng: np.random.Generator) -> Sample:
        """One training sample."""
        raise NotImplementedError

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """One batch of them."""
        return [self.sample(rng) for _ in range(self.batch)]

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """The loss and figures worth watching."""
        raise NotImplementedError


class NeighboursTask(Task):
    """Depth, mask and centre offsets of one image."""

    def __init__(self, pairs: PairSet) -> None:
        super().__init__(NeighboursNet(), 12, 1.2e-3)
        self.pairs = pairs
        self.drawn = 0

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``. Every fourth batch holds whole images, the others three times as many windows around drones."""
        crop_px = 256 if self.drawn % 4 else None
        return neighbours_sample(self.pairs, int(rng.integers(self.pairs.count)), rng, crop_px=crop_px)

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """See ``Task``."""
        self.drawn += 1
        return [self.sample(rng) for _ in range(self.batch if self.drawn % 4 else self.batch // 3)]

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        depth, logit, offset = self.net(batch["image"], batch["geometry"])
        mask = batch["drone"]
        error = (depth.log() - batch["depth"].log()).abs()
        sky = batch["depth"] >= MAX_DEPTH_M
        weight = torch.where(sky, 0.3, 1.0) * (1 + 3 * mask)
        depth_loss = (error * weight).sum() / weight.sum()
        bce = F.binary_cross_entropy_with_logits(logit, mask, reduction="none")
        focal = (1 - torch.exp(-bce)) ** 1.5 * bce * (1 + 3 * mask)
        probability = torch.sigmoid(logit)
        dice = 1 - (2 * (probability * mask).sum((1, 2, 3)) + 20) / (
            probability.sum((1, 2, 3)) + mask.sum((1, 2, 3)) + 20
        )
        mask_loss = focal.mean() * 40 + 0.5 * dice.mean()
        distance = (offset - batch["offset"]).abs().sum(1, keepdim=True)
        offset_loss = (distance * mask).sum() / (mask.sum() + 1)
        near = (~sky) & (mask < 0.5)
        guess = logit > 0
        figures = {
            "depth": float(error[near].median().detach()),
            "iou": float((guess & (mask > 0.5)).sum() / ((guess | (mask > 0.5)).sum() + 1)),
            "offset": float(offset_loss.detach()),
        }
        return depth_loss + mask_loss + 0.05 * offset_loss, figures


class DistanceTask(Task):
    """Range of the drone in the middle of a crop, and which pixels are its own.

    Drones come from the files of render_drone_crops.py, as many as there are by now. Most of what is no drone is cut
    from whole images, into a pool that is renewed a little with every batch: cutting costs more than learning from it.
    """

    pool_size = 8_000
    renewed_in_a_batch = 3
    no_drone_share = 0.25

    def __init__(self, pairs: PairSet, negatives: Path, pictures: Path) -> None:
        super().__init__(DistanceNet(), 64, 2e-3)
        self.pairs, self.negatives = pairs, np.load(negatives)
        self.drones = CropFiles(pictures)
        self.no_drones: list[Sample] = []

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """See ``Task``."""
        self.drones.look_for_more()
        while len(self.no_drones) < self.pool_size:
            self.no_drones.append(self._no_drone(rng))
        for _ in range(self.renewed_in_a_batch):
            self.no_drones[int(rng.integers(self.pool_size))] = self._no_drone(rng)
        return super().batch_samples(rng)

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``."""
        from_pool = rng.random() < self.no_drone_share
        drawn = self.no_drones[int(rng.integers(self.pool_size))] if from_pool else self.drones.draw(rng)
        (picture,) = photometric([drawn["picture"]], rng)
        return {**drawn, "picture": picture}

    def _no_drone(self, rng: np.random.Generator) -> Sample:
        is_hard = len(self.negatives) > 0 and rng.random() < 0.7
        hard = self.negatives[int(rng.integers(len(self.negatives)))] if is_hard else None
        return no_drone_sample(self.pairs, hard, rng)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        batch = _flipped(batch)
        out, masks, families, motors = self.net(batch["picture"])
        there = batch["drone"]
        error = (out[:, 0] - batch["target"][:, 0]).abs()
        centre = (out[:, 1:3] - batch["target"][:, 1:3]).abs().clamp(max=30).sum(1)
        nll = error / torch.exp(out[:, 3]) * 1.414 + out[:, 3]
        # A generated or a fleet's own shape has no name in the hint, and where an own one's motors are may be unknown.
        named = torch.where(batch["family"] < MAX_FAMILIES, batch["family"], NO_NAME)
        family = F.cross_entropy(families, named, reduction="none", ignore_index=NO_NAME)
        apparent = (out[:, 5] - batch["apparent"]).abs()
        known = batch["motors"].isfinite().all(2).all(1)
        where = -(_motor_maps(batch["motors"].nan_to_num(0.0)) * motors).sum(2).mean(1) * known
        each = 0.3 * nll + 2.0 * error + 0.05 * centre + 0.3 * family + 2.0 * apparent + 0.2 * where
        seen = there > 0.5
        right = (out[:, 4] > 0) == seen
        figures = {
            "median": float(error[seen].median().detach()),
            "p95": float(error[seen].quantile(0.95).detach()),
            "apparent": float(apparent[seen].median().detach()),
            "centre": float(centre[seen].median().detach()),
            "family": float((families[seen].argmax(1) == named[seen]).float().mean()),
            "drone": float(right[seen].float().mean()),
            "other": float(right[~seen].float().mean()) if (~seen).any() else float("nan"),
        }
        exists = F.binary_cross_entropy_with_logits(out[:, 4], there)
        mask_loss, figures["iou"] = _mask_loss(masks.float(), batch["mask"].float() / 255, there)
        return (each * there).sum() / there.sum().clamp(min=1) + 0.5 * exists + mask_loss, figures


def _mask_loss(logits: Tensor, mask: Tensor, drone: Tensor) -> tuple[Tensor, float]:
    """Of (n, ., .) masks, ``drone`` (n,) being 0 where there is none; and the mean IoU of the others."""
    bce = F.binary_cross_entropy_with_logits(logits, mask)
    probability = torch.sigmoid(logits)
    both, either = (probability * mask).sum((1, 2)), (probability + mask).sum((1, 2))
    dice = 1 - (2 * both + 20) / (either + 20)
    count = drone.sum().clamp(min=1)
    guess, mine = logits > 0, mask > 0.5
    iou = (guess & mine).sum((1, 2)) / (guess | mine).sum((1, 2)).clamp(min=1)
    return 2.0 * bce + 0.3 * (dice * drone).sum() / count, float((iou * drone).sum() / count)


def _flipped(batch: Batch) -> Batch:
    """Another half of the crops each time left to right, a tenth in strange colours, all in another light."""
    n = len(batch["picture"])
    mirror = torch.rand(n) < 0.5
    sign = torch.where(mirror, -1.0, 1.0)
    light = torch.exp(0.1 * torch.randn(n, 1, 1, 1) + 0.04 * torch.randn(n, 1, 1, 3))
    picture = torch.where(mirror[:, None, None, None], batch["picture"].flip(2), batch["picture"])
    strange = (torch.rand(n) < 0.1)[:, None, None, None]
    picture = torch.where(strange, picture[..., torch.randperm(3)], picture)
    picture = (picture.float() * light + 5.0 * torch.randn(n, 1, 1, 1)).clamp(0, 255).to(torch.uint8)
    mask = torch.where(mirror[:, None, None], batch["mask"].flip(2), batch["mask"])
    target, motors = batch["target"].clone(), batch["motors"].clone()
    target[:, 1] *= sign
    motors[:, :, 0] *= sign[:, None]
    return {**batch, "picture": picture, "mask": mask, "target": target, "motors": motors}


def _motor_maps(motors: Tensor, sigma: float = 1.5) -> Tensor:
    """(n, 4, 2) places in px from the crop's middle -> (n, 4, 48 * 48) shares of maps of half its size.

    From left to right; what lies outside the crop counts for its border.
    """
    order = motors[:, :, 0].argsort(1)
    places = torch.gather(motors, 1, order[:, :, None].expand(-1, -1, 2)).clamp(-47.0, 47.0)
    at = 2.0 * torch.arange(48) + 1.0 - 48.0
    across = torch.softmax(-((at - places[:, :, 0:1]) ** 2) / (2 * sigma**2), 2)
    along = torch.softmax(-((at - places[:, :, 1:2]) ** 2) / (2 * sigma**2), 2)
    return torch.einsum("nkv,nku->nkvu", along, across).flatten(2)


class FlowTask(Task):
    """Where each pixel went."""

    def __init__(self, pairs: PairSet) -> None:
        super().__init__(FlowNet(), 16, 6e-4)
        self.pairs = pairs

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``."""
        return flow_sample(self.pairs, int(rng.integers(self.pairs.count)), rng, (144, 112))

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        flows = self.net(batch["first"], batch["second"])
        valid = batch["valid"][:, None] & (batch["flow"].abs().amax(1, keepdim=True) < 120)
        weight = valid.float() * (1 + 2 * batch["drone"][:, None].float())
        total = torch.zeros(())
        for i, flow in enumerate(flows):
            error = (flow - batch["flow"]).abs().sum(1, keepdim=True)
            total = total + 0.8 ** (len(flows) - 1 - i) * (error * weight).sum() / (weight.sum() + 1)
        end_point = (flows[-1] - batch["flow"]).norm(dim=1, keepdim=True).detach()
        drone = valid & batch["drone"][:, None]
        figures = {
            "median": float(end_point[valid].median()),
            "mean": float(end_point[valid].mean()),
            "drone": float(end_point[drone].median()) if drone.any() else float("nan"),
        }
        return total, figures


NETWORKS = ("neighbours", "distance", "flow")


def _task(arguments: argparse.Namespace) -> Task:
    pairs = open_pairs(arguments.data)
    if arguments.network != "distance":
        return NeighboursTask(pairs) if arguments.network == "neighbours" else FlowTask(pairs)
    if arguments.negatives is None or arguments.crops is None:
        raise SystemExit("the distance network needs --crops and --negatives")
    return DistanceTask(pairs, arguments.negatives, arguments.crops)


def main() -> None:
    """Train until the minutes are over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--data", type=Path, required=True, help="folder of render_training_data.py")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=60.0, help="of training in all, over every resumption")
    parser.add_argument("--negatives", type=Path, help="what is no drone, for `distance`: file of mine_negatives.py")
    parser.add_argument("--crops", type=Path, help="drones, for `distance`: folder of render_drone_crops.py")
    parser.add_argument("--rate", type=float, help="learning rate to begin with")
    parser.add_argument("--start", type=Path, help="weights to begin with: another run's checkpoint.pt, or an .onnx")
    parser.add_argument("--compile", action="store_true", help="`distance` a fifth faster; needs a C++ compiler")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    compiler = os.environ.get("CXX", "g++")
    if arguments.compile and shutil.which(compiler) is None:
        raise SystemExit(f"--compile needs a C++ compiler, and there is no {compiler} here; leave --compile out")
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    task = _task(arguments)
    task.rate = arguments.rate or task.rate
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.start and not (arguments.out / "checkpoint.pt").is_file():
        try:
            start(task, arguments.start, arguments.seed)
        except ValueError as error:
            raise SystemExit(f"--start: {error}") from None
        torch.save({"net": task.net.state_dict()}, arguments.out / "start.pt")
    if arguments.compile:
        task.net.compile(dynamic=False)
    train(task, arguments.out, 60.0 * arguments.minutes, arguments.seed)


def start(task: Task, weights: Path, seed: int) -> None:
    """Give the task's network the weights of another run, or of a network that it or another one exported.

    Raises ValueError where an ONNX file is of another network.
    """
    if weights.suffix != ".onnx":
        begin_with(task.net, torch.load(weights, map_location="cpu")["net"])
        return
    batch = _stack(task.batch_samples(np.random.default_rng(seed)), torch.device("cpu"))
    begin_with_onnx(task.net, weights, lambda: task.loss(batch))


def begin_with(net: nn.Module, weights: dict[str, Tensor]) -> None:
    """Take over what fits; of a layer that has grown, the part that was there."""
    own = net.state_dict()
    for name, value in weights.items():
        if name in own and own[name].dim() == value.dim():
            part = tuple(slice(0, min(a, b)) for a, b in zip(own[name].shape, value.shape, strict=True))
            own[name][part] = value[part]
    net.load_state_dict(own)


def train(task: Task, out: Path, budget_s: float, seed: int) -> None:
    """One cosine-shaped run of ``budget_s`` seconds of training.

    What is kept is the mean of the weights over about the last thousand steps: each step's own errs to all sides.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    net = task.net.to(device).to(memory_format=torch.channels_last)
    mean = AveragedModel(net, avg_fn=_recent_mean, use_buffers=True)
    optimiser = torch.optim.AdamW(net.parameters(), lr=task.rate, weight_decay=1e-4)
    spent, step = 0.0, 0
    checkpoint = out / "checkpoint.pt"
    if checkpoint.is_file():
        state = torch.load(checkpoint, map_location=device)
        net.load_state_dict(state["last"])
        mean.module.load_state_dict(state["net"])
        mean.n_averaged.fill_(state["step"])
        optimiser.load_state_dict(state["optimiser"])
        spent, step = state["spent"], state["step"]
    rng = np.random.Generator(np.random.PCG64([seed, step]))
    in_16_bits = is_faster_in_16_bits(device)
    net.train()
    last_save = last_print = spent
    recent: list[dict[str, float]] = []
    while spent < budget_s:
        begin = time.monotonic()
        share = spent / budget_s
        rate = task.rate * min(1.0, (step + 1) / 300) * (0.5 + 0.5 * math.cos(math.pi * share)) + 1e-6
        for group in optimiser.param_groups:
            group["lr"] = rate
        batch = _stack(task.batch_samples(rng), device)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=in_16_bits):
            loss, figures = task.loss(batch)
        if torch.isfinite(loss):
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            mean.update_parameters(net)
        else:
            print(f"step {step}: the loss is not finite; its batch was left out", flush=True)
        recent.append({"loss": float(loss.detach()), **figures})
        step += 1
        spent += time.monotonic() - begin
        if spent - last_print > 30 or spent >= budget_s:
            _note(out, step, spent, recent)
            recent, last_print = [], spent
        if spent - last_save > 150 or spent >= budget_s:
            state = {
                "net": mean.module.state_dict(), "last": net.state_dict(), "optimiser": optimiser.state_dict(),
                "spent": spent, "step": step,
            }  # fmt: skip
            torch.save(state, checkpoint.with_suffix(".new"))
            checkpoint.with_suffix(".new").replace(checkpoint)
            _draw_curve(out)
            last_save = spent


def is_faster_in_16_bits(device: torch.device) -> bool:
    """Whether training with bfloat16 pays. Measured: a processor without instructions for it takes eightfold."""
    layer = nn.Conv2d(32, 32, 3, padding=1).to(device).to(memory_format=torch.channels_last)
    pictures = torch.randn(8, 32, 64, 64, device=device).to(memory_format=torch.channels_last)

    def took_s(in_16_bits: bool) -> float:
        begin = time.monotonic()
        for _ in range(3):
            with torch.autocast(device.type, dtype=torch.bfloat16, enabled=in_16_bits):
                answer = layer(pictures)
            float(answer.detach().sum())
        return time.monotonic() - begin

    tries = [(took_s(in_16_bits=True), took_s(in_16_bits=False)) for _ in range(3)]
    return min(first for first, _ in tries) < min(second for _, second in tries)


def _recent_mean(mean: Tensor, new: Tensor, count: Tensor) -> Tensor:
    """Of floating-point weights; counters are taken as they are."""
    if not mean.is_floating_point():
        return new
    share = max(1e-3, 1.0 / (1.0 + 0.1 * float(count)))
    return mean + share * (new - mean)


def _stack(samples: list[Sample], device: torch.device) -> Batch:
    def joined(name: str) -> NDArray[Any]:
        return np.stack([sample[name] for sample in samples])

    return {name: torch.from_numpy(joined(name)).to(device) for name in samples[0]}


def _note(out: Path, step: int, spent: float, recent: list[dict[str, float]]) -> None:
    means = {name: float(np.nanmean([figures[name] for figures in recent])) for name in recent[0]}
    print(f"step {step:6d} {spent:6.0f} s  " + "  ".join(f"{n} {v:.4f}" for n, v in means.items()), flush=True)
    curve = out / "curve.csv"
    if not curve.is_file():
        curve.write_text("step,seconds," + ",".join(means) + "\n")
    with curve.open("a") as file:
        file.write(f"{step},{spent:.0f}," + ",".join(f"{v:.6f}" for v in means.values()) + "\n")


def _draw_curve(out: Path) -> None:
    """One small plot a figure, over minutes of training."""
    with (out / "curve.csv").open() as file:
        names = file.readline().strip().split(",")[2:]
        rows = np.array([[float(value) for value in line.split(",")] for line in file])
    figure = Figure(figsize=(4.0 * len(names), 3.0), layout="constrained")
    for name, axes, values in zip(names, figure.subplots(1, len(names)), rows[:, 2:].T, strict=True):
        axes.plot(rows[:, 1] / 60.0, values, linewidth=0.8)
        axes.set(title=name, xlabel="minutes", yscale="log" if (values > 0).all() else "linear")
        axes.grid(alpha=0.3, which="both")
    figure.savefig(out / "curve.png", dpi=80)


if __name__ == "__main__":
    main()
