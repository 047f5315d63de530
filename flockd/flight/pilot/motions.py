"""From an observation and the one before it to the own motion and the neighbours' motions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import UNCLASSED, EgoMotion, Float32Array, FloatArray, NeighbourMotion, Reason, ReasonKind
from flockd.flight.geometry import (
    PointPairs,
    Rig,
    RigCamera,
    estimate_neighbour_motion,
    grid_pixels,
    label_pixels,
    lift_matches,
)
from flockd.flight.perception import CameraObservation, Observation

_LEAST_MATCHES = 300
"""Of an image: of each camera of 640x480 pixels 300 gave the own motion as exactly as 4,800."""


def background_pairs(rig: Rig, observation: Observation, parameters: GeometryParameters) -> PointPairs:
    """What stands still, seen by the same camera before and now. ``ValueError`` says why there is nothing."""
    pairs, seen = [], list(_seen_twice(rig, observation))
    for camera, before, after, flow in seen:
        if before.depth is None or after.depth is None:
            continue
        lifted = lift_matches(
            camera, grid_pixels(camera.camera.size, _stride_px(camera, parameters)), flow,
            before.depth, after.depth, before.labels, after.labels, max_depth_m=parameters.max_depth_m,
        )  # fmt: skip
        pairs.append(lifted.select(lifted.labels == 0))
    if not pairs:
        raise ValueError("no depth has a scale" if seen else "no camera has both frames")
    return PointPairs.concatenate(pairs)


def _stride_px(camera: RigCamera, parameters: GeometryParameters) -> int:
    """As configured, or smaller where a small image would give too few matches."""
    width, height = camera.camera.size
    return max(min(parameters.background_stride_px, math.isqrt(width * height // _LEAST_MATCHES)), 1)


def neighbour_motions(
    rig: Rig, observation: Observation, ego: EgoMotion, parameters: GeometryParameters
) -> tuple[dict[int, NeighbourMotion], list[Reason]]:
    """The motion of every neighbour seen twice, by its current label (Eq. 22-37), and why some have none."""
    motions: dict[int, NeighbourMotion] = {}
    reasons = []
    for label, pairs in neighbour_pairs(rig, observation, parameters).items():
        if pairs is None or len(pairs) < parameters.min_drone_pairs:
            reasons.append(Reason(ReasonKind.NEIGHBOUR, "neighbour motion: too few point pairs"))
            continue
        try:
            motions[label] = estimate_neighbour_motion(pairs, ego, parameters)
        except ValueError as error:
            reasons.append(Reason(ReasonKind.NEIGHBOUR, f"neighbour motion: {error}"))
    return motions, reasons


def neighbour_pairs(rig: Rig, observation: Observation, parameters: GeometryParameters) -> dict[int, PointPairs | None]:
    """What belongs to each neighbour before and now, by its current label."""
    limit = parameters.max_drone_pixels
    pixels = {one.name: label_pixels(before.labels, limit) for one, before, _, _ in _seen_twice(rig, observation)}
    same = _labels_by_flow(rig, observation, pixels)
    pairs: dict[int, list[PointPairs]] = {after: [] for after in same.values()}
    for camera, before, after, flow in _seen_twice(rig, observation):
        if before.depth is None or after.depth is None:
            continue
        for label_before, label in same.items():
            if label_before in pixels[camera.name]:
                relabelled = np.broadcast_to(np.uint8(label), before.labels.shape)
                lifted = lift_matches(
                    camera, pixels[camera.name][label_before], flow,
                    before.depth, after.depth, relabelled, after.labels, max_depth_m=parameters.max_depth_m,
                )  # fmt: skip
                pairs[label].append(lifted)
    return {label: PointPairs.concatenate(found) if found else None for label, found in pairs.items()}


def _seen_twice(
    rig: Rig, observation: Observation
) -> Iterator[tuple[RigCamera, CameraObservation, CameraObservation, Float32Array]]:
    """Each camera with an image before and now: the camera, both, and the flow between them."""
    if observation.previous is not None:
        for name, flow in observation.flows.items():
            yield rig.cameras[name], observation.previous.cameras[name], observation.cameras[name], flow


def _labels_by_flow(
    rig: Rig, observation: Observation, pixels: Mapping[str, Mapping[int, FloatArray]]
) -> dict[int, int]:
    """Previous label -> current label: where most of a drone's ``pixels`` flow to, which are by camera and previous
    label. One to one."""
    votes: Counter[tuple[int, int]] = Counter()
    detections = observation.previous.detections if observation.previous else ()
    for camera, before, after, flow in _seen_twice(rig, observation):
        height, width = before.labels.shape
        for detection in detections:
            start = pixels[camera.name].get(detection.label)
            if start is None or camera.name not in detection.cameras:
                continue
            column, row = start.astype(np.int64).T
            end = np.floor(start + flow[row, column]).astype(np.int64)
            inside = (end[:, 0] >= 0) & (end[:, 0] < width) & (end[:, 1] >= 0) & (end[:, 1] < height)
            counts = np.bincount(after.labels[end[inside, 1], end[inside, 0]], minlength=UNCLASSED)
            for label in np.flatnonzero(counts[1:UNCLASSED]) + 1:
                votes[detection.label, int(label)] += int(counts[label])
    same: dict[int, int] = {}
    for before_label, after_label in sorted(votes, key=lambda pair: -votes[pair]):
        if before_label not in same and after_label not in same.values():
            same[before_label] = after_label
    return same
