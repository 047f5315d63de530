"""Regions of interest: direction and width of a virtual camera that may show a drone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import Rig, RigCamera
from flockd.flight.inference.manifest import CropSpec
from flockd.flight.perception.detection.instances import Instance

_BORDER_PX = 2
"""A box this near to the image's border is cut by it: the first stage's maps have two image pixels a pixel."""


class Roi(NamedTuple):
    """A region of interest: a square virtual camera's direction and field of view."""

    direction: FloatArray
    """(3,) unit vector, body FRD."""
    half_angle: float
    """rad, from its centre to its borders."""


def rois_of_instances(camera: RigCamera, instances: Sequence[Instance], rules: CropSpec) -> list[Roi | None]:
    """Regions around boxes of the first stage; None if the lens images nothing there."""
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
    """(n,) rad of a pixel along body directions (n, 3), of the camera with the finest resolution among those named.
    Infinity if none of them sees it."""
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
