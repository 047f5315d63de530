"""The rendered photographs of one drone at known distances that the tests use, with their truth.

python -m tests.ground.pictures.photographs     renders them again, into tests/ground/pictures/rendered
"""

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
VIEWS = (
    # distance in metres; degrees right, up, and of the drone's yaw
    (2.5, 0, 10, 20),
    (2.5, -9, -6, 80),
    (2.5, 8, 2, 150),
    (4.0, 3, 7, 250),
    (4.0, -12, -9, 35),
    (4.0, 14, 4, 110),
    (6.0, -5, 9, 190),
    (6.0, 9, -4, 300),
    (6.0, 0, 3, 65),
)


def truth() -> tuple[dict[str, float], dict[str, list[float]]]:
    """By file name the distance, and the box (left, top, width, height), of the photographs with the drone."""
    coco: dict[str, Any] = json.loads(LABELS.read_text(encoding="utf-8"))
    names = {image["id"]: image["file_name"] for image in coco["images"]}
    distances = {image["file_name"]: image["distance_m"] for image in coco["images"] if "distance_m" in image}
    return distances, {names[one["image_id"]]: one["bbox"] for one in coco["annotations"]}


def render() -> None:
    """Writes the pictures and their labels."""
    import cv2
    import numpy as np

    from flockd.flight.geometry import rotation_from_euler
    from flockd.sim.renderer.drone_models import drone_model
    from flockd.sim.renderer.renderer import Renderer
    from flockd.sim.world.world import World

    matrix = np.array([[FOCAL_PX, 0.0, SIZE[0] / 2], [0.0, FOCAL_PX, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    R_ned_camera = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    camera = np.array([0.0, 0.0, -14.0])
    renderer = Renderer(World.generate(11), [drone_model(0, 3)])
    images, annotations = [], []
    RENDERED.mkdir(exist_ok=True)
    for k, (distance_m, right_deg, up_deg, yaw_deg) in enumerate((*VIEWS, (math.nan, 0, 0, 0))):
        right, up = math.radians(right_deg), math.radians(up_deg)
        ray = np.array([math.cos(up) * math.cos(right), math.cos(up) * math.sin(right), -math.sin(up)])
        shown = not math.isnan(distance_m)
        view = renderer.render(
            matrix, SIZE, R_ned_camera, camera, drone_positions=(camera + distance_m * ray)[None], shown=[shown],
            drone_rotations=rotation_from_euler(0.15, -0.1, math.radians(yaw_deg))[None],
        )  # fmt: skip
        name = f"{distance_m:g}_m_{k}.jpg" if shown else "nothing.jpg"
        cv2.imwrite(str(RENDERED / name), cv2.cvtColor(view.rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])
        image = {"id": k + 1, "file_name": name, "width": SIZE[0], "height": SIZE[1]}
        images.append(image | ({"distance_m": distance_m} if shown else {}))
        if shown:
            rows, columns = np.nonzero(view.ids == 1)
            left, top = int(columns.min()), int(rows.min())
            box = [left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top]
            annotations.append({"id": k + 1, "image_id": k + 1, "category_id": 1, "bbox": box, "iscrowd": 0})
    coco = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "drone"}]}
    LABELS.write_text(json.dumps(coco, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    render()
