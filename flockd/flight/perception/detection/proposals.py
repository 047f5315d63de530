"""Proposals: the instances of the first stage, and the predictions of tracks.

Each proposal costs a few crops of the second stage, which decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import BoolArray, FloatArray, Reason, ReasonKind, VehicleState
from flockd.flight.geometry import Rig, RigCamera, log_polar
from flockd.flight.inference.manifest import CropSpec
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.interface import SceneMaps
from flockd.flight.tracking import Prediction

_BORDER_PX = 2
"""A box this near to the image's border is cut by it: the first stage's maps have two image pixels a pixel."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A region of interest, as a square virtual camera sees it, and its origin."""

    cameras: tuple[str, ...]
    """The cameras that show it."""
    direction: FloatArray
    """(3,) unit vector, body FRD."""
    half_angle: float
    """rad, from its centre to its borders."""
    instance: Instance | None = None
    """The first stage's instance; None: the proposal comes from a prediction."""
    range_m: float = math.nan
    """As predicted; NaN: not known."""

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
        found += proposals_of_instances(rig.cameras[name], best, rules)
    return found


def propose_predictions(
    rig: Rig, vehicle: VehicleState, predictions: Iterable[Prediction], rules: CropSpec
) -> tuple[list[Proposal], list[Reason]]:
    """Predictions of tracks that a camera of ``rig`` shows, and reasons for those that are left out.

    ``vehicle`` is for the attitude, ``rules`` are for the crops.
    """
    proposals, reasons = [], []
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
        range_m = math.exp(log_range)
        fitting = rules.fitting(np.array([prediction.size_m]), np.array([range_m]))
        half_angle = float(rules.bounded(fitting, pixel_angles(rig, [cameras], bearing[None]))[0])
        proposals.append(Proposal(cameras, bearing, half_angle, range_m=range_m))
    return proposals, reasons


def proposals_of_instances(camera: RigCamera, instances: Sequence[Instance], rules: CropSpec) -> list[Proposal]:
    """Regions around boxes of the first stage, without those where the lens images nothing."""
    if not instances:
        return []
    boxes, centres = np.array([one.box for one in instances]), np.array([one.centre for one in instances])
    points = np.concatenate([boxes[:, [0, 1, 2, 1, 0, 3, 2, 3]].reshape(-1, 4, 2), centres[:, None]], 1)
    rays = camera.camera.rays(points.reshape(-1, 2)).reshape(-1, 5, 3)
    imaged = np.isfinite(rays[:, :, 0])
    inside = camera.camera.in_image(centres) & imaged[:, 4]
    known: BoolArray = imaged[:, :4].max(1)  # a corner may lie outside a fisheye's image circle
    corners = np.where(imaged[:, :4, None], rays[:, :4], 0.0)
    middle = np.where(known[:, None], np.where(inside[:, None], rays[:, 4], corners.sum(1)), [0.0, 0.0, 1.0])
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    cosines = np.where(imaged[:, :4], (corners @ middle[:, :, None])[:, :, 0], 1.0)
    reach = np.arccos(np.clip(cosines, -1, 1)).max(1)
    far_border = np.array(camera.camera.size) - _BORDER_PX
    cut = (boxes[:, :2] < _BORDER_PX).any(1) | (boxes[:, 2:] > far_border).any(1)
    margin = np.where(cut, rules.cut_margin, rules.first_margin)
    half_angle = rules.bounded(margin * reach, camera.camera.pixel_angle(middle)).tolist()
    regions = zip(middle @ camera.T_body_camera.rotation.T, half_angle, instances, strict=True)
    return [Proposal((camera.name,), *region) for one, region in zip(known.tolist(), regions, strict=True) if one]


def pixel_angles(rig: Rig, cameras: Sequence[Sequence[str]], directions: FloatArray) -> FloatArray:
    """(n,) rad of a pixel along body directions (n, 3), of the camera with the finest resolution among those named.
    Infinity if none of them sees it."""
    finest = np.full(len(directions), np.inf)
    for name, camera in rig.cameras.items():
        angles = camera.camera.pixel_angle(directions @ camera.T_body_camera.rotation)
        named = np.array([name in names for names in cameras], np.bool_)
        finest = np.where(named & (angles > 0.0), np.minimum(angles, finest), finest)
    return finest


def angles_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """(...) rad, between unit vectors (..., 3)."""
    return np.asarray(np.arccos(np.clip((a * b).sum(-1), -1, 1)))
