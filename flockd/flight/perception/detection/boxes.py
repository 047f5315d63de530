"""Boxes of drones in a whole image, as a detector finds them, beside the pixels that the segmentation finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flockd.core.messages import UNCLASSED, Float32Array, FloatArray, UInt8Array
from flockd.flight.inference import Manifest
from flockd.flight.perception.detection.instances import Instance

_SAME_OVERLAP = 0.3
"""Intersection over union from which a box and an instance are one drone."""
_PART = 0.8
"""An instance of which so much lies in a box of at least twice its width is a part of that drone."""
_FIRST = 50.0
"""Added to the score of what a detector found: it is proposed before what the segmentation alone finds."""


@dataclass(frozen=True)
class BoxRules:
    """How a detector's output is judged, as its manifest says."""

    least_probability: float
    overlap: float
    gain: float
    offset: float
    no_box: float

    @classmethod
    def of(cls, manifest: Manifest) -> BoxRules:
        """Raises ModelError where the manifest does not say."""
        return cls(
            least_probability=manifest.threshold("box_probability"),
            overlap=manifest.threshold("overlap"),
            gain=manifest.threshold("evidence_gain"),
            offset=manifest.threshold("evidence_offset"),
            no_box=manifest.threshold("no_box_evidence"),
        )


def kept_boxes(columns: Mapping[str, Float32Array], rules: BoxRules) -> tuple[FloatArray, FloatArray]:
    """Boxes (n, 4) left, top, right, bottom that are probable enough and no second ones of a drone; log odds (n,).

    ``columns``: the detector's output, (m,) each. The most probable boxes come first.
    """
    probability = columns["drone_probability"]
    good = np.flatnonzero(probability >= rules.least_probability)
    half = np.stack([columns["width_px"][good], columns["height_px"][good]], 1).astype(float) / 2
    middle = np.stack([columns["centre_right_px"][good], columns["centre_down_px"][good]], 1).astype(float)
    p = probability[good].astype(float)
    corners = np.hstack([middle - half, 2 * half])
    kept = np.asarray(cv2.dnn.NMSBoxes(corners.tolist(), p.tolist(), 0.0, rules.overlap), int).reshape(-1)
    p = np.clip(p[kept], 1e-6, 1 - 1e-6)
    return np.hstack([middle - half, middle + half])[kept], np.log(p / (1 - p))


def with_boxes(
    labels: UInt8Array, instances: tuple[Instance, ...], boxes: FloatArray, odds: FloatArray, rules: BoxRules
) -> tuple[UInt8Array, tuple[Instance, ...]]:
    """The instances of an image with what a detector says of each, and those that only the detector has found.

    Where a box and an instance are one drone, the instance takes the box. Parts of a drone become one with it.

    Args:
        labels: (h, w) of the instances; changed where parts become one.
        instances: as the segmentation has them.
        boxes: (n, 4) left, top, right, bottom, the most probable first.
        odds: (n,) log odds of each.
        rules: of the detector.
    """
    left: dict[int, Instance] = {one.label: replace(one, evidence=rules.no_box) for one in instances}
    free = iter(sorted(set(range(1, UNCLASSED)) - left.keys()))
    found = []
    for box, log_odds in zip(boxes, odds, strict=True):
        evidence = rules.gain * float(log_odds) + rules.offset
        same = max(left.values(), key=lambda one: _overlap(one.box, box), default=None)
        if same is not None and _overlap(same.box, box) >= _SAME_OVERLAP:
            del left[same.label]
        else:
            label = next(free, None)
            if label is None:
                break
            area = float(np.prod(box[2:] - box[:2])) / 2
            same = Instance(label, (box[:2] + box[2:]) / 2, box, area)
        parts = [one for one in left.values() if _is_part(one.box, box)]
        for part in parts:
            labels[labels == part.label] = same.label
            del left[part.label]
        centre = (box[:2] + box[2:]) / 2
        found.append(replace(same, box=box, centre=centre, score=_FIRST + float(log_odds), evidence=evidence))
    return labels, (*found, *left.values())


def _is_part(of: FloatArray, box: FloatArray) -> bool:
    if 2 * (of[2] - of[0]) > box[2] - box[0]:
        return False
    return _common(of, box) >= _PART * float(np.prod(of[2:] - of[:2]))


def _overlap(a: FloatArray, b: FloatArray) -> float:
    common = _common(a, b)
    return common / max(float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - common, 1e-9)


def _common(a: FloatArray, b: FloatArray) -> float:
    return float(np.prod(np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0.0)))
