"""From an observation and the one before it to the own motion and the neighbours' motions."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import UNCLASSED, EgoMotion, Float32Array, NeighbourMotion, Reason, ReasonKind
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
    same = _labels_by_flow(rig, observation, parameters.max_drone_pixels)
    table = np.full(256, UNCLASSED, np.uint8)
    table[list(same.keys())] = list(same.values())
    pairs: dict[int, list[PointPairs]] = {after: [] for after in same.values()}
    for camera, before, after, flow in _seen_twice(rig, observation):
        if before.depth is None or after.depth is None:
            continue
        relabelled = np.asarray(cv2.LUT(before.labels, table), np.uint8)
        for label, found in pairs.items():
            pixels = label_pixels(relabelled, label, parameters.max_drone_pixels)
            if len(pixels):
                lifted = lift_matches(
                    camera, pixels, flow, before.depth, after.depth, relabelled, after.labels,
                    max_depth_m=parameters.max_depth_m,
                )  # fmt: skip
                found.append(lifted)
    return {label: PointPairs.concatenate(found) if found else None for label, found in pairs.items()}


def _seen_twice(
    rig: Rig, observation: Observation
) -> Iterator[tuple[RigCamera, CameraObservation, CameraObservation, Float32Array]]:
    """Each camera with an image before and now: the camera, both, and the flow between them."""
    if observation.previous is not None:
        for name, flow in observation.flows.items():
            yield rig.cameras[name], observation.previous.cameras[name], observation.cameras[name], flow


def _labels_by_flow(rig: Rig, observation: Observation, max_pixels: int) -> dict[int, int]:
    """Previous label -> current label: where most of a drone's pixels flow to. One to one."""
    votes: dict[tuple[int, int], int] = {}
    detections = observation.previous.detections if observation.previous else ()
    for camera, before, after, flow in _seen_twice(rig, observation):
        height, width = before.labels.shape
        for detection in detections:
            if camera.name not in detection.cameras:
                continue
            pixels = label_pixels(before.labels, detection.label, max_pixels)
            if not len(pixels):
                continue
            start = pixels.astype(np.int64)
            end = np.floor(pixels + flow[start[:, 1], start[:, 0]]).astype(np.int64)
            inside = (end[:, 0] >= 0) & (end[:, 0] < width) & (end[:, 1] >= 0) & (end[:, 1] < height)
            landed, counts = np.unique(after.labels[end[inside, 1], end[inside, 0]], return_counts=True)
            for label, count in zip(landed, counts, strict=True):
                if 0 < label < UNCLASSED:
                    key = (detection.label, int(label))
                    votes[key] = votes.get(key, 0) + int(count)
    same: dict[int, int] = {}
    for before_label, after_label in sorted(votes, key=lambda pair: -votes[pair]):
        if before_label not in same and after_label not in same.values():
            same[before_label] = after_label
    return same
