"""The photographs of one drone at known distances that the tests use, with their truth; flockd's renderer drew them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

RENDERED = Path(__file__).parent / "rendered"
LABELS = RENDERED / "drones.json"
"""COCO, with `distance_m` for each image that shows the drone."""
SIZE = (480, 360)
FOV_DEG = 70.0
FOCAL_PX = SIZE[0] / 2 / math.tan(math.radians(FOV_DEG) / 2)
DRONE_SIZE_M = 0.6925
"""From propeller tip to propeller tip."""


def truth() -> tuple[dict[str, float], dict[str, list[float]]]:
    """By file name the distance, and the box (left, top, width, height), of the photographs with the drone."""
    coco: dict[str, Any] = json.loads(LABELS.read_text(encoding="utf-8"))
    names = {image["id"]: image["file_name"] for image in coco["images"]}
    distances = {image["file_name"]: image["distance_m"] for image in coco["images"] if "distance_m" in image}
    return distances, {names[one["image_id"]]: one["bbox"] for one in coco["annotations"]}
