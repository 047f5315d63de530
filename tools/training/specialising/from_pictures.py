"""How a fleet's own drone looks, from photographs with labelled boxes: `verification` learns it.

Nobody knows a range in them, so that `distance` learns nothing: its range is right where `perception.drone_size_m` says
the size, which `flockd calibrate drone` measures. What else is in the photographs, and rendered drones, are learnt
along, and the weights are drawn back a third of the way to the general network's: it learnt from far more places.
"""

from __future__ import annotations

import argparse
import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from flockd.core.data import data_path
from flockd.core.messages import UInt8Array
from flockd.flight.inference import OnnxModel, load_manifest
from flockd.flight.perception.requirements import check_roles
from flockd.ground.pictures.coco_labels import check_size, read_labels
from flockd.ground.pictures.picture_files import PictureFile, find_pictures
from flockd.ground.pictures.single_frame import MAX_SIDE_PX, Box
from tools.training import worlds
from tools.training.export import draw_back, export
from tools.training.from_onnx import begin_with_onnx
from tools.training.manifests import note_accuracy
from tools.training.mine_pictures import Miner
from tools.training.networks import VerificationNet
from tools.training.quantise import quantise
from tools.training.real_patches import RealPatches, crop_of_drone, crop_of_negative
from tools.training.render_drone_crops import CropJob, drones_of_training, render_crops
from tools.training.specialising.runs import claim, command_line, table, training_s
from tools.training.train import train
from tools.training.train_verification import VerificationTask

Array = NDArray[Any]
FEWEST_PICTURES = 8
"""With a drone. Fifty and more, from all sides and before all that it flies before, are better."""
HELD_OUT_SHARE = 0.25
"""The last ones by name: neighbouring photographs are alike."""
MIX = {"rendered": 32, "composite": 14, "real drone": 16, "negative": 34}
"""Samples of a batch."""
RATE = 2e-4
SCENES = 300
PLACES = 6
"""Cut from every photograph, anywhere but at the drone."""
CROPS_EACH = 8
"""Crops of every held-out patch."""


@dataclass(frozen=True)
class LabelledPictures:
    """Photographs and the boxes of the drones in them."""

    training: tuple[tuple[PictureFile, tuple[Box, ...]], ...]
    held_out: tuple[tuple[PictureFile, tuple[Box, ...]], ...]
    sha256: str
    """Hash of the label file."""


def read_pictures(arguments: argparse.Namespace) -> LabelledPictures:
    """The labelled ones, parted. Raises FlockdError, or ValueError where they are too few."""
    pictures = [picture for picture in find_pictures([arguments.pictures]) if not picture.is_video]
    labels = read_labels(arguments.labels, pictures)
    for picture, said in labels.items():
        for name, image in picture.images(1):
            check_size(arguments.labels, name, said, (image.shape[1], image.shape[0]))
    named = sorted(((picture, said.boxes) for picture, said in labels.items()), key=lambda one: str(one[0].path))
    with_drone = [one for one in named if one[1]]
    if len(with_drone) < FEWEST_PICTURES:
        raise ValueError(
            f"{arguments.labels}: has {len(with_drone)} pictures with a drone, and {FEWEST_PICTURES} are the fewest to "
            "learn from; label more, from all sides"
        )
    last = round(len(with_drone) * (1 - HELD_OUT_SHARE))
    held_out = {id(one) for one in with_drone[last:]}
    without = [one for one in named if not one[1]]
    held_out |= {id(one) for one in without[round(len(without) * (1 - HELD_OUT_SHARE)) :]}
    return LabelledPictures(
        tuple(one for one in named if id(one) not in held_out),
        tuple(one for one in named if id(one) in held_out),
        hashlib.sha256(arguments.labels.read_bytes()).hexdigest(),
    )


def specialise_verification(arguments: argparse.Namespace, pictures: LabelledPictures, begin: float) -> None:
    """Mine, render, train, export and measure; ``begin``: when the command began, monotonic."""
    work, models = arguments.out / "work", data_path("models")
    for name, part in (("patches", pictures.training), ("held_out", pictures.held_out)):
        _mine(part, work / name / "own.npz")
    seeds = worlds.TRAINING[::-1][: int(np.clip(0.5 * arguments.minutes, 1, 30))]
    jobs = [CropJob(work / "crops" / f"{seed}.npz", seed, SCENES, drones_of_training) for seed in seeds]
    for done, total in render_crops(jobs, arguments.processes):
        print(f"{done}/{total} worlds, {time.monotonic() - begin:.0f} s", flush=True)
    task = VerificationTask(work / "crops", work / "patches", mix=MIX)
    task.rate = RATE
    run = work / "run"
    run.mkdir(exist_ok=True)
    if not (run / "start.pt").is_file():
        batch = task.batch_samples(np.random.default_rng(arguments.seed))
        crops = torch.from_numpy(np.stack([sample["picture"] for sample in batch]))
        begin_with_onnx(task.net, models / "verification.onnx", lambda: task.net(crops))
        torch.save({"net": task.net.state_dict()}, run / "start.pt")
    else:
        task.net.load_state_dict(torch.load(run / "start.pt", map_location="cpu")["net"])
    train(task, run, training_s(arguments.minutes, begin), arguments.seed)
    _write(arguments.out, pictures)


