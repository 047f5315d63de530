"""Masks: which pixels are which drone's, from the crops of the second stage, the first stage's map and colours."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from flockd.core.messages import UNCLASSED, Detection, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import RangeMap, RigCamera, VirtualCrop
from flockd.flight.perception.detection.colour_model import reweight_by_colour
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.maps import SceneMaps

_CROP_CORNERS = 1.5
"""Angle to the corners of a crop over that to its borders, and a little more: sqrt(2) for a narrow one."""
_CERTAINLY_NOT = -20.0
"""Logit of a pixel outside every crop: a probability of 2e-9, which no weight of colours brings above one half."""


@dataclass(frozen=True, eq=False)
class CropMask:
    """Which pixels of a crop are its drone's."""

    view: VirtualCrop
    logit: Float32Array
    """(size, size)"""
    half_angle: float


@dataclass(frozen=True, eq=False)
class DroneLogits:
    """The networks' outputs for one drone's pixels."""

    label: int
    box: tuple[slice, slice]
    """The part of the image that it covers."""
    logit: Float32Array
    """Logit of each of its pixels showing this drone."""


@dataclass(frozen=True, eq=False)
class DroneMasks:
    """One camera's drones, to be drawn as (h, w) labels: 0 background, k the detection with label k, 255 unused."""

    labels: UInt8Array
    """As the first stage alone has them."""
    drones: tuple[DroneLogits, ...] = ()

    def by_networks(self) -> UInt8Array:
        """As both stages say."""
        return _draw(self.labels, self.drones)

    def by_colours(self, image: UInt8Array, weight: float) -> UInt8Array:
        """As the colours of the image (h, w, 3) say too; a drone and another before it may be painted alike."""
        reweighted = (
            replace(drone, logit=reweight_by_colour(drone.logit, image[drone.box], weight)) for drone in self.drones
        )
        return _draw(self.labels, reweighted)


class MaskRenderer:
    """Transfers the crops' masks to the image of one camera."""

    def __init__(self, camera: RigCamera, stride: int) -> None:
        """``stride``: image pixels per pixel of the first stage's map."""
        self._camera, self._stride = camera, stride
        self._rays = _block_rays(camera, stride)

    def render(
        self,
        labels: UInt8Array,
        logit: Float32Array,
        detections: Sequence[Detection],
        masks_of: Mapping[int, Sequence[CropMask]],
    ) -> DroneMasks:
        """What both stages say of each detection's pixels.

        Args:
            labels: (h, w) as the first stage alone has them.
            logit: (h / stride, w / stride) of a pixel being any drone's, as the first stage says.
            detections: of the whole rig.
            masks_of: the second stage's, by the detection's label; none where it has none.
        """
        drones = []
        for detection in detections:
            masks = masks_of[detection.label]
            if self._camera.name not in detection.cameras or not masks:
                continue
            box, drone_logit = self._drone_logit(detection.bearing, detection.range_m, masks, logit)
            if drone_logit.size:
                drones.append(DroneLogits(detection.label, box, drone_logit))
        return DroneMasks(labels, tuple(drones))

    def _drone_logit(
        self, bearing: FloatArray, range_m: float, masks: Sequence[CropMask], logit: Float32Array
    ) -> tuple[tuple[slice, slice], Float32Array]:
        """A part of the image, and the logit of each of its pixels being this drone's.

        The crops' mean, and what the first stage says of the pixel being any drone's, add up.
        """
        stride = self._stride
        widest = min(_CROP_CORNERS * max(mask.half_angle for mask in masks), math.pi / 2)
        near = cv2.transform(self._rays, bearing[None].astype(np.float32)) > math.cos(widest)
        left, top, width, height = cv2.boundingRect(near.view(np.uint8))
        if not width:
            return (slice(0), slice(0)), np.zeros((0, 0), np.float32)
        part = np.s_[top : top + height, left : left + width]
        rays = self._rays[part].reshape(-1, 3).astype(np.float64, order="F")
        points = self._camera.T_body_camera.translation + range_m * rays
        crops = np.stack([mask.view.look_up(mask.logit, points).reshape(height, width) for mask in masks])
        covered = np.isfinite(crops) & near[part]
        mean = np.where(covered, crops, np.float32(0)).sum(0) / np.maximum(covered.sum(0), 1)
        coarse = np.where(covered.any(0), mean + logit[part], _CERTAINLY_NOT).astype(np.float32)
        size = width * stride, height * stride
        back = np.array([[1.0, 0.0, 1.0 - stride], [0.0, 1.0, 1.0 - stride]]) / stride
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        fine = cv2.warpAffine(coarse, back, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        box = slice(top * stride, (top + height) * stride), slice(left * stride, (left + width) * stride)
        return box, np.asarray(fine, np.float32)


@lru_cache(maxsize=32)
def _block_rays(camera: RigCamera, stride: int) -> Float32Array:
    """(h / stride, w / stride, 3) unit vectors in the body, of the map's pixels."""
    width, height = camera.camera.size
    # A pixel of the map stands for the last one of its block: those are the ones that networks are trained on.
    u, v = np.meshgrid(*(np.arange(stride, size + 1, stride) - 0.5 for size in (width, height)))
    rays = camera.camera.rays(np.stack([u.ravel(), v.ravel()], 1)) @ camera.T_body_camera.rotation.T
    return np.asarray(rays.reshape(*u.shape, 3), dtype=np.float32)


def _draw(labels: UInt8Array, drones: Iterable[DroneLogits]) -> UInt8Array:
    """Each drone where its logit is above 0; a pixel of several is the one's with the highest."""
    drawn, highest = labels.copy(), np.zeros(labels.shape, np.float32)
    for drone in drones:
        mine = drone.logit > highest[drone.box]
        # The crops hold all of the drone: whose these are is not known.
        np.copyto(drawn, UNCLASSED, where=drawn == drone.label)
        np.copyto(drawn[drone.box], drone.label, where=mine)
        np.copyto(highest[drone.box], drone.logit, where=mine)
    return drawn


def first_stage_labels(scene: SceneMaps, label_of: Mapping[int, int], rejected: Container[Instance]) -> UInt8Array:
    """(h, w) the first stage's instances with their detections' labels.

    Background where the second stage rejects them, `UNCLASSED` where it is not certain of them.
    """
    table = np.full(256, UNCLASSED, np.uint8)
    table[0] = 0
    for instance in scene.instances:
        otherwise = 0 if instance in rejected else UNCLASSED
        table[instance.label] = label_of.get(instance.label, otherwise)
    labels = np.zeros_like(scene.labels)
    part = scene.labelled
    labels[part] = cv2.LUT(scene.labels[part], table)
    if scene.uncertain is not None:
        np.copyto(labels[part], UNCLASSED, where=scene.uncertain[part] & (labels[part] > 0))
    return labels


def without_borders(labels: UInt8Array, border_px: int) -> UInt8Array:
    """Background within ``border_px`` of a drone becomes `UNCLASSED`: masks and depth maps are least certain there."""
    drone = cv2.threshold(labels, 0, UNCLASSED, cv2.THRESH_BINARY)[1]
    wide = cv2.dilate(drone, np.ones((2 * border_px + 1, 2 * border_px + 1), np.uint8))
    return np.asarray(cv2.bitwise_or(labels, cv2.bitwise_xor(wide, drone)), np.uint8)  # `UNCLASSED` has all bits


def depth_of_drones(
    depth: RangeMap, labels: UInt8Array, camera: RigCamera, detections: Sequence[Detection]
) -> RangeMap:
    """The depth map (h, w) with each drone's pixels moved to its detection's range; their relief is kept."""
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
