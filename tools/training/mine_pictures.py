"""Cut from real pictures what the first stage takes for drones though there are none, and places all over them.

    python -m tools.training.mine_pictures OUT --crops FOLDER --skydrones FOLDER --pairs PAIRS \\
        --model models/neighbours_int8.yaml

Every folder in FOLDER is one source of pictures without drones: its proposals become negatives, and other places
backgrounds for composites. SKYDRONES adds the training clips of `skydrones`: what is proposed beside the drones, or
where there are only birds and aircraft, as negatives, and the drones themselves. PAIRS, a folder of
tools.training.render_training_data, adds what is proposed beside rendered drones. Writes one OUT/SOURCE.npz each.
A patch shows more than the second stage's crop, so that training can aim at it in many ways.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.geometry import PinholeCamera, Rig, RigCamera, RigidTransform, virtual_crop
from flockd.flight.inference import OnnxModel
from flockd.flight.perception import group_instances
from flockd.flight.perception.detection.boxes import BoxRules, kept_boxes, probable_boxes
from tools.training.dataset import open_pairs
from tools.training.real_patches import PATCH_PX, PATCH_REACH
from tools.training.skydrones import SPLITS, split_of

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""
EAGER_LOGIT = -1.5
"""The pipeline proposes from this logit up."""
FIRST_MARGIN = 0.95
"""Half the pipeline's first crop, as a share of the way from its middle to the proposal's farthest corner."""
MOST_PROPOSALS, PLACES = 10, 6
"""In one picture."""
FRAMES_A_CLIP = 40
FOLLOW_STEP, FOLLOW_STEPS = 3, 4
"""A labelled drone is followed to so many further frames before and after, each so many frames on."""
SEARCH_PX, LEAST_CONTRAST, MOST_GROWTH = 12.0, 12.0, 1.4
"""Around a drone's last box; grey levels; and the most that its width changes to the next frame that is taken."""
BESIDE_PX = 25.0
"""A proposal so near to a drone's box may be part of it."""
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
ENDINGS = {".jpg", ".jpeg", ".png"}


