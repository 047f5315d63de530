"""Masks: which pixels belong to which drone, from the first stage's map and the second stage's decisions."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

import cv2
import numpy as np

from flockd.core.messages import UNCLASSED, Detection, UInt8Array
from flockd.flight.geometry import RangeMap, RigCamera
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.maps import SceneMaps


def first_stage_labels(scene: SceneMaps, label_of: Mapping[int, int], rejected: Container[Instance]) -> UInt8Array:
    """(h, w) the first stage's instances, with the labels of their detections.

    Instances that the second stage rejects become background, undecided ones `UNCLASSED`.
    """
    table = np.full(256, UNCLASSED, np.uint8)
    table[0] = 0
    for instance in scene.instances:
        otherwise = 0 if instance in rejected else UNCLASSED
        table[instance.label] = label_of.get(instance.label, otherwise)
    labels = np.zeros_like(scene.labels)
    part = scene.labelled
    labels[part] = cv2.LUT(scene.labels[part], table)
    return labels


def without_borders(labels: UInt8Array, border_px: int) -> UInt8Array:
    """Background within ``border_px`` of a drone becomes `UNCLASSED`: masks and depth maps are least certain there."""
    drone = cv2.threshold(labels, 0, UNCLASSED, cv2.THRESH_BINARY)[1]
    wide = cv2.dilate(drone, np.ones((2 * border_px + 1, 2 * border_px + 1), np.uint8))
    return np.asarray(cv2.bitwise_or(labels, cv2.bitwise_xor(wide, drone)), np.uint8)  # `UNCLASSED` has all bits set


def depth_of_drones(
    depth: RangeMap, labels: UInt8Array, camera: RigCamera, detections: Sequence[Detection]
) -> RangeMap:
    """The depth map (h, w) with each drone's pixels moved to its detection's range, keeping their relief."""
    moved = RangeMap(depth.copy())
    for detection in detections:
        if camera.name not in detection.cameras:
            continue
        mine = labels == detection.label
        if not mine.any():
            continue
        range_m = float(np.linalg.norm(detection.position - camera.T_body_camera.translation))
        relief = depth[mine] - np.nanmedian(depth[mine])
        moved[mine] = range_m + np.clip(relief, -detection.size_m / 2, detection.size_m / 2)
    return moved
