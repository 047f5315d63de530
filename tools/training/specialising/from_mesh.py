"""Range of a fleet's own drone from a mesh: rendered in training worlds, `distance` learns its shape.

The general network learnt what is no drone from far more places. It teaches that along, and the weights are drawn back
a third of the way to its own.
The network is measured against the general one in crops, with the drone and without, of worlds that it has not seen.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel, load_manifest
from flockd.flight.perception.requirements import check_roles
from flockd.sim.airframe import DroneModel
from tools.measure.evaluation.on_crops import HeldOut, measured
from tools.training import worlds
from tools.training.dataset import PairSet, open_pairs
from tools.training.export import draw_back, export
from tools.training.manifests import note_accuracy
from tools.training.mine_negatives import mined
from tools.training.networks import DistanceNet
from tools.training.own_mesh import painted
from tools.training.quantise import quantise
from tools.training.render_drone_crops import CropJob, render_crops
from tools.training.render_training_data import PairJob, render_pairs
from tools.training.samples import no_drone_sample
from tools.training.specialising.runs import claim, command_line, table, training_s
from tools.training.tasks import DistanceTask
from tools.training.train import start, train

RATE = 4e-4
"""Learning rate to begin with: less than of a network that knows nothing yet."""
PAINTS = 12
"""Paints of the drone in one world."""
SCENES, HELD_OUT_SCENES, PAIRS = 300, 150, 20
"""In one world: drones to learn from, drones to measure on, and images to find what is no drone in."""
NONE_IN_POOL = 3000
"""Crops without a drone that are kept ready, and renewed a little with every batch."""
NONE_HELD_OUT = 500
"""Crops without a drone to measure on."""


@dataclass(frozen=True)
class Workload:
    """How many worlds are rendered."""

    crops: int
    pairs: int
    held_out: int

    @classmethod
    def of(cls, minutes: float) -> Workload:
        """About a fifth of the minutes on two cores."""
        return cls(
            crops=int(np.clip(0.8 * minutes, 1, 60)),
            pairs=int(np.clip(0.25 * minutes, 1, 15)),
            held_out=int(np.clip(0.2 * minutes, 1, 8)),
        )


def claim_mesh(arguments: argparse.Namespace) -> None:
    """Raises ValueError where the folder for the networks is another drone's."""
    claim(arguments.out, "distance", _drone_of(arguments))


def specialise_range(arguments: argparse.Namespace, drones: list[DroneModel], begin: float) -> None:
    """Render, train, export and measure; ``begin``: when the command began, monotonic."""
    work = arguments.out / "work"
    for path, drone in zip(arguments.mesh, drones, strict=True):
        print(f"{path}: {_colours_of(drone)}", flush=True)
    for line in _rendered(work, drones, Workload.of(arguments.minutes), arguments.processes):
        print(f"{line}, {time.monotonic() - begin:.0f} s", flush=True)
    negatives = _negatives(work / "pairs", work / "negatives.npy")
    held_out = _held_out(work)
    task = DistanceTask(open_pairs(work / "pairs"), negatives, work / "crops")
    task.rate, task.pool_size = RATE, NONE_IN_POOL
    run = work / "run"
    run.mkdir(exist_ok=True)
    if not (run / "start.pt").is_file():
        start(task, data_path("models") / "distance.onnx", arguments.seed)
        torch.save({"net": task.net.state_dict()}, run / "start.pt")
    else:
        task.net.load_state_dict(torch.load(run / "start.pt", map_location="cpu")["net"])
    task.teacher = copy.deepcopy(task.net).eval()
    train(task, run, training_s(arguments.minutes, begin), arguments.seed)
    _write(arguments, held_out)


def _drone_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """By what one drone is told from another."""
    meshes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in arguments.mesh}
    return {"meshes": meshes, "size_m": arguments.size_m, "up": arguments.up}


def _colours_of(drone: DroneModel) -> str:
    plain = np.isnan(drone.colours).any(axis=1).mean()
    if plain == 0:
        return "in its own colours"
    share = "has no colours" if plain == 1 else f"has no colours for {plain:.0%} of its triangles"
    return f"{share}; they are painted at random, part by part"


