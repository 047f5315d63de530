"""Boxes of drones in a whole image, by a detector, merged with the instances that the segmentation finds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from flockd.core.messages import UNCLASSED, Float32Array, FloatArray, UInt8Array
from flockd.flight.inference import Manifest
from flockd.flight.perception.detection.instances import Instance

_SAME_OVERLAP = 0.3
"""Intersection over union from which a box and an instance are one drone."""
_PART = 0.8
"""An instance with this share of its area inside a box of at least twice its width is a part of that drone."""
_LARGE_PX = (40.0, 300.0)
"""Widths of boxes between which evidence against a drone from the second stage loses its weight: it was trained on real
drones of 6 to 60 pixels, and rejects large ones."""
_SMALL_PX = (20.0, 8.0)
"""The same for narrow boxes, fully from the second width down: a crop of so few pixels shows no shape."""
_SUREST = 0.95
"""Upper limit of a box's probability: a detector that is certain and wrong may not overrule the second stage."""
_SUREST_ODDS = math.log(_SUREST / (1 - _SUREST))
_FIRST = 50.0
"""Added to the score of a detector's boxes: they are proposed before what only the segmentation finds."""


@dataclass(frozen=True)
class BoxRules:
    """A detector's thresholds, as its manifest names them."""

    box_probability: float
    overlap: float
    evidence_gain: float
    large_box_evidence: float
    small_box_evidence: float
    no_box_evidence: float

    @classmethod
    def of(cls, manifest: Manifest) -> BoxRules:
        """Of a manifest with the role `detector`."""
        return cls(**{one.name: manifest.thresholds[one.name] for one in fields(cls)})

    def evidence(self, box: FloatArray, log_odds: float) -> float:
        """Log odds of a drone, added to the second stage's, for a box (4,) with the detector's ``log_odds``."""
        width = max(float(box[2] - box[0]), 1.0)
        # A small doubtful box counts more, but never more than the most probable one.
        room = max(self.evidence_gain * (_SUREST_ODDS - log_odds), 0.0)
        small = min(self.small_box_evidence * _share(width, _SMALL_PX), room)
        return self.evidence_gain * log_odds + self.large_box_evidence * _share(width, _LARGE_PX) + small


def _share(width: float, ends: tuple[float, float]) -> float:
    """0 at the first of ``ends``, 1 at the second, logarithmic between them."""
    first, second = np.log(ends)
    return float(np.clip((math.log(width) - first) / (second - first), 0.0, 1.0))


def probable_boxes(
    columns: Mapping[str, Float32Array], rules: BoxRules, scale: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Boxes (n, 4) left, top, right, bottom above the least probability, and their probabilities (n,).

    Args:
        columns: a detector's output, (m,) each.
        rules: of the detector.
        scale: pixels of the network's input per pixel of the image, right and down.
    """
    good = (columns["drone_probability"] >= rules.box_probability).nonzero()[0]
    right, down, width, height = (
        columns[name][good].astype(float) for name in ("centre_right_px", "centre_down_px", "width_px", "height_px")
    )
    boxes = np.array([right - width / 2, down - height / 2, right + width / 2, down + height / 2]).T
    return boxes / np.tile(scale, 2), columns["drone_probability"][good].astype(float)


def kept_boxes(boxes: FloatArray, probability: FloatArray, rules: BoxRules) -> tuple[FloatArray, FloatArray]:
    """The boxes (n, 4) without duplicates, the most probable first, and their log odds (n,)."""
    corners = np.hstack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])
    kept = np.asarray(cv2.dnn.NMSBoxes(corners.tolist(), probability.tolist(), 0.0, rules.overlap), int).reshape(-1)
    p = np.clip(probability[kept], 1 - _SUREST, _SUREST)
    return boxes[kept], np.log(p / (1 - p))


def with_boxes(
    labels: UInt8Array, instances: tuple[Instance, ...], boxes: FloatArray, odds: FloatArray, rules: BoxRules
) -> tuple[UInt8Array, tuple[Instance, ...]]:
    """The instances of an image, with the detector's evidence, and those that only the detector found.

    An instance that is the same drone as a box takes the box. Instances that are parts of one drone are joined.

    Args:
        labels: (h, w) of the instances; a changed copy is returned if parts are joined.
        instances: by the segmentation.
        boxes: (n, 4) left, top, right, bottom, the most probable first.
        odds: (n,) log odds of each.
        rules: of the detector.
    """
    left: dict[int, Instance] = {one.label: replace(one, evidence=rules.no_box_evidence) for one in instances}
    free = iter(sorted(set(range(1, UNCLASSED)) - left.keys()))
    found = []
    for box, log_odds in zip(boxes, odds, strict=True):
        evidence = rules.evidence(box, float(log_odds))
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
        found.append(
            replace(same, box=box, centre=centre, score=_FIRST + float(log_odds), evidence=evidence, boxed=True)
        )
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
