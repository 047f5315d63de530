"""Non-maximum suppression in log-polar coordinates: of several candidates for one drone, one detection is left."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED, Detection
from flockd.flight.geometry import log_polar_covariance, log_polar_residual
from flockd.flight.perception.detection.masks import CropMask
from flockd.flight.perception.detection.refinement import Candidate
from flockd.flight.perception.detection.roi import angle_between

MAX_DETECTIONS = UNCLASSED - 1
"""In one frame set: as many labels as a mask of bytes has."""


@dataclass(frozen=True, eq=False)
class Suppressed:
    """One detection a drone, and its candidates' masks."""

    detections: tuple[Detection, ...]
    label_of: Mapping[tuple[str, int], int]
    """The detection's label, by camera and the label of the first stage's instance."""
    masks_of: Mapping[int, Sequence[CropMask]]
    """By the detection's label."""

    def labels_of(self, camera: str) -> dict[int, int]:
        """The detections' labels by those of one camera's instances."""
        return {instance: label for (name, instance), label in self.label_of.items() if name == camera}


def suppress(candidates: Sequence[Candidate], parameters: DetectionParameters) -> Suppressed:
    """Without what is hidden behind others, and with all candidates of one drone fused.

    Greedy, as non-maximum suppression is: the candidate of the largest instance is compared first.
    """
    groups: list[list[Candidate]] = []
    visible = without_occluded(candidates, parameters)
    for one in sorted(visible, key=lambda candidate: -candidate.proposal.area_px):
        group = next((group for group in groups if are_one_drone(group[0], one, parameters)), None)
        if group is None:
            groups.append([one])
        else:
            group.append(one)
    return _labelled(groups)


def separate(candidates: Sequence[Candidate]) -> Suppressed:
    """Each candidate as a detection of its own: for masks of all that was found."""
    return _labelled([[candidate] for candidate in candidates])


def _labelled(groups: Sequence[Sequence[Candidate]]) -> Suppressed:
    detections, label_of, masks_of = [], {}, {}
    for label, group in enumerate(groups[:MAX_DETECTIONS], start=1):
        detections.append(fuse(group, label))
        masks_of[label] = [mask for one in group for mask in one.masks]
        for one in group:
            if one.proposal.instance:
                label_of[(one.proposal.cameras[0], one.proposal.instance.label)] = label
    return Suppressed(tuple(detections), label_of, masks_of)


def without_occluded(candidates: Sequence[Candidate], parameters: DetectionParameters) -> list[Candidate]:
    """Without what would be hidden behind a nearer one whose range is known better.

    A part of a drone that an image's border cuts off may resemble a whole one far behind it. The nearer one always
    stays: a false drone costs less than one overlooked.
    """

    def hides(near: Candidate, far: Candidate) -> bool:
        better_known = near.log_range_sigma < far.log_range_sigma
        behind = far.log_range > near.log_range and not are_one_drone(near, far, parameters)
        apart = angle_between(near.bearing, far.bearing)
        return better_known and behind and apart < parameters.occlusion * near.size_m / near.range_m

    return [one for one in candidates if not any(hides(other, one) for other in candidates)]


def are_one_drone(one: Candidate, other: Candidate, parameters: DetectionParameters) -> bool:
    """Whether two candidates lie within a Mahalanobis distance of each other.

    To both covariances comes that of a drone's extent: where its centre is, its views disagree by a share of its size.
    """
    residual = log_polar_residual(other.bearing, other.log_range, one.bearing, one.log_range)
    extent = parameters.drone_extent * max(one.size_m, other.size_m) / min(one.range_m, other.range_m)
    spread = one.covariance + other.covariance + extent**2 * np.eye(3)
    return float(residual @ np.linalg.solve(spread, residual)) < parameters.suppression_gate**2


def fuse(group: Sequence[Candidate], label: int) -> Detection:
    """The mean of the candidates of one drone, weighted by the variances of their log ranges.

    The errors of two crops of one drone are alike, so the best candidate's variance stays.
    """
    weights = np.array([one.log_range_sigma**-2 for one in group])
    weights /= weights.sum()
    bearing = weights @ np.array([one.bearing for one in group])
    bearing /= np.linalg.norm(bearing)
    best = min(group, key=lambda one: one.log_range_sigma)
    return Detection(
        bearing=bearing,
        log_range=float(weights @ [one.log_range for one in group]),
        covariance=log_polar_covariance(bearing, best.log_range_sigma, best.bearing_sigma_rad),
        drone_probability=max(one.drone_probability for one in group),
        size_m=math.exp(float(weights @ [math.log(one.size_m) for one in group])),
        cameras=tuple(dict.fromkeys(name for one in group for name in one.proposal.cameras)),
        label=label,
        log_size_sigma=best.log_size_sigma,
    )