def claim_pictures(arguments: argparse.Namespace, pictures: LabelledPictures) -> None:
    """Raises ValueError where the folder for the networks is another drone's."""
    claim(arguments.out, "verification", {"labels": arguments.labels.name, "sha256": pictures.sha256})


def _mine(part: Sequence[tuple[PictureFile, tuple[Box, ...]]], file: Path) -> None:
    """Patches of the drones, of what the first stage takes for one beside them, and of other places."""
    if file.is_file():
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    miner = Miner(OnnxModel(data_path("models") / "neighbours_int8.yaml", threads=1, check=check_roles))
    for picture, boxes in part:
        for _, image in picture.images(1):
            miner.add(*_shrunk(image, boxes), places=PLACES)
    miner.save(file)
    with np.load(file) as arrays:
        rows = dict(arrays)
    if not len(rows["negative"]):
        # Plain photographs in which nothing else looks like a drone: then anything is what it must not be taken for.
        rows |= {name.replace("place", "negative", 1): rows[name] for name in ("place", "place_half_px", "place_box")}
        np.savez(file, allow_pickle=False, **rows)


def _shrunk(image: UInt8Array, boxes: Sequence[Box]) -> tuple[UInt8Array, list[Box]]:
    """As `flockd detect` takes it: a large photograph is no sharper at its full size."""
    scale = min(1.0, MAX_SIDE_PX / max(image.shape[:2]))
    if scale == 1.0:
        return image, list(boxes)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), [(scale * a, scale * b, scale * c, scale * d) for a, b, c, d in boxes]


def _write(out: Path, pictures: LabelledPictures) -> None:
    work, models = out / "work", data_path("models")
    general, _ = load_manifest(models / "verification.yaml")
    state = torch.load(work / "run" / "checkpoint.pt", map_location="cpu")
    net = VerificationNet()
    net.load_state_dict(state["net"])
    draw_back(net, torch.load(work / "run" / "start.pt", map_location="cpu")["net"])
    path = export(
        "verification", net, out,
        thresholds=general.thresholds,
        data=f"{len(pictures.training)} photographs of one kind of drone (labels with SHA-256 {pictures.sha256}); "
        "rendered by tools.training.render_drone_crops. Begun with "
        f"{general.name}, SHA-256 {general.sha256[:12]}, whose data are: {general.data}",
        accuracy={},
        command=command_line(state),
    )  # fmt: skip
    twin, _ = quantise(path, work / "crops", out, {})
    manifests = {"before": models / "verification.yaml", "after": path, "after, 8-bit": twin}
    drones, none = _held_out(work / "held_out")
    figures = {name: _measured(manifest, drones, none) for name, manifest in manifests.items()}
    for name, manifest in list(manifests.items())[1:]:
        both = {"before": figures["before"], "after": figures[name]}
        note_accuracy(manifest, {f"{when}: {what}": said for when, rows in both.items() for what, said in rows.items()})
    print(table(figures))
    print(f"on {len(pictures.held_out)} photographs that it did not learn from: {len(drones)} and {len(none)} crops")
    print(f"In the drone's configuration:\n\nperception:\n  verification: {twin.resolve()}")
    print("  drone_size_m: ...    # as `flockd calibrate drone` measures it; photographs alone teach no range")


def _held_out(folder: Path) -> tuple[Array, Array]:
    """Crops of the drones, and of what is none."""
    rng = np.random.default_rng(0)
    drones = RealPatches(folder, "drone")
    shown = [crop_of_drone(*drones.at((0, row)), rng)[0] for row in range(drones.count) for _ in range(CROPS_EACH)]
    others = [RealPatches(folder, kind) for kind in ("negative", "place")]
    none = [
        crop_of_negative(*other.at((0, row))[:2], rng)[0]
        for other in others
        for row in range(other.count)
        for _ in range(CROPS_EACH)
    ]
    return np.stack(shown), np.stack(none)


def _measured(manifest: Path, drones: Array, none: Array) -> dict[str, str]:
    model = OnnxModel(manifest, threads=1, check=check_roles)
    (name,) = model.manifest.inputs
    least = model.manifest.threshold("drone_probability")
    shares = []
    for crops in (drones, none):
        logits = np.concatenate([model.run({name: crops[k : k + 64]})["drone"][:, 0] for k in range(0, len(crops), 64)])
        shares.append(float(np.mean(logits > np.log(least / (1 - least)))))
    return {"drones called a drone": f"{shares[0]:.1%}", "crops without a drone called one": f"{shares[1]:.1%}"}
