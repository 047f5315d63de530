"""Regions of interest: the direction and width of a virtual camera that may show a drone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import Rig, RigCamera
from flockd.flight.perception.detection.instances import Instance

_BORDER_PX = 2
"""A box so near to the image's border is cut by it: the first stage's maps have two image pixels a pixel."""


@dataclass(frozen=True)
class CropRules:
    """How crops are to be cut for a network, as its manifest says: as those that it was trained on."""

    fill: float
    """Half of the crop's width over the drone's size, both as seen from the camera."""
    first_margin: float
    """Half of the first crop's width over the way from a box's centre to its farthest corner."""
    cut_margin: float
    """The same where the image's border cuts the box: the drone is larger than what is seen of it."""
    mirror_scale: float
    """Width of the mirrored crop over what suits the drone."""
    min_half_width_px: float
    """In pixels of the camera's image."""
    max_half_angle: float
    max_resize: float
    """A further crop is at most this many times as wide as the last one, and at least as much narrower."""
    max_crops: int
    """The most crops of one proposal, before the mirrored one."""

    def fitting(self, size_m: FloatArray, range_m: FloatArray) -> FloatArray:
        """(n,) half the angle, rad, of crops that suit drones of known size and range (n,)."""
        return np.asarray(np.arctan(self.fill * size_m / range_m))

    def bounded(self, half_angle: FloatArray, pixel_angle: FloatArray) -> FloatArray:
        """(n,) within what the network was trained on. ``pixel_angle`` (n,): rad a pixel of the image there."""
        return np.minimum(np.maximum(half_angle, self.min_half_width_px * pixel_angle), self.max_half_angle)


class Roi(NamedTuple):
    """A region of interest: a square virtual camera's direction and field of view."""

    direction: FloatArray
    """(3,) unit vector, body FRD."""
    half_angle: float
    """rad, from its centre to its borders."""


def rois_of_instances(camera: RigCamera, instances: Sequence[Instance], rules: CropRules) -> list[Roi | None]:
    """Around boxes of the first stage; None where the lens images nothing there."""
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
    directions = middle @ camera.T_body_camera.rotation.T
    return [Roi(*roi) if one else None for one, *roi in zip(known.tolist(), directions, half_angle, strict=True)]


def pixel_angles(rig: Rig, cameras: Sequence[Sequence[str]], directions: FloatArray) -> FloatArray:
    """(n,) rad a pixel along body directions (n, 3), each of the camera that sees the finest there among those named.

    Infinity where none of them sees it.
    """
    finest = np.full(len(directions), np.inf)
    for name, camera in rig.cameras.items():
        angles = camera.camera.pixel_angle(directions @ camera.T_body_camera.rotation)
        named = np.array([name in names for names in cameras], np.bool_)
        finest = np.where(named & (angles > 0.0), np.minimum(angles, finest), finest)
    return finest


def angles_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """(...) rad, between vectors (..., 3)."""
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray(np.arccos(np.clip((a * b).sum(-1) / lengths, -1, 1)))
