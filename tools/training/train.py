"""Train one network; resumes from its last checkpoint.

    python -m tools.training.train neighbours --data DATA --out RUNS/neighbours --minutes 40
    python -m tools.training.train sigma --data DATA --out RUNS/sigma --start RUNS/distance/checkpoint.pt

All draw from one folder: DATA/worlds of tools.training.render_training_data, DATA/crops of render_drone_crops and
DATA/cutouts of render_drone_crops --cut-out, DATA/photographs without drones and DATA/labelled/* with real ones (see
docs/networks.md), and what tools.training.mine found in them. `sigma` is the last part of `distance`: how far it may
misjudge a drone's size, also of one that it has not seen.

Writes OUT/checkpoint.pt every few minutes and OUT/curve.csv. Uses a GPU where there is one.
With --start it goes on from another run's weights, or from a network of models/, and keeps them as OUT/start.pt.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from tools.training.picture_tasks import DetectorTask, VerificationTask
from tools.training.samples import Sample
from tools.training.tasks import Batch, DistanceTask, FlowTask, NeighboursTask, SigmaTask, Task
from tools.training.weights import begin_with_onnx

TASKS: dict[str, Callable[[Path], Task]] = {
    "neighbours": NeighboursTask, "distance": DistanceTask, "sigma": SigmaTask, "flow": FlowTask,
    "verification": VerificationTask, "detector": DetectorTask,
}  # fmt: skip


def main() -> None:
    """Train until the minutes are over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=TASKS)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=60.0, help="of training in all, over every resumption")
    parser.add_argument("--rate", type=float, help="learning rate to begin with")
    parser.add_argument("--times", type=int, default=1, help="so many times as large batches, beside a GPU")
    parser.add_argument("--start", type=Path, help="weights to begin with: another run's checkpoint.pt, or an .onnx")
    parser.add_argument("--workers", type=int, default=1, help="processes that draw samples")
    arguments = parser.parse_args()
    if arguments.network == "sigma" and arguments.start is None:
        parser.error("sigma needs the distance network that it belongs to, with --start")
    torch.manual_seed(0)
    torch.set_num_threads(2)
    cv2.setNumThreads(1)
    try:
        task = TASKS[arguments.network](arguments.data)
    except (FileNotFoundError, ValueError) as error:
        raise SystemExit(f"--data: {error}") from None
    task.rate = arguments.rate or task.rate
    task.batch *= arguments.times
    arguments.out.mkdir(parents=True, exist_ok=True)
    begun_with = arguments.out / "start.pt"
    if arguments.start and not begun_with.is_file():
        try:
            start(task, arguments.start)
        except ValueError as error:
            raise SystemExit(f"--start: {error}") from None
        torch.save({"net": task.net.state_dict()}, begun_with)
    elif begun_with.is_file():
        task.go_on_from(torch.load(begun_with, map_location="cpu")["net"])
    train(task, arguments.out, 60.0 * arguments.minutes, arguments.workers)


def start(task: Task, weights: Path) -> None:
    """Give the task's network the weights of another run (.pt), or of an exported network (.onnx).

    Raises ValueError where an ONNX file is of another network.
    """
    if weights.suffix == ".onnx":
        batch = _stack(task.batch_samples(np.random.default_rng(0)))
        begin_with_onnx(task.net, weights, lambda: task.loss(batch))
        task.go_on_from(task.net.state_dict())
    else:
        task.go_on_from(torch.load(weights, map_location="cpu")["net"])


def train(task: Task, out: Path, budget_s: float, workers: int) -> None:
    """Train for ``budget_s`` seconds with a cosine learning rate; ``workers`` processes draw the samples.

    The result is the mean of the weights over about the last thousand steps, which has less noise than those of a step.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    net = task.net.to(device).to(memory_format=torch.channels_last)
    mean = AveragedModel(net, avg_fn=_recent_mean, use_buffers=True)
    learning = [one for one in net.parameters() if one.requires_grad]
    optimiser = torch.optim.AdamW(learning, lr=task.rate, weight_decay=1e-4)
    spent, step = 0.0, 0
    checkpoint = out / "checkpoint.pt"
    if checkpoint.is_file():
        state = torch.load(checkpoint, map_location=device)
        net.load_state_dict(state["last"])
        mean.module.load_state_dict(state["net"])
        mean.n_averaged.fill_(state["step"])
        optimiser.load_state_dict(state["optimiser"])
        spent, step = state["spent"], state["step"]
    task.begin()
    last_save = last_print = spent
    recent: list[dict[str, float]] = []
    upcoming = batches(task, [0, step], workers)
    while spent < budget_s:
        begin = time.monotonic()
        share = spent / budget_s
        rate = task.rate * min(1.0, (step + 1) / 300) * (0.5 + 0.5 * math.cos(math.pi * share)) + 1e-6
        for group in optimiser.param_groups:
            group["lr"] = rate
        batch = {name: values.to(device) for name, values in next(upcoming).items()}
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=device.type == "cuda"):
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
            last_save = spent


def _recent_mean(mean: Tensor, new: Tensor, count: Tensor) -> Tensor:
    """Running mean of floating-point weights; counters are copied."""
    if not mean.is_floating_point():
        return new
    share = max(1e-3, 1.0 / (1.0 + 0.1 * float(count)))
    return mean + share * (new - mean)


def batches(task: Task, seed: list[int], workers: int) -> Iterator[Batch]:
    """Batches without end; ``workers`` processes make the next ones during a step."""
    yield from DataLoader(
        _Batches(task, seed), batch_size=None, num_workers=workers, prefetch_factor=3, multiprocessing_context="fork"
    )


class _Batches(IterableDataset[Batch]):
    """The batches of a task; each process draws different ones."""

    def __init__(self, task: Task, seed: list[int]) -> None:
        self._task, self._seed = task, seed

    def __iter__(self) -> Iterator[Batch]:
        """Without end."""
        worker = get_worker_info()
        rng = np.random.Generator(np.random.PCG64([*self._seed, worker.id if worker else 0]))
        while True:
            yield _stack(self._task.batch_samples(rng))


def _stack(samples: list[Sample]) -> Batch:
    return {name: torch.from_numpy(np.stack([sample[name] for sample in samples])) for name in samples[0]}


def _note(out: Path, step: int, spent: float, recent: list[dict[str, float]]) -> None:
    known = {name: [figures[name] for figures in recent if not np.isnan(figures[name])] for name in recent[0]}
    means = {name: float(np.mean(values)) if values else float("nan") for name, values in known.items()}
    print(f"step {step:6d} {spent:6.0f} s  " + "  ".join(f"{n} {v:.4f}" for n, v in means.items()), flush=True)
    curve = out / "curve.csv"
    if not curve.is_file():
        curve.write_text("step,seconds," + ",".join(means) + "\n")
    with curve.open("a") as file:
        file.write(f"{step},{spent:.0f}," + ",".join(f"{v:.6f}" for v in means.values()) + "\n")


if __name__ == "__main__":
    main()
