"""The training tasks: network, samples and loss."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tools.training.camera_effects import as_filmed
from tools.training.dataset import MAX_DEPTH_M, MAX_FAMILIES, open_pairs
from tools.training.networks import DistanceNet, FlowNet, NeighboursNet
from tools.training.pictures import CropFiles
from tools.training.samples import Sample, flow_sample, neighbours_sample, no_drone_sample
from tools.training.weights import begin_with

Batch = dict[str, Tensor]
WINDOW_PX = 256
NO_NAME = -1
"""Class of a shape that belongs to no family; the loss ignores it."""


class Task:
    """A network, its training samples and its loss."""

    def __init__(self, net: nn.Module, batch: int, rate: float) -> None:
        self.net, self.batch, self.rate = net, batch, rate

    def go_on_from(self, weights: Mapping[str, Tensor]) -> None:
        """Begin with the weights of another run."""
        begin_with(self.net, weights)

    def begin(self) -> None:
        """Set the network to training mode."""
        self.net.train()

    def sample(self, rng: np.random.Generator) -> Sample:
        """One training sample."""
        raise NotImplementedError

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """The samples of one batch."""
        return [self.sample(rng) for _ in range(self.batch)]

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """The loss, and figures to print."""
        raise NotImplementedError


class NeighboursTask(Task):
    """Depth, mask and centre offsets of one image."""

    def __init__(self, data: Path) -> None:
        super().__init__(NeighboursNet(), 12, 1.2e-3)
        self.pairs, self.drawn = open_pairs(data / "worlds"), 0

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``. Every fourth batch holds whole images, the others three times as many windows around drones."""
        crop_px = WINDOW_PX if self.drawn % 4 else None
        return neighbours_sample(self.pairs, int(rng.integers(self.pairs.count)), rng, crop_px=crop_px)

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """See ``Task``."""
        self.drawn += 1
        if self.drawn % 4 == 0:
            return [self.sample(rng) for _ in range(self.batch // 3)]
        return super().batch_samples(rng)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        depth, logit, offset = self.net(batch["image"], batch["geometry"])
        true, mask = batch["depth"], batch["drone"]
        error = (depth.log() - true.log()).abs()
        sky = true >= MAX_DEPTH_M
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
        guess, near = logit > 0, (~sky) & (mask < 0.5)
        figures = {
            "depth": float(error[near].median().detach()),
            "iou": float((guess & (mask > 0.5)).sum() / ((guess | (mask > 0.5)).sum() + 1)),
            "offset": float(offset_loss.detach()),
        }
        return depth_loss + mask_loss + 0.05 * offset_loss, figures


class DistanceTask(Task):
    """Range of the drone in the middle of a crop, and which pixels are its own.

    Drones come from the files of render_drone_crops.py. Most of what is no drone is cut
    from whole images, into a pool that is renewed a little with every batch: cutting costs more than learning from it.
    """

    pool_size = 8_000
    renewed_in_a_batch = 3
    no_drone_share = 0.25
    teacher: DistanceNet | None = None
    """The network at the start: where it rejects a crop, this one has to reject it as surely (learning without
    forgetting, Li and Hoiem 2016)."""

    def __init__(self, data: Path) -> None:
        super().__init__(DistanceNet(), 64, 2e-3)
        self.pairs, self.drones = open_pairs(data / "worlds"), CropFiles(data / "crops")
        negatives = data / "worlds" / "negatives.npy"
        if not negatives.is_file():
            raise FileNotFoundError(f"{negatives}: is missing; make it with `python -m tools.training.mine`")
        self.negatives, self.no_drones = np.load(negatives), list[Sample]()

    def go_on_from(self, weights: Mapping[str, Tensor]) -> None:
        """See ``Task``. They also become the teacher."""
        super().go_on_from(weights)
        self.teacher = copy.deepcopy(self.net).eval()

    def batch_samples(self, rng: np.random.Generator) -> list[Sample]:
        """See ``Task``."""
        while len(self.no_drones) < self.pool_size:
            self.no_drones.append(self._no_drone(rng))
        for _ in range(self.renewed_in_a_batch):
            self.no_drones[int(rng.integers(self.pool_size))] = self._no_drone(rng)
        return super().batch_samples(rng)

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``."""
        from_pool = rng.random() < self.no_drone_share
        drawn = self.no_drones[int(rng.integers(self.pool_size))] if from_pool else self.drones.draw(rng)
        (picture,) = as_filmed([drawn["picture"]], rng)
        return {**drawn, "picture": picture}

    def _no_drone(self, rng: np.random.Generator) -> Sample:
        is_hard = len(self.negatives) > 0 and rng.random() < 0.7
        hard = self.negatives[int(rng.integers(len(self.negatives)))] if is_hard else None
        return no_drone_sample(self.pairs, hard, rng)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        batch = _flipped(batch)
        if self.teacher is not None:
            batch = _patched(batch)
        out, masks, families, motors = self.net(batch["picture"])
        there = batch["drone"]
        error = (out[:, 0] - batch["target"][:, 0]).abs()
        centre = (out[:, 1:3] - batch["target"][:, 1:3]).abs().clamp(max=30).sum(1)
        apparent = (out[:, 5] - batch["apparent"]).abs()
        nll = _laplace_nll(error, out[:, 3]) + _laplace_nll(_size_error(out, batch).detach(), out[:, 6])
        # A generated or a fleet's own shape has no name in the hint, and where an own one's motors are may be unknown.
        named = torch.where(batch["family"] < MAX_FAMILIES, batch["family"], NO_NAME)
        family = F.cross_entropy(families, named, reduction="none", ignore_index=NO_NAME)
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
        loss = (each * there).sum() / there.sum().clamp(min=1) + 0.5 * exists + mask_loss
        if self.teacher is not None and (~seen).any():
            with torch.no_grad():
                picture = batch["picture"][~seen]
                sure = self.teacher.to(picture.device)(picture)[0][:, 4]
            forgotten = F.relu(out[~seen, 4] - sure)
            figures["forgotten"] = float(forgotten.mean().detach())
            loss = loss + 0.1 * F.smooth_l1_loss(forgotten, torch.zeros_like(forgotten))
        return loss, figures


class SigmaTask(Task):
    """The error of a drone's size that a trained ``DistanceNet`` states, also for drones that it has not seen.

    Ranges, centres and masks stay as they are: only ``doubt`` learns. Shapes of the generator stand for the unknown.
    """

    known_share = 0.8
    """Weight of known families in the loss, of 1; half of the drones are shapes."""

    def __init__(self, data: Path) -> None:
        super().__init__(DistanceNet(), 64, 1e-3)
        self.drones = CropFiles(data / "crops")
        for name, weights in self.net.named_parameters():
            weights.requires_grad = name.startswith("doubt.")

    def begin(self) -> None:
        """See ``Task``. Its normalisations stay as they are."""
        self.net.eval()

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``."""
        drawn = self.drones.draw(rng)
        (picture,) = as_filmed([drawn["picture"]], rng)
        return {**drawn, "picture": picture}

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """See ``Task``."""
        batch = _flipped(batch)
        out = self.net(batch["picture"])[0]
        error = _size_error(out, batch)
        there, known = batch["drone"], batch["family"] < MAX_FAMILIES
        weight = there * torch.where(known, self.known_share, 1 - self.known_share)
        loss = (weight * _laplace_nll(error, out[:, 6])).sum() / weight.sum().clamp(min=1e-3)
        within = (error < torch.exp(out[:, 6])).float().detach()
        known, unknown = known & (there > 0.5), ~known & (there > 0.5)
        return loss, {"known": float(within[known].mean()), "unknown": float(within[unknown].mean())}


def _size_error(out: Tensor, batch: Batch) -> Tensor:
    """(n,) absolute error of the logarithm of the size in metres."""
    return (out[:, 0] + out[:, 5] - batch["target"][:, 0] - batch["apparent"]).abs()


def _laplace_nll(error: Tensor, log_sigma: Tensor) -> Tensor:
    """Negative log likelihood of a Laplace distribution, whose mean deviation is its standard one over root 2."""
    return error / torch.exp(log_sigma) * 1.414 + log_sigma


def _mask_loss(logits: Tensor, mask: Tensor, drone: Tensor) -> tuple[Tensor, float]:
    """Loss of (n, ., .) masks, ``drone`` (n,) being 0 where there is none; and the mean IoU of the others."""
    bce = F.binary_cross_entropy_with_logits(logits, mask)
    probability = torch.sigmoid(logits)
    both, either = (probability * mask).sum((1, 2)), (probability + mask).sum((1, 2))
    dice = 1 - (2 * both + 20) / (either + 20)
    count = drone.sum().clamp(min=1)
    guess, mine = logits > 0, mask > 0.5
    iou = (guess & mine).sum((1, 2)) / (guess | mine).sum((1, 2)).clamp(min=1)
    return 2.0 * bce + 0.3 * (dice * drone).sum() / count, float((iou * drone).sum() / count)


def _flipped(batch: Batch) -> Batch:
    """The batch with half of the crops mirrored, a tenth in permuted colours, all in another light."""
    n, device = len(batch["picture"]), batch["picture"].device
    mirror = torch.rand(n, device=device) < 0.5
    sign = torch.where(mirror, -1.0, 1.0)
    light = torch.exp(0.1 * torch.randn(n, 1, 1, 1, device=device) + 0.04 * torch.randn(n, 1, 1, 3, device=device))
    picture = torch.where(mirror[:, None, None, None], batch["picture"].flip(2), batch["picture"])
    strange = (torch.rand(n, device=device) < 0.1)[:, None, None, None]
    picture = torch.where(strange, picture[..., torch.randperm(3)], picture)
    picture = (picture.float() * light + 5.0 * torch.randn(n, 1, 1, 1, device=device)).clamp(0, 255).to(torch.uint8)
    mask = torch.where(mirror[:, None, None], batch["mask"].flip(2), batch["mask"])
    target, motors = batch["target"].clone(), batch["motors"].clone()
    target[:, 1] *= sign
    motors[:, :, 0] *= sign[:, None]
    return {**batch, "picture": picture, "mask": mask, "target": target, "motors": motors}


def _patched(batch: Batch) -> Batch:
    """The batch in which half of the crops without a drone have a rectangle of another such crop."""
    none = torch.nonzero(batch["drone"] < 0.5)[:, 0]
    picture = batch["picture"].clone()
    size = picture.shape[1]
    for k, other in zip(none.tolist()[::2], none[torch.randperm(len(none))].tolist(), strict=False):
        (top, bottom), (left, right) = torch.randint(0, size + 1, (2, 2)).sort(1).values.tolist()
        picture[k, top:bottom, left:right] = batch["picture"][other, top:bottom, left:right]
    return {**batch, "picture": picture}


def _motor_maps(motors: Tensor, sigma: float = 1.5) -> Tensor:
    """(n, 4, 2) places in px from the crop's middle -> (n, 4, 48 * 48) shares of maps of half its size.

    From left to right; what lies outside the crop counts for its border.
    """
    order = motors[:, :, 0].argsort(1)
    places = torch.gather(motors, 1, order[:, :, None].expand(-1, -1, 2)).clamp(-47.0, 47.0)
    at = 2.0 * torch.arange(48, device=motors.device) + 1.0 - 48.0
    across = torch.softmax(-((at - places[:, :, 0:1]) ** 2) / (2 * sigma**2), 2)
    along = torch.softmax(-((at - places[:, :, 1:2]) ** 2) / (2 * sigma**2), 2)
    return torch.einsum("nkv,nku->nkvu", along, across).flatten(2)


class FlowTask(Task):
    """Optical flow between two images."""

    def __init__(self, data: Path) -> None:
        super().__init__(FlowNet(), 16, 6e-4)
        self.pairs = open_pairs(data / "worlds")

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
