"""Measure how well `flockd detect` finds the drones of labelled pictures, and its false detections.

flockd detect FOLDER --fov 90 --json > found.json
python -m tools.measure.labelled found.json FOLDER/labels.json     # boxes in COCO's format, of the category `drone`
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flockd.ground.datasets.image_files import DatasetError, read_image

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""
Fit = Callable[[Box, Box], float]
"""How well a detection's box fits a drone's: more is better; below 0: no match."""

WIDTHS_PX = (0, 6, 12, 30, 80)
"""Where the classes of box width begin; the last one is open."""
WIDTH_CLASSES = tuple(f"{a}-{b}" for a, b in zip(WIDTHS_PX, [*map(str, WIDTHS_PX[1:]), ""], strict=True))


def read_labels(path: Path) -> dict[Path, list[Box]]:
    """The drones of each picture: COCO's boxes of the category `drone`, upper or lower case.

    Raises SystemExit for boxes that cannot be of these pictures.
    """
    coco = _json(path)
    drones = {one["id"] for one in coco["categories"] if one["name"].strip().casefold() in {"drone", "drones", "uav"}}
    if not drones:
        names = ", ".join(sorted(one["name"] for one in coco["categories"])) or "none"
        raise SystemExit(f"{path}: has no category `drone`, but {names}; rename that of the drones")
    files = {one["id"]: (path.parent / one["file_name"]).resolve() for one in coco["images"]}
    if len(set(files.values())) < len(coco["images"]):
        raise SystemExit(f"{path}: names a picture or an id of one twice; give each its own")
    sizes = {key: _size(file) for key, file in files.items()}
    for one in coco["images"]:
        said, here = (one.get("width"), one.get("height")), sizes[one["id"]]
        if None not in said and said != here and np.isfinite(here).all():
            told = f"is of {here[0]:g} x {here[1]:g} pixels, upright, and its labels of {said[0]} x {said[1]}"
            raise SystemExit(f"{path}: {one['file_name']} {told}; label the pictures that are here")
    found: dict[Path, list[Box]] = {file: [] for file in files.values()}
    known = {one["id"] for one in coco["categories"]}
    for one in coco["annotations"]:
        if one["category_id"] not in known or one["image_id"] not in files:
            raise SystemExit(f"{path}: {_told_of(one)}: its category or image is not listed; correct the ids")
        if one["category_id"] not in drones or one.get("iscrowd"):
            continue
        left, top, width, height = _numbers(path, one)
        wide, high = sizes[one["image_id"]]
        fault = f"{path}: image {one['image_id']}: bbox {one['bbox']} in {wide:g} x {high:g} pixels"
        if max(one["bbox"]) <= 1:
            raise SystemExit(f"{fault} is in shares of it; write pixels: left, top, width, height")
        if not (-1 <= left < left + width <= wide + 1 and -1 <= top < top + height <= high + 1):
            raise SystemExit(f"{fault} ends outside it; write left, top, width, height, not the corners")
        box = (left, top, left + width, top + height)
        if box in found[files[one["image_id"]]]:
            raise SystemExit(f"{path}: {_told_of(one)} is there twice; delete one")
        found[files[one["image_id"]]].append(box)
    return found


def _told_of(annotation: Mapping[str, Any]) -> str:
    return f"image {annotation['image_id']}: bbox {annotation.get('bbox')} of category {annotation['category_id']!r}"


def _numbers(path: Path, annotation: Mapping[str, Any]) -> Box:
    """Left, top, width and height. Raises SystemExit for what is no four numbers."""
    box = annotation.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not all(isinstance(one, int | float) for one in box):
        raise SystemExit(f"{path}: {_told_of(annotation)} is no box; write left, top, width, height in pixels")
    return box[0], box[1], box[2], box[3]


def _size(file: Path) -> tuple[float, float]:
    """Width and height in pixels, infinite without the picture's file. Raises SystemExit for a damaged one."""
    if not file.exists():
        return np.inf, np.inf
    try:
        height, width, _ = read_image(file).shape
    except DatasetError as error:
        raise SystemExit(str(error)) from None
    return width, height