def own_drone(drones: list[DroneModel], rng: np.random.Generator) -> list[list[DroneModel]]:
    """The only shape that flies in these worlds."""
    return [[painted(drones[k % len(drones)], int(rng.integers(1 << 31))) for k in range(PAINTS)]]


def _rendered(work: Path, drones: list[DroneModel], load: Workload, processes: int) -> Iterator[str]:
    """Training worlds and, to measure on, validation worlds; yields what is done."""
    draw = partial(own_drone, drones)
    seeds = worlds.TRAINING[::-1][: load.crops]
    crops = [CropJob(work / "crops" / f"{seed}.npz", seed, SCENES, draw) for seed in seeds]
    seeds = worlds.VALIDATION[: load.held_out]
    held_out = [
        CropJob(work / "held_out" / f"{seed}.npz", seed, HELD_OUT_SCENES, draw, measures=True) for seed in seeds
    ]
    for done, total in render_crops([*crops, *held_out], processes):
        yield f"{done}/{total} worlds with the drone"
    pairs = [
        PairJob(work / "pairs" / f"part-{i:04d}", worlds.TRAINING[i], PAIRS, worlds.FAMILIES) for i in range(load.pairs)
    ]
    last = PairJob(work / "held_out_pairs" / "part-0000", worlds.VALIDATION[-1], PAIRS, worlds.FAMILIES)
    for done, total in render_pairs([*pairs, last], processes):
        yield f"{done}/{total} worlds for what is no drone"


def _negatives(pairs: Path, file: Path) -> Path:
    """What the first stage takes for drones in the pairs, though it is none."""
    if not file.is_file():
        model = OnnxModel(data_path("models") / "neighbours_int8.yaml", threads=1, check=check_roles)
        np.save(file, mined(open_pairs(pairs), model))
    return file


def _held_out(work: Path) -> HeldOut:
    pairs = open_pairs(work / "held_out_pairs")
    rows = np.load(_negatives(work / "held_out_pairs", work / "held_out_negatives.npy"))
    return HeldOut.of(work / "held_out", _without_drones(pairs, rows))


def _without_drones(pairs: PairSet, rows: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    hard = [rows[k] for k in rng.permutation(len(rows))[: NONE_HELD_OUT // 2]]
    samples = [no_drone_sample(pairs, row, rng) for row in [*hard, *[None] * (NONE_HELD_OUT - len(hard))]]
    return np.stack([sample["picture"] for sample in samples])


def _write(arguments: argparse.Namespace, held_out: HeldOut) -> None:
    """Both networks with what they are worth."""
    out, work = arguments.out, arguments.out / "work"
    general, _ = load_manifest(data_path("models") / "distance.yaml")
    state = torch.load(work / "run" / "checkpoint.pt", map_location="cpu")
    net = DistanceNet()
    net.load_state_dict(state["net"])
    draw_back(net, torch.load(work / "run" / "start.pt", map_location="cpu")["net"])
    meshes = ", ".join(f"{name} (SHA-256 {digest})" for name, digest in _drone_of(arguments)["meshes"].items())
    path = export(
        "distance", net, out,
        thresholds=general.thresholds,
        data=f"Rendered by tools.training.specialise in seeded worlds: {meshes}, "
        f"{arguments.size_m:g} m from tip to tip. Begun with {general.name}, SHA-256 {general.sha256[:12]}.",
        accuracy={},
        command=command_line(state),
    )  # fmt: skip
    twin, _ = quantise(path, work / "crops", out, {})
    manifests = {"before": data_path("models") / "distance.yaml", "after": path, "after, 8-bit": twin}
    figures = {name: measured(manifest, held_out) for name, manifest in manifests.items()}
    for name, manifest in list(manifests.items())[1:]:
        both = {"before": figures["before"], "after": figures[name]}
        note_accuracy(manifest, {f"{when}: {what}": said for when, rows in both.items() for what, said in rows.items()})
    print(table(figures))
    print(f"{len(held_out.picture)} crops of the drone and {len(held_out.none)} without one, of unseen worlds")
    print(f"In the drone's configuration:\n\nperception:\n  distance: {twin.resolve()}")
