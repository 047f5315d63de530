"""Pictures for training: rendered drones before photographs, real drones, rendered worlds, pictures without drones."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from tools.training import worlds
from tools.training.camera_effects import as_filmed, drawn_effects, through_camera
from tools.training.dataset import MAX_FAMILIES, PairSet
from tools.training.samples import Sample

Image = NDArray[np.uint8]
One = TypeVar("One")
Boxes = NDArray[np.float32]
Named = tuple[str, float, float, float, float]
"""Name of an object, and left, top, right, bottom in pixels."""
CLASSES = ("drone", "bird", "airplane", "helicopter")
NO_BOX, NOT_JUDGED = -1, -2
"""Class of an unused box, and of a box in which the objectness is not learnt."""
PROPOSALS = "proposals.jsonl"
MOST_BOXES = 10
LEAST_WIDTH_PX = 5.0
"""Least width of a drone that is learnt; a smaller one is `NOT_JUDGED`."""
LEAST_SEEN = 0.35
"""Share of a drone's pixels that has to be visible; else it is `NOT_JUDGED`."""
_SOLID = 64
"""Least alpha of a pixel that belongs to a drone's box: the discs of propellers are fainter."""
_SCALES = (0.35, 1.4)
"""Factors by which a photograph is resized, unless it would not fill the picture then."""
_IN_MEMORY = 6000
_AIMED_SHARE = 0.6
"""Least share of the drones that are in the middle and fill their crop, as in the cascade's last crop."""
_NONE_SHARE = 0.08
"""Share of the samples without a drone, however many families there are."""
_AIMED_OFF_PX, _AIMED_PX = 4.0, (60.0, 84.0)


@dataclass(frozen=True)
class Scene:
    """A picture and its boxes."""

    image: Image
    """(s, s, 3) RGB"""
    boxes: Boxes
    """(n, 4) left, top, right, bottom, pixels."""
    classes: tuple[int, ...]
    """Of each box, as in `CLASSES`, or `NOT_JUDGED`."""


class Cutouts:
    """Rendered drones with transparent surroundings (`render_drone_crops --cut-out`)."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._names = [json.loads(line)["file"] for line in (folder / "index.jsonl").read_text().splitlines()]
        self._kept: dict[str, Image] = {}

    def draw(self, rng: Generator) -> Image:
        """(h, w, 4) RGBA, alpha straight, cut to its solid pixels."""
        name = self._names[int(rng.integers(len(self._names)))]
        if name not in self._kept:
            image = np.asarray(cv2.imread(str(self._folder / name), cv2.IMREAD_UNCHANGED), np.uint8)[..., [2, 1, 0, 3]]
            rows, columns = (np.flatnonzero((image[..., 3] > 8).any(axis)) for axis in (1, 0))
            cut: Image = np.ascontiguousarray(image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], np.uint8)
            if len(self._kept) >= _IN_MEMORY:
                return cut
            self._kept[name] = cut
        return self._kept[name]


def pictures_in(folder: Path) -> list[tuple[str, str, list[Named]]]:
    """File, category and boxes of each picture of a folder: with ``labels.json`` in COCO's format, or else with
    ``index.jsonl``, a line a picture: ``file``, ``category``, and ``boxes`` of what flies in it."""
    if not (folder / "labels.json").is_file():
        lines = [json.loads(line) for line in (folder / "index.jsonl").read_text(encoding="utf-8").splitlines()]
        return [(one["file"], one["category"], [tuple(box) for box in one.get("boxes", ())]) for one in lines]
    coco = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
    names = {one["id"]: one["name"] for one in coco["categories"]}
    boxes: dict[int, list[Named]] = defaultdict(list)
    for one in coco["annotations"]:
        left, top, width, height = one["bbox"]
        boxes[one["image_id"]].append((names[one["category_id"]], left, top, left + width, top + height))
    return [(one["file_name"], folder.name, boxes[one["id"]]) for one in coco["images"]]


class _ByCategory(Generic[One]):
    """Draws of categories, each in proportion to the square root of its size."""

    def __init__(self, things: Iterable[tuple[str, One]]) -> None:
        by_category = defaultdict[str, list[One]](list)
        for category, one in things:
            by_category[category].append(one)
        self._groups = list(by_category.values())
        roots = np.sqrt([len(ones) for ones in self._groups])
        self._shares = roots / roots.sum()

    def draw(self, rng: Generator) -> One:
        """Any of them."""
        ones = self._groups[int(rng.choice(len(self._shares), p=self._shares))]
        return ones[int(rng.integers(len(ones)))]


class Photographs:
    """Photographs without drones, of each category in proportion to the square root of its size."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pictures = _ByCategory((category, (name, boxes)) for name, category, boxes in pictures_in(folder))

    def draw_whole(self, rng: Generator) -> tuple[Image, list[Named]]:
        """One of them, and the boxes of the flying objects in it."""
        name, boxes = self._pictures.draw(rng)
        return read(self._folder / name), boxes

    def draw(self, size: int, rng: Generator) -> Scene:
        """A part of one, ``size`` pixels wide and high."""
        return part_of(*self.draw_whole(rng), size, _SCALES, rng)


