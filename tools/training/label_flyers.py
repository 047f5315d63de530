"""Boxes of what flies in clips of one bird, airplane or helicopter each, found by a detector that is half trained.

    python -m tools.training.label_flyers LABELS --checkpoint RUN/checkpoint.pt --out MORE

LABELS is a COCO file whose images have a `kind`, that of the only thing that flies in them. Those without a box get one
where the detector sees one thing far better than any other; the result is written to MORE, to lie beside the pictures.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tools.training.detector.network import STRIDES, Boxes

LEAST, OTHERS, LEAST_WIDTH_PX = 0.2, 0.5, 5.0
"""Least probability of the best box, most of another one as a share of it, and least width."""


def main() -> None:
    """Write the boxes that there are and those that were found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    net = Boxes().eval()
    net.detector.load_state_dict(torch.load(arguments.checkpoint, map_location="cpu")["net"])
    coco = json.loads(arguments.labels.read_text(encoding="utf-8"))
    kinds = {one["name"]: one["id"] for one in coco["categories"]}
    boxed = {one["image_id"] for one in coco["annotations"]}
    first = 1 + max((one["id"] for one in coco["annotations"]), default=0)
    found: list[dict[str, object]] = []
    for picture in coco["images"]:
        box = None if picture["id"] in boxed else only_box(net, arguments.labels.parent / picture["file_name"])
        if box is not None:
            found.append(
                {
                    "id": first + len(found),
                    "image_id": picture["id"],
                    "category_id": kinds[picture["kind"]],
                    "bbox": box,
                }
            )
    coco["annotations"] += found
    arguments.out.write_text(json.dumps(coco), encoding="utf-8")
    print(f"{arguments.out}: {len(found)} boxes more")


def only_box(net: Boxes, path: Path) -> list[float] | None:
    """Left, top, width, height in pixels of the one thing that the detector sees; None where it is not one."""
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB), np.uint8)
    down, right = (-size % max(STRIDES) for size in image.shape[:2])
    whole = np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    with torch.no_grad():
        rows: NDArray[Any] = net(torch.from_numpy(whole)[None]).numpy()
    sure = rows[:, 4:].sum(1)
    best = rows[sure.argmax(), :4]
    elsewhere = (np.abs(rows[:, :2] - best[:2]) > 0.75 * best[2:]).any(1)
    if sure.max() < LEAST or best[2] < LEAST_WIDTH_PX or sure[elsewhere].max(initial=0.0) > OTHERS * sure.max():
        return None
    return [float(value) for value in (*(best[:2] - best[2:] / 2), *best[2:])]


if __name__ == "__main__":
    main()
