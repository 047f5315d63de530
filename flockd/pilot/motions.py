"""From two rig views and the flow between them to the own motion and the neighbours' motions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flockd.config.geometry import GeometryParameters
from flockd.geometry import (
    PointPairs,
    Rig,
    estimate_ego_motion,
    estimate_neighbour_motion,
    grid_pixels,
    label_pixels,
    lift_matches,
)
from flockd.messages import UNCLASSED, EgoMotion, Float32Array, NeighbourMotion
from flockd.pilot.views import RigView

_PIXELS_A_DRONE = 300
_MIN_DRONE_PAIRS = 12


def ego_motion(
    rig: Rig, previous: RigView, current: RigView, flows: Mapping[str, Float32Array], parameters: GeometryParameters
) -> EgoMotion:
    """The drone's own motion from the background (Eq. 7-21). ``ValueError`` says why there is none."""
    pairs = background_pairs(rig, previous, current, flows, parameters)
    return estimate_ego_motion(pairs, rig, current.time_s - previous.time_s, parameters)


def background_pairs(
    rig: Rig, previous: RigView, current: RigView, flows: Mapping[str, Float32Array], parameters: GeometryParameters
) -> PointPairs:
    """What stands still, seen in both views by the same camera. ``ValueError`` says why there is nothing."""
    pairs = []
    for name, flow in flows.items():
        camera = rig.cameras[name]
        before, after = previous.cameras[name], current.cameras[name]
        lifted = lift_matches(
            camera, grid_pixels(camera.camera.size, parameters.background_stride_px), flow,
            before.depth, after.depth, before.labels, after.labels, max_depth_m=parameters.max_depth_m,
        )  # fmt: skip
        pairs.append(lifted.select(lifted.labels == 0))
    if not pairs:
        raise ValueError("no camera has both frames")
    return PointPairs.concatenate(pairs)


def neighbour_motions(
    rig: Rig,
    previous: RigView,
    current: RigView,
    flows: Mapping[str, Float32Array],
    ego: EgoMotion,
    parameters: GeometryParameters,
) -> tuple[dict[int, NeighbourMotion], list[str]]:
    """The motion of every neighbour in both views, by its current label (Eq. 22-37), and why some have none."""
    motions: dict[int, NeighbourMotion] = {}
    reasons = []
    for label, pairs in neighbour_pairs(rig, previous, current, flows, parameters).items():
        if pairs is None or len(pairs) < _MIN_DRONE_PAIRS:
            reasons.append("neighbour motion: too few point pairs")
            continue
        try:
            motions[label] = estimate_neighbour_motion(pairs, ego, parameters)
        except ValueError as error:
            reasons.append(f"neighbour motion: {error}")
    return motions, reasons


def neighbour_pairs(
    rig: Rig, previous: RigView, current: RigView, flows: Mapping[str, Float32Array], parameters: GeometryParameters
) -> dict[int, PointPairs | None]:
    """What belongs to each neighbour in both views, by its current label."""
    same = _labels_by_flow(previous, current, flows)
    table = np.full(256, UNCLASSED, np.uint8)
    for before, after in same.items():
        table[before] = after
    pairs: dict[int, list[PointPairs]] = {after: [] for after in same.values()}
    for name, flow in flows.items():
        camera = rig.cameras[name]
        relabelled = table[previous.cameras[name].labels]
        for label, found in pairs.items():
            pixels = label_pixels(relabelled, label, _PIXELS_A_DRONE)
            if len(pixels):
                lifted = lift_matches(
                    camera, pixels, flow, previous.cameras[name].depth, current.cameras[name].depth,
                    relabelled, current.cameras[name].labels, max_depth_m=parameters.max_depth_m,
                )  # fmt: skip
                found.append(lifted)
    return {label: PointPairs.concatenate(found) if found else None for label, found in pairs.items()}


def _labels_by_flow(previous: RigView, current: RigView, flows: Mapping[str, Float32Array]) -> dict[int, int]:
    """Previous label -> current label: where most of a drone's pixels flow to. One to one."""
    votes: dict[tuple[int, int], int] = {}
    for name, flow in flows.items():
        before, after = previous.cameras[name].labels, current.cameras[name].labels
        height, width = before.shape
        for detection in previous.detections:
            if name not in detection.cameras:
                continue
            pixels = label_pixels(before, detection.label, _PIXELS_A_DRONE)
            if not len(pixels):
                continue
            start = pixels.astype(np.int64)
            end = np.floor(pixels + flow[start[:, 1], start[:, 0]]).astype(np.int64)
            inside = (end[:, 0] >= 0) & (end[:, 0] < width) & (end[:, 1] >= 0) & (end[:, 1] < height)
            landed, counts = np.unique(after[end[inside, 1], end[inside, 0]], return_counts=True)
            for label, count in zip(landed, counts, strict=True):
                if 0 < label < UNCLASSED:
                    key = (detection.label, int(label))
                    votes[key] = votes.get(key, 0) + int(count)
    same: dict[int, int] = {}
    for before_label, after_label in sorted(votes, key=lambda pair: -votes[pair]):
        if before_label not in same and after_label not in same.values():
            same[before_label] = after_label
    return same