class Proposals:
    """False proposals of `tools.training.mine`, of each category in proportion to the square root of its size."""

    def __init__(self, folders: Sequence[Path]) -> None:
        found: list[tuple[str, tuple[Path, tuple[float, ...]]]] = []
        for folder in folders:
            if not (folder / PROPOSALS).is_file():
                raise FileNotFoundError(f"{folder}: has no {PROPOSALS}; make it with `python -m tools.training.mine`")
            for line in (folder / PROPOSALS).read_text(encoding="utf-8").splitlines():
                one = json.loads(line)
                found += [(one["category"], (folder / one["file"], tuple(box))) for box in one["boxes"]]
        if not found:
            raise ValueError(f"{', '.join(map(str, folders))}: nothing was proposed in these pictures")
        self._found = _ByCategory(found)

    def draw(self, rng: Generator) -> tuple[Image, tuple[float, ...]]:
        """The picture of a proposal, and its box."""
        path, box = self._found.draw(rng)
        return read(path), box


class Labelled:
    """Real pictures with boxes (`pictures_in`); those without a box are left out."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pictures = [(name, boxes) for name, _, boxes in pictures_in(folder) if boxes]
        self._drones = [(name, box) for name, boxes in self._pictures for kind, *box in boxes if kind == CLASSES[0]]

    @property
    def drones(self) -> int:
        """Number of labelled drones."""
        return len(self._drones)

    def draw_drone(self, rng: Generator) -> tuple[Image, tuple[float, ...]]:
        """A picture, and the box of a drone in it."""
        name, box = self._drones[int(rng.integers(len(self._drones)))]
        return read(self._folder / name), tuple(box)

    def draw(self, size: int, rng: Generator) -> Scene:
        """A part of a picture, ``size`` pixels wide and high, around one of the boxes."""
        name, boxes = self._pictures[int(rng.integers(len(self._pictures)))]
        _, left, top, right, bottom = boxes[int(rng.integers(len(boxes)))]
        least = min(max(0.5, (LEAST_WIDTH_PX + 1) / max(right - left, 1.0)), 1.0)
        aim = ((left + right) / 2, (top + bottom) / 2)
        return part_of(read(self._folder / name), boxes, size, (least, 2.0), rng, aim)


class Worlds:
    """flockd's own rendered worlds."""

    def __init__(self, pairs: PairSet) -> None:
        self._pairs = pairs

    def draw(self, size: int, rng: Generator) -> Scene:
        """A part of a picture of the camera's size, around a drone where there is one."""
        pairs, k = self._pairs, int(rng.integers(2))
        index = int(rng.integers(pairs.count))
        seen = pairs["drone_pixels"][index, k]
        boxes = [
            ("drone" if seen[d] >= 20 else "", *pairs["drone_box"][index, k, d].tolist()) for d in np.flatnonzero(seen)
        ]
        aim = None
        if boxes and rng.random() < 0.8:
            _, left, top, right, bottom = boxes[int(rng.integers(len(boxes)))]
            aim = ((left + right) / 2, (top + bottom) / 2)
        return part_of(pairs["image"][index][k], boxes, size, (0.8, 1.3), rng, aim)


class CropFiles:
    """Every sample of every file of ``render_drone_crops``, in memory."""

    def __init__(self, folder: Path) -> None:
        files: list[Sample] = []
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as arrays:
                files.append(dict(arrays))
        if not files:
            raise FileNotFoundError(
                f"{folder}: no crops here; make them with `python -m tools.training.render_drone_crops`"
            )
        self._samples = {name: np.concatenate([file[name] for file in files]) for name in files[0]}
        family = np.where(self._samples["drone"] > 0.5, self._samples["family"], -1)
        aimed, names = is_aimed(self._samples), np.unique(family)
        probability = np.zeros(len(family))
        for name, share in zip(names, _shares_of(names), strict=True):
            mine = family == name
            centred = mine & aimed if (mine & aimed).any() else mine
            for chosen, part in ((mine, 1 - _AIMED_SHARE), (centred, _AIMED_SHARE)):
                probability[chosen] += share * part / np.count_nonzero(chosen)
        self._up_to = np.cumsum(probability) / probability.sum()

    def draw(self, rng: Generator) -> Sample:
        """One of them, sometimes without a drone. Families are equally frequent, however many crops they have; so are
        shapes, and together they are ``worlds.SHAPES_SHARE`` of the drones."""
        row = int(np.searchsorted(self._up_to, rng.random(), side="right"))
        return {name: values[row] for name, values in self._samples.items()}


