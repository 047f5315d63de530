"""How well drones are found in real pictures, and how often something else is taken for one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockd.config.perception import PerceptionConfig
from flockd.geometry import PinholeCamera, Rig, RigCamera, RigidTransform
from flockd.messages import Frame, FrameSet, VehicleState
from flockd.perception import Networks, Perception
from flockd.perception.detection.detector import DetectionTrace

WIDTHS_PX = (0, 6, 12, 30, 80)
"""Where the classes of box width begin; the last one is open."""
PER_IMAGES = 500
_R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Of a camera that looks forward: optical right-down-forward axes to the body's forward-right-down."""

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""


@dataclass(frozen=True)
class FoundDrone:
    """One detection in one picture."""

    centre_px: tuple[float, float]
    probability: float
    range_m: float
    size_m: float


@dataclass(frozen=True)
class PictureResult:
    """What the pipeline found in one picture, and how many regions its first stage proposed."""

    found: tuple[FoundDrone, ...]
    proposals: int


@dataclass(frozen=True)
class Labelled:
    """One picture's detections beside the boxes of the drones that are in it; no boxes: no drone is."""

    result: PictureResult
    boxes: tuple[Box, ...] = ()


def detect(networks: Networks, image_rgb: NDArray[np.uint8], fov_deg: float) -> PictureResult:
    """Single-frame detection on an image (h, w, 3), RGB, by the pipeline that flies.

    Nothing is known of attitude, height or tracks. The only place here that calls the pipeline.
    """
    height, width = image_rgb.shape[:2]
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    matrix = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    mounted = RigCamera("camera", PinholeCamera(matrix, (width, height)), RigidTransform(_R_BODY_CAMERA, np.zeros(3)))
    perception = Perception(Rig({"camera": mounted}), networks, PerceptionConfig(scale="network"))
    frames = FrameSet(0.0, {"camera": Frame("camera", image_rgb, 0.0, 0)})
    vehicle = VehicleState(0.0, np.eye(3), 5.0)
    trace = DetectionTrace()
    observation = perception.observe(frames, vehicle, trace=trace)
    found = []
    for detection in observation.detections:
        u, v = mounted.camera.project(detection.position[None] @ _R_BODY_CAMERA)[0]
        centre = float(u), float(v)
        found.append(FoundDrone(centre, detection.drone_probability, detection.range_m, detection.size_m))
    return PictureResult(tuple(found), sum(proposal.instance is not None for proposal in trace.proposals))


def width_class(box: Box) -> str:
    """``"6-12"`` and so on; the last class is ``"80-"``."""
    k = int(np.searchsorted(WIDTHS_PX, box[2] - box[0], side="right")) - 1
    return f"{WIDTHS_PX[k]}-{WIDTHS_PX[k + 1] if k + 1 < len(WIDTHS_PX) else ''}"


def match(labelled: Labelled, min_probability: float = 0.0) -> tuple[list[bool], int]:
    """Which boxes are found, and how many detections are false.

    A box is found by the most probable detection whose centre lies in it; every other detection is false.
    """
    taken = [False] * len(labelled.boxes)
    false = 0
    for one in sorted(labelled.result.found, key=lambda found: -found.probability):
        if one.probability < min_probability:
            continue
        u, v = one.centre_px
        inside = [
            k
            for k, (left, top, right, bottom) in enumerate(labelled.boxes)
            if not taken[k] and left <= u <= right and top <= v <= bottom
        ]
        if inside:
            taken[inside[0]] = True
        else:
            false += 1
    return taken, false


def summary(pictures: Sequence[Labelled], min_probability: float = 0.0) -> dict[str, object]:
    """Of one set: boxes and found ones by width, false detections in 500 images, proposals in an image."""
    by_width: dict[str, dict[str, int]] = {}
    false = 0
    for picture, box, is_found in _matches(pictures, min_probability):
        if box is None:
            false += picture
        else:
            counts = by_width.setdefault(width_class(box), {"boxes": 0, "found": 0})
            counts["boxes"] += 1
            counts["found"] += is_found
    count = max(len(pictures), 1)
    return {
        "images": len(pictures),
        "by_width": dict(sorted(by_width.items(), key=lambda item: int(item[0].split("-")[0]))),
        "false_per_500_images": round(PER_IMAGES * false / count, 1),
        "proposals_per_image": round(sum(p.result.proposals for p in pictures) / count, 2),
    }


def _matches(pictures: Sequence[Labelled], min_probability: float) -> Iterator[tuple[int, Box | None, bool]]:
    """A row a box, and one without a box a picture that begins with the number of false detections."""
    for labelled in pictures:
        taken, false = match(labelled, min_probability)
        yield false, None, False
        yield from ((0, box, is_found) for box, is_found in zip(labelled.boxes, taken, strict=True))
