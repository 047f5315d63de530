"""Find false proposals of the first stage, or of the detector: negatives for training.

    python -m tools.training.mine DATA --model models/neighbours_int8.yaml

Writes DATA/worlds/negatives.npy, and `proposals.jsonl` into DATA/photographs and every folder of DATA/labelled.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel
from flockd.flight.perception.detection.boxes import BoxRules, kept_boxes, probable_boxes
from flockd.flight.perception.detection.instances import group_instances
from tools.training.dataset import PairSet, ground_plane, open_pairs, ray_tangents
from tools.training.pictures import PROPOSALS, pictures_in, read

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""
BESIDE_PX = 25.0
"""A proposal so near to a drone's box may be part of it."""


def main() -> None:
    """Mine every folder that is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", type=Path, required=True, help="manifest of a neighbours network or of a detector")
    arguments = parser.parse_args()
    model, data = OnnxModel(arguments.model, threads=1), arguments.data
    if (data / "worlds").is_dir():
        found = mined(open_pairs(data / "worlds"), model)
        np.save(data / "worlds" / "negatives.npy", found)
        print(f"{data / 'worlds'}: {len(found)}", flush=True)
    if (data / "photographs").is_dir():
        _mine_pictures(data / "photographs", model)
    for folder in sorted((data / "labelled").glob("*/")):
        _mine_pictures(folder, model)


def mined(pairs: PairSet, model: OnnxModel) -> NDArray[np.float32]:
    """(n, 5) of the pairs' first images: pair, image, centre right and down, half of the box's longer side; pixels."""
    found = []
    for pair in range(pairs.count):
        focal = float(pairs["focal"][pair])
        ground = ground_plane(focal, pairs["R_ned_camera"][pair, 0], float(pairs["height"][pair, 0]))
        planes = np.concatenate([ray_tangents(focal), ground[None]])
        drones = pairs["drone_box"][pair, 0][pairs["drone_pixels"][pair, 0] > 0].tolist()
        for left, top, right, bottom in proposed(model, np.asarray(pairs["image"][pair][0]), drones, planes):
            half = max(right - left, bottom - top) / 2
            found.append((pair, 0, (left + right) / 2, (top + bottom) / 2, half))
    return np.array(found, np.float32).reshape(-1, 5)


def _mine_pictures(folder: Path, model: OnnxModel) -> None:
    lines, count = [], 0
    for name, category, boxes in pictures_in(folder):
        drones = [box for kind, *box in boxes if kind == "drone"]
        image = read(folder / name)
        image = np.ascontiguousarray(image[: image.shape[0] // 32 * 32, : image.shape[1] // 32 * 32])
        found = proposed(model, image, drones)
        lines.append(json.dumps({"file": name, "category": category, "boxes": found}) + "\n")
        count += len(found)
    (folder / PROPOSALS).write_text("".join(lines), encoding="utf-8")
    print(f"{folder}: {count} in {len(lines)} pictures", flush=True)


def proposed(
    model: OnnxModel,
    image: NDArray[np.uint8],
    drones: Sequence[Sequence[float]],
    planes: NDArray[np.float32] | None = None,
) -> list[Box]:
    """Proposed boxes in an RGB image (h, w, 3), sides multiples of 32, away from its ``drones``.

    ``planes`` (3, h/2, w/2) of a neighbours network; by default of a camera of 90 degrees at a height unknown.
    """
    manifest = model.manifest
    if "boxes" in manifest.results:
        rules = BoxRules.of(manifest)
        columns = manifest.results["boxes"].by_column(model.run({"image": image[None]})["boxes"])
        boxes, _ = kept_boxes(*probable_boxes(columns, rules, (1.0, 1.0)), rules)
    else:
        if planes is None:
            height, width = (side // 2 for side in image.shape[:2])
            v, u = np.mgrid[0.5:height, 0.5:width].astype(np.float32)
            planes = np.stack([(u - width / 2) / (width / 2), (v - height / 2) / (width / 2), np.zeros_like(u)])
        out = model.run({"image": image[None], "geometry": planes[None]})
        logit = out["drone"][0, 0] - np.float32(manifest.thresholds["proposal_logit"])
        boxes = np.array(
            [one.box for one in group_instances(logit, out["offset"][0], scale=manifest.map_stride or 1)[1]]
        )
    of_all = [(float(left), float(top), float(right), float(bottom)) for left, top, right, bottom in boxes]
    return [box for box in of_all if all(_gap(box, drone) > BESIDE_PX for drone in drones)]


def _gap(a: Sequence[float], b: Sequence[float]) -> float:
    """Pixels between two boxes; 0 where they touch."""
    right, down = max(a[0] - b[2], b[0] - a[2], 0.0), max(a[1] - b[3], b[1] - a[3], 0.0)
    return math.hypot(right, down)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