def scored(pictures: Sequence[dict[str, Any]], labels: dict[Path, list[Box]]) -> dict[str, Any]:
    """Score the labelled ones of ``pictures``, which are in the form of `flockd detect --json`.

    By box width the number of ``boxes`` and of those ``found``, with a detection's middle inside; ``ap50``, the average
    precision at an intersection over union of 0.5; ``measured`` pictures, and labelled ones that were
    ``unmeasured``; ``false``: detections that found no box.
    """
    counts = {name: {"boxes": 0, "found": 0} for name in WIDTH_CLASSES}
    measured, false, judged, left = 0, 0, list[tuple[float, bool]](), dict(labels)
    for picture in pictures:
        if (boxes := left.pop(Path(picture["file"]).resolve(), None)) is None:
            continue  # without labels, or once more
        measured += 1
        detections = sorted(picture["detections"], key=lambda one: -one["probability"])
        found = match([tuple(one["box"]) for one in detections], boxes, middle_inside)
        false += found.count(None)
        for number, box in enumerate(boxes):
            of_width = counts[WIDTH_CLASSES[int(np.searchsorted(WIDTHS_PX, box[2] - box[0], side="right")) - 1]]
            of_width["boxes"] += 1
            of_width["found"] += number in found
        overlapping = match([tuple(one["box"]) for one in detections], boxes, half_overlap)
        judged += [(one["probability"], of is not None) for one, of in zip(detections, overlapping, strict=True)]
    count = sum(of_width["boxes"] for of_width in counts.values())
    ap50 = average_precision(judged, count)
    per_picture = false / measured if measured else None
    return {
        "unmeasured": len(left), "boxes": count, "by_width": counts, "ap50": None if ap50 is None else round(ap50, 4),
        "measured": measured, "false": false, "false_per_picture": per_picture,
    }  # fmt: skip


def match(detections: Sequence[Box], boxes: Sequence[Box], fit: Fit) -> list[int | None]:
    """For each detection, the most probable first, the number of the remaining box that it fits best, or None."""
    left, found = set(range(len(boxes))), list[int | None]()
    for one in detections:
        best = max(left, key=lambda number: fit(one, boxes[number]), default=None)
        if best is None or fit(one, boxes[best]) < 0:
            found.append(None)
        else:
            found.append(best)
            left.remove(best)
    return found


def middle_inside(one: Box, box: Box) -> float:
    """The nearer the middles, the better; -1 if the detection's middle is outside the box."""
    u, v = (one[0] + one[2]) / 2, (one[1] + one[3]) / 2
    if not (box[0] <= u <= box[2] and box[1] <= v <= box[3]):
        return -1.0
    return 1.0 / (1.0 + float(np.hypot(u - (box[0] + box[2]) / 2, v - (box[1] + box[3]) / 2)))


def half_overlap(one: Box, box: Box) -> float:
    """Intersection over union; -1 if it is below a half."""
    width, height = min(one[2], box[2]) - max(one[0], box[0]), min(one[3], box[3]) - max(one[1], box[1])
    both = max(width, 0.0) * max(height, 0.0)
    area, other = ((of[2] - of[0]) * (of[3] - of[1]) for of in (one, box))
    return share if (share := both / (area + other - both)) >= 0.5 else -1.0


def average_precision(judged: Sequence[tuple[float, bool]], boxes: int) -> float | None:
    """Area under the curve of the best precision at each recall or a higher one (PASCAL VOC since 2010, Everingham et
    al. 2015); None without boxes. ``judged``: of all detections the probability, and whether it found a box."""
    if not boxes:
        return None
    ordered = sorted(judged, key=lambda one: -one[0])
    probabilities = np.array([probability for probability, _ in ordered])
    hits = np.cumsum([is_true for _, is_true in ordered])
    last = np.append(probabilities[1:] != probabilities[:-1], True)[: len(ordered)]  # equal ones count together
    precision = (hits / np.arange(1, len(ordered) + 1))[last]
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(best * np.diff(hits[last] / boxes, prepend=0.0)))


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8-sig"))


def _told(path: Path, read: Callable[[], Any], wanted: str) -> Any:
    try:
        return read()
    except OSError as error:
        raise SystemExit(f"{path}: cannot be read ({error.strerror}); name another file") from None
    except KeyError as error:
        raise SystemExit(f"{path}: lacks {error}; give {wanted}") from None
    except (ValueError, IndexError, TypeError, AttributeError) as error:
        fault = "is no JSON" if isinstance(error, ValueError) else "is of another form"
        raise SystemExit(f"{path}: {fault}; give {wanted}") from None


def main() -> None:
    """Prints the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("found", type=Path, help="what `flockd detect --json` printed")
    parser.add_argument("labels", type=Path, help="boxes in COCO's format")
    args = parser.parse_args()
    detected = _told(args.found, lambda: _json(args.found)["pictures"], "what `flockd detect --json` printed")
    labels = _told(args.labels, lambda: read_labels(args.labels), "boxes in COCO's format")
    found = _told(args.found, lambda: scored(detected, labels), "what `flockd detect --json` printed")
    if not found["measured"]:
        raise SystemExit(f"{args.found}: has none of the pictures of {args.labels}; detect in the folder of the labels")
    if found["unmeasured"]:
        told = f"{found['unmeasured']} of {len(labels)} pictures of {args.labels} are not in {args.found}"
        print(f"{told}; detect in all of them, and check their file names", file=sys.stderr)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