def _shares_of(names: NDArray[np.int64]) -> NDArray[np.float64]:
    """Frequency of each family, not scaled; -1: no drone, from ``MAX_FAMILIES`` on: shapes."""
    is_none, is_family = names == -1, (names >= 0) & (names < MAX_FAMILIES)
    shares = np.zeros(len(names))
    for which, of in ((is_family, 1 - worlds.SHAPES_SHARE), (~(is_none | is_family), worlds.SHAPES_SHARE)):
        shares[which] = of / max(1, int(np.count_nonzero(which)))
    shares[is_none] = _NONE_SHARE / (1 - _NONE_SHARE) * shares.sum() if shares.any() else 1.0
    return shares


def is_aimed(file: Sample) -> NDArray[np.bool_]:
    """(n,) which crops of a file show their drone as a cascade's last crop does: in the middle, and filling it."""
    low, high = np.log(_AIMED_PX)
    off = np.linalg.norm(file["target"][:, 1:3], axis=1)
    return np.asarray((off < _AIMED_OFF_PX) & (low < file["apparent"]) & (file["apparent"] < high))


def part_of(
    image: Image,
    boxes: Any,
    size: int,
    scales: tuple[float, float],
    rng: Generator,
    aim: tuple[float, float] | None = None,
) -> Scene:
    """A resized square part of a picture, anywhere or with the pixel ``aim`` in it.

    ``boxes``: name, left, top, right, bottom of each; one whose name is not in `CLASSES` is `NOT_JUDGED`.
    """
    height, width = image.shape[:2]
    drawn = math.exp(rng.uniform(*np.log(scales)))
    scale = max(drawn, size / width, size / height)
    side = min(round(size / scale), width, height)
    corner = rng.uniform(0, 1, 2) * (width - side, height - side)
    if aim is not None:
        corner = np.clip(np.array(aim) - rng.uniform(0.1, 0.9, 2) * side, 0, (width - side, height - side))
    left, top = corner.astype(int)
    cut = np.ascontiguousarray(image[top : top + side, left : left + side])
    method = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
    resized = cv2.resize(cut, (size, size), interpolation=method)
    factor, kept, classes = size / side, [], []
    for name, *box in boxes:
        whole = (np.array(box) - (left, top, left, top)) * factor
        inside = np.clip(whole, 0, size)
        if (inside[2:] - inside[:2]).min() < 2:
            continue
        share = np.prod(inside[2:] - inside[:2]) / np.prod(whole[2:] - whole[:2])
        good = name in CLASSES and share > LEAST_SEEN and inside[2] - inside[0] >= LEAST_WIDTH_PX
        kept.append(inside)
        classes.append(CLASSES.index(name) if good else NOT_JUDGED)
    return Scene(np.asarray(resized, np.uint8), np.array(kept, np.float32).reshape(-1, 4), tuple(classes))


def with_drones(scene: Scene, cutouts: Cutouts, rng: Generator) -> Scene:
    """The scene with one to four more drones, of any width, some near each other, cut off or partly hidden."""
    image, size = scene.image.astype(np.float32), scene.image.shape[0]
    boxes, classes = list(scene.boxes), list(scene.classes)
    near: tuple[float, float, float] | None = None
    for _ in range(int(rng.choice([1, 2, 3, 4], p=[0.55, 0.25, 0.12, 0.08]))):
        width = math.exp(rng.uniform(math.log(6.0), math.log(0.95 * size)))
        if rng.random() < 0.1:
            width = rng.uniform(0.5, 1.8) * size
        middle = rng.uniform(0, size, 2)
        if near is not None and rng.random() < 0.3:
            width = near[2] * math.exp(rng.normal(0, 0.35))
            middle = np.array(near[:2]) + rng.normal(0, 1.0, 2) * near[2]
        box, share = paste(image, looked_at(cutouts.draw(rng), width, rng), middle, rng)
        if box is None:
            continue
        near = (float(middle[0]), float(middle[1]), width)
        good = share > LEAST_SEEN and box[2] - box[0] >= LEAST_WIDTH_PX
        hidden = [k for k, other in enumerate(boxes) if _covered(other, box) > 1 - LEAST_SEEN]
        for k in hidden:
            classes[k] = NOT_JUDGED
        boxes.append(box)
        classes.append(0 if good else NOT_JUDGED)
    pasted = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return Scene(pasted, np.array(boxes, np.float32).reshape(-1, 4), tuple(classes))


