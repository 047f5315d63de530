"""Proposals: the instances of the first stage, and the predictions of tracks.

Each proposal costs a few crops of the second stage, which decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import FloatArray, Reason, ReasonKind, VehicleState
from flockd.flight.geometry import Rig, log_polar
from flockd.flight.inference.manifest import CropSpec
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.detection.roi import Roi, angles_between, pixel_angles, rois_of_instances
from flockd.flight.perception.maps import SceneMaps
from flockd.flight.tracking import Prediction

_SAME_RANGE = math.log(1.5)
"""Largest difference of log range between a detection and the neighbour predicted there."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A region of interest, and its origin."""

    cameras: tuple[str, ...]
    """The cameras that show it."""
    roi: Roi
    instance: Instance | None = None
    """The first stage's instance; None: the proposal comes from a prediction."""
    predicted: bool = False
    """Whether it comes from a track."""

    @property
    def area_px(self) -> float:
        """Area of the instance in the first stage."""
        return self.instance.area_px if self.instance else 0.0

    @property
    def evidence(self) -> float:
        """Log odds of a drone before any crop."""
        return self.instance.evidence if self.instance else 0.0


def propose_instances(
    rig: Rig, scenes: Mapping[str, SceneMaps], rules: CropSpec, parameters: DetectionParameters
) -> list[Proposal]:
    """The first stage's instances: in each image those of the highest score; of equal scores the larger."""
    found = []
    for name, scene in scenes.items():
        ranked = sorted(scene.instances, key=lambda one: (-one.score, -one.area_px))
        labels = {one.label for one in ranked[: parameters.max_proposals]}
        best = [one for one in scene.instances if one.label in labels]
        rois = rois_of_instances(rig.cameras[name], best, rules)
        found += [Proposal((name,), roi, one) for one, roi in zip(best, rois, strict=True) if roi is not None]
    return found


def propose_predictions(
    rig: Rig,
    vehicle: VehicleState,
    predictions: Iterable[Prediction],
    detected: Sequence[tuple[FloatArray, float]],
    rules: CropSpec,
) -> tuple[list[Proposal], list[Reason]]:
    """Predictions of tracks at which nothing was found, and reasons for those that are left out.

    Args:
        rig: the cameras that have an image.
        vehicle: for the attitude.
        predictions: of the confirmed tracks.
        detected: bearing (3,) in the body, and log range in metres, of each drone found so far. One at another range is
            not the predicted one.
        rules: for the crops.
    """
    proposals, reasons = [], []
    bearings = np.array([bearing for bearing, _ in detected]).reshape(-1, 3)
    log_ranges = np.array([log_range for _, log_range in detected])
    for prediction in predictions:
        place = vehicle.R_ned_body.T @ prediction.position
        try:
            bearing, log_range = log_polar(place)
        except ValueError as error:
            reasons.append(Reason(ReasonKind.PROPOSAL, f"proposal of a track: {error}"))
            continue
        cameras = tuple(
            one.name for one in rig.cameras.values() if np.isfinite(one.pixels_of_points(place[None])).all()
        )
        if not cameras:
            continue
        finest = pixel_angles(rig, [cameras], bearing[None])
        fitting = rules.fitting(np.array([prediction.size_m]), np.array([math.exp(log_range)]))
        half_angle = float(rules.bounded(fitting, finest)[0])
        same = (angles_between(bearings, bearing) < half_angle) & (np.abs(log_range - log_ranges) < _SAME_RANGE)
        if not same.any():
            proposals.append(Proposal(cameras, Roi(bearing, half_angle), predicted=True))
    return proposals, reasons