class Miner:
    """Collects the patches of one source."""

    def __init__(self, model: OnnxModel, seed: int = 0) -> None:
        self._model = model
        self._rng = np.random.default_rng(seed)
        self._rows: dict[str, list[dict[str, Any]]] = {"negative": [], "place": [], "drone": []}
        self.pictures, self.proposals = 0, 0

    def add(self, image: Image, boxes: list[Box], *, places: int = PLACES, keeps_drones: bool = True) -> None:
        """An RGB image (h, w, 3) and the drones in it; sizes are cut to multiples of 32."""
        image = image[: image.shape[0] // 32 * 32, : image.shape[1] // 32 * 32]
        height, width = image.shape[:2]
        rig = _rig(width, height)
        proposals = self._proposed(image)
        self.pictures += 1
        self.proposals += len(proposals)
        free = [box for box in proposals if all(_gap(box, other) > BESIDE_PX for other in boxes)]
        for k in self._rng.permutation(len(free))[:MOST_PROPOSALS]:
            self._cut("negative", rig, image, free[k])
        for box in boxes if keeps_drones else ():
            self._cut("drone", rig, image, box)
        for _ in range(places):
            half = float(np.exp(self._rng.uniform(math.log(5.0), math.log(300.0))))
            u, v = self._rng.uniform(0, width), self._rng.uniform(0, height)
            place = (u - half, v - half * 0.5, u + half, v + half * 0.5)
            if all(_gap(place, other) > 0 for other in boxes):
                self._cut("place", rig, image, place)

    def save(self, path: Path) -> None:
        """All that was collected."""
        arrays: dict[str, NDArray[Any]] = {}
        for kind, rows in self._rows.items():
            arrays[kind] = np.array([row["patch"] for row in rows], np.uint8).reshape(-1, PATCH_PX, PATCH_PX, 3)
            arrays[f"{kind}_half_px"] = np.array([row["half_px"] for row in rows], np.float32)
            arrays[f"{kind}_box"] = np.array([row["box"] for row in rows], np.float32).reshape(-1, 4)
        np.savez(path, allow_pickle=False, **arrays)

    def _proposed(self, image: Image) -> list[Box]:
        if "boxes" in self._model.manifest.results:
            rules = BoxRules.of(self._model.manifest)
            columns = self._model.manifest.results["boxes"].by_column(self._model.run({"image": image[None]})["boxes"])
            boxes, _ = kept_boxes(*probable_boxes(columns, rules, (1.0, 1.0)), rules)
            return [tuple(float(x) for x in box) for box in boxes]  # type: ignore[misc]
        height, width = image.shape[:2]
        focal = width / 2
        u = (np.arange(width // 2) * 2 + 1 - width / 2) / focal
        v = (np.arange(height // 2) * 2 + 1 - height / 2) / focal
        planes = np.stack([*np.broadcast_arrays(u[None, :], v[:, None]), np.zeros((height // 2, width // 2))])
        out = self._model.run({"image": image[None], "geometry": planes[None].astype(np.float32)})
        _, instances = group_instances(out["drone"][0, 0] - np.float32(EAGER_LOGIT), out["offset"][0], scale=2)
        return [tuple(float(x) for x in one.box) for one in instances]  # type: ignore[misc]

    def _cut(self, kind: str, rig: Rig, image: Image, box: Box) -> None:
        """``box`` in the patch's own pixels goes with it, and half of the pipeline's first crop in camera pixels."""
        camera = rig.cameras["camera"].camera
        left, top, right, bottom = box
        corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom]])
        middle = np.clip((corners[0] + corners[3]) / 2, 1.0, np.array(camera.size) - 1.0)
        rays = camera.rays(np.vstack([corners, middle]))
        reach = float(np.arccos(np.clip(rays[:4] @ rays[4], -1, 1)).max())
        half_angle = float(np.clip(FIRST_MARGIN * reach, math.radians(0.5), math.radians(35)))
        wide = math.atan(PATCH_REACH * math.tan(half_angle))
        crop = virtual_crop(rig, R_BODY_CAMERA @ rays[4], wide, PATCH_PX)
        patch, _ = crop.sample({"camera": image})
        seen = crop.camera.project(rays[:4] @ R_BODY_CAMERA.T @ crop.T_body_virtual.rotation)
        self._rows[kind].append(
            {
                "patch": patch,
                "half_px": camera.focal_px * math.tan(half_angle),
                "box": (*seen.min(0), *seen.max(0)),
            }
        )


def main() -> None:
    """One file a source."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--crops", type=Path)
    parser.add_argument("--skydrones", type=Path)
    parser.add_argument("--pairs", type=Path, help="rendered pairs")
    parser.add_argument("--split", choices=SPLITS, default="training", help="of the clips")
    parser.add_argument("--model", type=Path, required=True, help="manifest of a neighbours network or of a detector")
    parser.add_argument("--most", type=int, default=100_000, help="pictures of one source")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    model = OnnxModel(arguments.model, threads=1)
    if arguments.skydrones:
        _mine_clips(arguments.skydrones, arguments.split, model, arguments.out)
    if arguments.pairs:
        _mine_pairs(arguments.pairs, model, arguments.out / "rendered.npz")
    for folder in sorted(one for one in arguments.crops.iterdir() if one.is_dir()) if arguments.crops else []:
        target = arguments.out / f"{folder.name}.npz"
        if target.is_file():
            continue
        paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in ENDINGS)
        step = max(1, math.ceil(len(paths) / arguments.most))
        miner = Miner(model)
        for path in paths[::step]:
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is not None:
                miner.add(np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8), [])
        _finish(miner, target)


def _mine_pairs(folder: Path, model: OnnxModel, target: Path) -> None:
    """What is proposed beside the drones of rendered images; their own crops are those of
    tools.training.render_drone_crops."""
    pairs, miner = open_pairs(folder), Miner(model)
    for pair in range(pairs.count):
        for k in range(2):
            seen = pairs["drone_pixels"][pair, k] > 0
            boxes = [tuple(float(x) for x in box) for box in pairs["drone_box"][pair, k][seen]]
            miner.add(np.asarray(pairs["image"][pair][k]), boxes, places=0, keeps_drones=False)  # type: ignore[arg-type]
    _finish(miner, target)


def _mine_clips(folder: Path, split: str, model: OnnxModel, out: Path) -> None:
    by_clip: dict[str, list[dict[str, Any]]] = {}
    for label in json.loads((folder / "labels.json").read_text(encoding="utf-8")):
        if split_of(label["clip"]) == split:
            by_clip.setdefault(label["clip"], []).append(label)
    miners = {"skydrones": Miner(model), "skyothers": Miner(model)}
    for clip, labels in sorted(by_clip.items()):
        images = _images(folder / "clips" / clip)
        if labels[0]["object"] == "drone":
            boxes = {label["frame"]: tuple(label["box"]) for label in labels if label["box"]}
            for number, box in followed(images, boxes).items():
                miners["skydrones"].add(images[number], [box], places=1)
        else:
            for number in np.unique(np.linspace(2, max(len(images) - 3, 2), FRAMES_A_CLIP).astype(int)):
                miners["skyothers"].add(images[number], [], places=1)
    for name, miner in miners.items():
        _finish(miner, out / f"{name}.npz")


def _images(clip: Path) -> list[Image]:
    """All of a clip, RGB."""
    capture = cv2.VideoCapture(str(clip))
    images: list[Image] = []
    while True:
        is_read, image = capture.read()
        if not is_read:
            return images
        images.append(np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8))


def followed(images: Sequence[Image], boxes: Mapping[int, Box]) -> dict[int, Box]:
    """The labelled boxes, and those of the same drones some frames before and after, by the number of the image."""
    every = dict(boxes)
    for start, first in boxes.items():
        for way in (-FOLLOW_STEP, FOLLOW_STEP):
            box = first
            for number in range(start + way, start + way * FOLLOW_STEPS + (1 if way > 0 else -1), way):
                found = found_again(images[number], box) if 0 <= number < len(images) else None
                if found is None:
                    break
                box = every.setdefault(number, found)
    return every


def found_again(image: Image, box: Box) -> Box | None:
    """The box of what differs from the sky about where ``box`` was, or None where it is not about as large as that.

    Boxes are left, top, right, bottom in pixels; the image is (h, w, 3).
    """
    left, top, right, bottom = box
    margin = max(SEARCH_PX, 0.6 * max(right - left, bottom - top))
    u, v = max(0, round(left - margin)), max(0, round(top - margin))
    window = image[v : round(bottom + margin), u : round(right + margin)].astype(np.float32)
    if min(window.shape[:2]) < 3:
        return None
    rim = np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]])
    sky = np.median(rim, axis=0)
    difference = np.abs(window - sky).max(2)
    least = max(LEAST_CONTRAST, 3.0 * float(np.abs(rim - sky).max(1).mean()), 0.25 * float(difference.max()))
    _, _, stats, middles = cv2.connectedComponentsWithStats((difference > least).astype(np.uint8), connectivity=8)
    if len(stats) < 2:
        return None
    away = middles[1:] + np.array([u - (left + right) / 2, v - (top + bottom) / 2])
    one = 1 + int(np.argmin(np.linalg.norm(away, axis=1)))
    x, y, wide, high = (int(value) for value in stats[one, :4])
    touches = x == 0 or y == 0 or x + wide == window.shape[1] or y + high == window.shape[0]
    growth = wide / max(right - left, 1.0)
    if touches or not 1 / MOST_GROWTH < growth < MOST_GROWTH or high > 2 * max(bottom - top, 3.0):
        return None
    return float(u + x), float(v + y), float(u + x + wide), float(v + y + high)


def _finish(miner: Miner, path: Path) -> None:
    miner.save(path)
    print(
        f"{path}: {miner.pictures} pictures, {miner.proposals / max(miner.pictures, 1):.1f} proposals each", flush=True
    )


def _rig(width: int, height: int) -> Rig:
    """A camera of 90 degrees, looking forward."""
    matrix = np.array([[width / 2, 0.0, width / 2], [0.0, width / 2, height / 2], [0.0, 0.0, 1.0]])
    camera = PinholeCamera(matrix, (width, height))
    return Rig({"camera": RigCamera("camera", camera, RigidTransform(R_BODY_CAMERA, np.zeros(3)))})


def _gap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Pixels between two boxes; 0 where they touch."""
    right, down = max(a[0] - b[2], b[0] - a[2], 0.0), max(a[1] - b[3], b[1] - a[3], 0.0)
    return math.hypot(right, down)


if __name__ == "__main__":
    main()
