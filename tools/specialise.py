"""Fine-tune the second stage for a fleet's own drone, within an hour on two cores; flockd's networks stay as they are.

    python -m tools.specialise --mesh MY.glb --size-m 0.55 --out FOLDER

A mesh (glTF, STL or OBJ) becomes drones in rendered training worlds; from them `distance` learns the drone's shape,
and so its range. Writes FOLDER/distance.yaml, FOLDER/distance_int8.yaml and their ONNX files, and prints what each is
worth on worlds that it has not seen, before and after. A stopped run goes on where it was: say the same again.
FOLDER/work holds what was rendered, gigabytes, and may be deleted afterwards.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from flockd.data import data_path
from flockd.inference import OnnxModel, load_manifest
from flockd.perception.requirements import check_roles
from flockd.sim.airframe import DroneModel
from tools.evaluation.on_crops import HeldOut, measured
from tools.export import export
from tools.mine_negatives import mined
from tools.quantise import quantise
from tools.render_drone_crops import CropJob, render_crops
from tools.render_training_data import PairJob, render_pairs
from tools.train import DistanceTask, start, train
from tools.training import worlds
from tools.training.dataset import PairSet, open_pairs
from tools.training.manifests import note_accuracy
from tools.training.networks import DistanceNet
from tools.training.own_mesh import UP_AXES, painted, read_mesh
from tools.training.samples import no_drone_sample

RATE = 8e-4
"""Learning rate to begin with: less than of a network that knows nothing yet."""
PAINTS = 12
"""Of the drone in one world."""
SCENES, HELD_OUT_SCENES, PAIRS = 300, 150, 20
"""In one world: drones to learn from, drones to measure on, and images to find what is no drone in."""
LEAST_TRAINING = 0.3
"""Of the minutes, however long rendering took."""
MEASURING_S = 60.0
"""Kept for export and measurement, at most a tenth of the minutes."""
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


def main() -> None:
    """From a mesh to networks that a configuration can name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--mesh", type=Path, required=True, help="of the drone: .glb, .gltf, .stl or .obj, with propellers"
    )
    parser.add_argument(
        "--size-m", type=float, required=True, help="widest horizontal distance, propeller tip to tip, m"
    )
    parser.add_argument(
        "--up", choices=UP_AXES, help="the mesh's axis that points up: by default y of glTF, z of others"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the networks")
    parser.add_argument("--minutes", type=float, default=50.0, help="for all of it")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="that render")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="that train")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    begin = time.monotonic()
    try:
        drone = read_mesh(arguments.mesh, arguments.size_m, arguments.up)
        _claim(arguments.out, _drone_of(arguments))
    except ValueError as error:
        parser.error(str(error))
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    work = arguments.out / "work"
    for line in _rendered(work, drone, Workload.of(arguments.minutes), arguments.processes):
        print(f"{line}, {time.monotonic() - begin:.0f} s", flush=True)
    negatives = _negatives(work / "pairs", work / "negatives.npy")
    held_out = _held_out(work, drone.size_m)
    task = DistanceTask(open_pairs(work / "pairs"), negatives, work / "crops")
    task.rate, task.pool_size = RATE, NONE_IN_POOL
    general = data_path("models") / "distance.onnx"
    if not (work / "run" / "checkpoint.pt").is_file():
        start(task, general, arguments.seed)
    left_s = 60 * arguments.minutes - (time.monotonic() - begin)
    left_s -= min(MEASURING_S, 6 * arguments.minutes)
    (work / "run").mkdir(exist_ok=True)
    train(task, work / "run", max(left_s, 60 * LEAST_TRAINING * arguments.minutes), arguments.seed)
    _write(arguments, drone, held_out)


def _drone_of(arguments: argparse.Namespace) -> dict[str, object]:
    """By what one drone is told from another."""
    digest = hashlib.sha256(arguments.mesh.read_bytes()).hexdigest()
    return {"mesh": arguments.mesh.name, "sha256": digest, "size_m": arguments.size_m, "up": arguments.up}


