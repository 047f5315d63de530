"""Masks: which pixels belong to which drone, from the first stage's map and the second stage's decisions."""

from __future__ import annotations

from collections.abc import Container, Mapping

import cv2
import numpy as np

from flockd.core.messages import UNCLASSED, UInt8Array
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
