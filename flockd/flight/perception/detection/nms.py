"""Non-maximum suppression in log-polar coordinates: of several candidates for one drone, one detection remains."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED, Detection
from flockd.flight.geometry import log_polar_covariance, log_polar_residual
from flockd.flight.geometry.transform import EYE
from flockd.flight.perception.detection.refinement import Candidate

MAX_DETECTIONS = UNCLASSED - 1
"""Detections in one frame set: the labels that fit in a mask of bytes."""


def suppress(
    candidates: Sequence[Candidate], parameters: DetectionParameters, sure: float = 0.0
) -> tuple[tuple[Detection, ...], Mapping[str, dict[int, int]]]:
    """One detection for each drone; by camera, its label by the label of the first stage's instance.

    All candidates of one drone are fused, or those of at least the probability ``sure`` if any is. Greedy, as usual:
    the candidate of the largest instance is compared first.
    """
    groups: list[list[Candidate]] = []
    for one in sorted(candidates, key=lambda candidate: -candidate.proposal.area_px):
        group = next((group for group in groups if are_one_drone(group[0], one, parameters)), None)
        if group is None:
            groups.append([one])
        else:
            group.append(one)
    detections, label_of = [], defaultdict[str, dict[int, int]](dict)
    for label, group in enumerate(groups[:MAX_DETECTIONS], start=1):
        detections.append(fuse([one for one in group if one.drone_probability >= sure] or group, label))
        for one in group:
            if one.proposal.instance:
                label_of[one.proposal.cameras[0]][one.proposal.instance.label] = label
    return tuple(detections), label_of


def are_one_drone(one: Candidate, other: Candidate, parameters: DetectionParameters) -> bool:
    """Whether two candidates lie within a Mahalanobis distance of each other.

    The covariance of a drone's extent is added to both: from two views its centre differs by a share of its size.
    """
    residual = log_polar_residual(other.bearing, other.log_range, one.bearing, one.log_range)
    extent = parameters.drone_extent * max(one.size_m, other.size_m) / min(one.range_m, other.range_m)
    spread = one.covariance + other.covariance + extent**2 * EYE
    return float(residual @ np.linalg.solve(spread, residual)) < parameters.suppression_gate**2


def fuse(group: Sequence[Candidate], label: int) -> Detection:
    """The mean of one drone's candidates, weighted by the variances of their log ranges.

    Crops of one drone have similar errors, so the variance of the best candidate is kept.
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
