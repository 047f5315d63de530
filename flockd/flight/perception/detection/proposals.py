"""Where a drone may be: what the first stage segments, and where tracks are predicted.

A proposal costs a few crops of the second stage, which decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import FloatArray, Reason, ReasonKind, VehicleState
from flockd.flight.geometry import Rig, log_polar
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.detection.roi import CropRules, Roi, angle_between, pixel_angle, roi_of_instance
from flockd.flight.perception.maps import SceneMaps
from flockd.flight.tracking import Prediction

_SAME_RANGE = math.log(1.5)
"""By which a log range may be off where it is that of the neighbour that is predicted."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A region of interest, and where it comes from."""

    cameras: tuple[str, ...]
    """Those that show it."""
    roi: Roi
    instance: Instance | None = None
    """What the first stage proposed; None where the proposal comes from a prediction."""
    predicted: bool = False
    """Whether it comes from a track."""

    @property
    def area_px(self) -> float:
        """Area of its pixels in the first stage."""
        return self.instance.area_px if self.instance else 0.0

    @property
    def evidence(self) -> float:
        """Log odds of a drone before any crop."""
        return self.instance.evidence if self.instance else 0.0


def propose_instances(
    rig: Rig, scenes: Mapping[str, SceneMaps], rules: CropRules, parameters: DetectionParameters
) -> list[Proposal]:
    """What the first stage segments, of each image those of the highest score, in the order of the instances."""
    return [
        Proposal((name,), roi, instance)
        for name, scene in scenes.items()
        for instance in best_instances(scene, parameters.max_proposals)
        if (roi := roi_of_instance(rig.cameras[name], instance, rules)) is not None
    ]


def best_instances(scene: SceneMaps, most: int) -> list[Instance]:
    """At most so many, of the highest score; of equal scores the larger."""
    kept = {one.label for one in sorted(scene.instances, key=lambda one: (-one.score, -one.area_px))[:most]}
    return [one for one in scene.instances if one.label in kept]


def propose_predictions(
    rig: Rig,
    vehicle: VehicleState,
    predictions: Iterable[Prediction],
    detected: Sequence[tuple[FloatArray, float]],
    rules: CropRules,
) -> tuple[list[Proposal], list[Reason]]:
    """Where a track is predicted and nothing was found, and why a prediction is none.

    Args:
        rig: the cameras that have an image.
        vehicle: for the attitude.
        predictions: of the confirmed tracks.
        detected: bearings (3,), in the body, of what was found already, and the logarithm of its range in metres: who
            is at quite another range is not the one that is predicted.
        rules: for the crops.
    """
    proposals, reasons = [], []
    for prediction in predictions:
        R_body_ned = vehicle.R_ned_body.T
        place = R_body_ned @ prediction.position
        try:
            bearing, log_range = log_polar(place)
        except ValueError as error:
            reasons.append(Reason(ReasonKind.PROPOSAL, f"proposal of a track: {error}"))
            continue
        range_m = math.exp(log_range)
        cameras = tuple(name for name, pixel in rig.pixels_of(place[None]).items() if np.isfinite(pixel).all())
        if not cameras:
            continue
        roi = Roi(bearing, rules.half_angle(prediction.size_m, range_m, pixel_angle(rig, cameras, bearing)))
        found = any(
            angle_between(roi.direction, other) < roi.half_angle and abs(log_range - log_other) < _SAME_RANGE
            for other, log_other in detected
        )
        if not found:
            proposals.append(Proposal(cameras, roi, predicted=True))
    return proposals, reasons