def looked_at(cutout: Image, width: float, rng: Generator) -> NDArray[np.float32]:
    """The cut-out (h, w, 4), premultiplied, 0-255, at a width in pixels, with another rotation, light and tint."""
    if rng.random() < 0.5:
        cutout = np.ascontiguousarray(cutout[:, ::-1])
    colour: NDArray[Any] = cutout[..., :3].astype(np.float32)
    alpha = cutout[..., 3:].astype(np.float32) / 255.0
    gain = math.exp(rng.normal(0, 0.25)) * np.exp(rng.normal(0, 0.05, 3))
    colour = 255.0 * np.clip(colour * gain / 255.0, 0, 1) ** math.exp(rng.normal(0, 0.2))
    both: NDArray[Any] = np.concatenate([colour * alpha, 255.0 * alpha], 2).astype(np.float32)
    height, across = both.shape[:2]
    scale, angle = width / across, rng.normal(0, 10.0)
    while scale < 0.5 and min(both.shape[:2]) > 1:  # so that nothing is skipped when it is shrunk
        both = cv2.resize(both, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        scale = width / both.shape[1]
    height, across = both.shape[:2]
    turn = cv2.getRotationMatrix2D((across / 2, height / 2), angle, scale)
    cos, sin = abs(turn[0, 0]), abs(turn[0, 1])
    out = (math.ceil(across * cos + height * sin) + 2, math.ceil(across * sin + height * cos) + 2)
    turn[:, 2] += np.array(out) / 2 - (across / 2, height / 2)
    return np.asarray(cv2.warpAffine(both, turn, out, flags=cv2.INTER_LINEAR), np.float32)


def paste(
    image: NDArray[np.float32], drone: NDArray[np.float32], middle: NDArray[np.float64], rng: Generator
) -> tuple[NDArray[np.float32] | None, float]:
    """The drone's box in the image, and its visible share; draws into the image (h, w, 3)."""
    height, width = image.shape[:2]
    left, top = np.rint(middle - np.array([drone.shape[1], drone.shape[0]]) / 2).astype(int)
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + drone.shape[1], width), min(top + drone.shape[0], height)
    if x1 - x0 < 3 or y1 - y0 < 3:
        return None, 0.0
    whole = int(np.count_nonzero(drone[..., 3] > _SOLID))
    drone = drone[y0 - top : y1 - top, x0 - left : x1 - left]
    alpha, colour = drone[..., 3:] / 255.0, drone[..., :3]
    behind = image[y0:y1, x0:x1]
    if rng.random() < 0.3:  # as bright as what is behind, or nearly
        own = colour.sum((0, 1)) / max(float(alpha.sum()), 1e-3)
        around = np.median(behind, axis=(0, 1))
        colour = colour * (1 + rng.uniform(0.3, 0.9) * (around.mean() / max(float(own.mean()), 1.0) - 1))
        colour = np.minimum(colour, 255.0 * alpha)
    if rng.random() < 0.25:  # haze
        share = rng.uniform(0.5, 1.0)
        colour, alpha = colour * share, alpha * share
    if rng.random() < 0.12:  # leaves, a fence, a wire before it
        grain = rng.standard_normal((y1 - y0, x1 - x0)).astype(np.float32)
        coarse = cv2.GaussianBlur(grain, (0, 0), max(0.6, rng.uniform(0.02, 0.15) * (x1 - x0)))
        open_ = (coarse < np.quantile(coarse, rng.uniform(0.5, 0.9)))[..., None]
        colour, alpha = colour * open_, alpha * open_
    image[y0:y1, x0:x1] = behind * (1 - alpha) + colour
    seen = alpha[..., 0] > _SOLID / 255.0 * 0.8
    if not seen.any():
        return None, 0.0
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    box = np.array([x0 + columns[0], y0 + rows[0], x0 + columns[-1] + 1, y0 + rows[-1] + 1], np.float32)
    return box, float(np.count_nonzero(seen)) / max(whole, 1)


def _covered(box: Any, by: Any) -> float:
    """Share of a box that another covers."""
    low, high = np.maximum(box[:2], by[:2]), np.minimum(box[2:], by[2:])
    area = float(np.prod(box[2:] - box[:2]))
    return float(np.prod(np.maximum(high - low, 0))) / (area if area > 1.0 else 1.0)


def filmed(scene: Scene, rng: Generator, *, is_photograph: bool) -> Scene:
    """The scene as a camera shows it, mirrored half of the time."""
    (image,) = as_filmed([scene.image], rng)
    if is_photograph:
        image = through_camera(scene.image, drawn_effects(1.0, rng), rng)
    boxes = scene.boxes
    if rng.random() < 0.5:
        image, boxes = np.ascontiguousarray(image[:, ::-1]), boxes.copy()
        boxes[:, [0, 2]] = image.shape[1] - boxes[:, [2, 0]]
    return Scene(image, boxes, scene.classes)


def read(path: Path) -> Image:
    """A picture (h, w, 3), RGB."""
    read = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if read is None:
        raise FileNotFoundError(f"{path}: is no picture that can be read")
    return np.asarray(read, np.uint8)