def _claim(out: Path, drone: dict[str, object]) -> None:
    """Raises ValueError where the folder holds networks already, or another drone's work."""
    if (out / "distance.yaml").exists():
        raise ValueError(f"--out {out}: holds a distance network already; name another folder, or delete that one")
    note = out / "work" / "drone.json"
    if note.is_file() and json.loads(note.read_text(encoding="utf-8")) != drone:
        raise ValueError(f"--out {out}: holds what was rendered of another drone or size; name another folder")
    note.parent.mkdir(parents=True, exist_ok=True)
    note.write_text(json.dumps(drone, indent=1), encoding="utf-8")


def own_drone(drone: DroneModel, rng: np.random.Generator) -> list[list[DroneModel]]:
    """The only shape that flies in these worlds."""
    return [[painted(drone, int(rng.integers(1 << 31))) for _ in range(PAINTS)]]


def _rendered(work: Path, drone: DroneModel, load: Workload, processes: int) -> Iterator[str]:
    """Training worlds and, to measure on, validation worlds; yields what is done."""
    draw = partial(own_drone, drone)
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


def _held_out(work: Path, size_m: float) -> HeldOut:
    pairs = open_pairs(work / "held_out_pairs")
    rows = np.load(_negatives(work / "held_out_pairs", work / "held_out_negatives.npy"))
    return HeldOut.of(work / "held_out", _without_drones(pairs, rows), size_m)


def _without_drones(pairs: PairSet, rows: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    hard = [rows[k] for k in rng.permutation(len(rows))[: NONE_HELD_OUT // 2]]
    samples = [no_drone_sample(pairs, row, rng) for row in [*hard, *[None] * (NONE_HELD_OUT - len(hard))]]
    return np.stack([sample["picture"] for sample in samples])


def _write(arguments: argparse.Namespace, drone: DroneModel, held_out: HeldOut) -> None:
    """Both networks with what they are worth."""
    out, work = arguments.out, arguments.out / "work"
    general, _ = load_manifest(data_path("models") / "distance.yaml")
    state = torch.load(work / "run" / "checkpoint.pt", map_location="cpu")
    net = DistanceNet()
    net.load_state_dict(state["net"])
    mesh = _drone_of(arguments)
    path = export(
        "distance", net, out,
        thresholds=general.thresholds,
        data=f"Rendered by tools.specialise in seeded worlds: {mesh['mesh']} (SHA-256 {mesh['sha256']}), "
        f"{drone.size_m:g} m from tip to tip. Begun with {general.name}, SHA-256 {general.sha256[:12]}.",
        accuracy={},
        command=f"tools.specialise {shlex.join(sys.argv[1:])} ({state['spent'] / 60:.0f} min, {state['step']} steps)",
    )  # fmt: skip
    twin, _ = quantise(path, work / "crops", out, {})
    manifests = {"before": data_path("models") / "distance.yaml", "after": path, "after, 8-bit": twin}
    figures = {name: measured(manifest, held_out) for name, manifest in manifests.items()}
    for name, manifest in list(manifests.items())[1:]:
        both = {"before": figures["before"], "after": figures[name]}
        note_accuracy(manifest, {f"{when}: {what}": said for when, rows in both.items() for what, said in rows.items()})
    print(_table(figures))
    print(f"{len(held_out.picture)} crops of the drone and {len(held_out.none)} without one, of unseen worlds")
    print(f"In the drone's configuration:\n\nperception:\n  distance: {twin.resolve()}")


def _table(figures: dict[str, dict[str, str]]) -> str:
    """One row a figure."""
    names = list(next(iter(figures.values())))
    rows = [["", *figures], *[[name, *(column[name] for column in figures.values())] for name in names]]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


if __name__ == "__main__":
    main()
