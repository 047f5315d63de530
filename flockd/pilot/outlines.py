"""Which pixels are whose where the second stage looked: finer than the whole image's map, and each drone by itself."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flockd.geometry import RigCamera, VirtualCrop
from flockd.messages import UNCLASSED, Detection, Float32Array, FloatArray, UInt8Array
from flockd.pilot.colours import weigh_by_colour

_TO_THE_CORNERS = 1.5
"""Of a picture, from its middle, as a share of the way to its borders."""
_SURELY_NOT = -20.0


@dataclass(frozen=True, eq=False)
class Mask:
    """Which pixels of a picture are its drone's."""

    crop: VirtualCrop
    logit: Float32Array
    """(size, size)"""
    half_angle: float


@dataclass(frozen=True, eq=False)
class Claim:
    """What the networks say of one drone's pixels."""

    label: int
    box: tuple[slice, slice]
    """The part of the image that they tell of."""
    logit: Float32Array
    """Of each of its pixels being this drone's."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """One camera's drones, to be drawn as (h, w) labels: 0 background, k the detection with label k, 255 unused."""

    labels: UInt8Array
    """As the first stage alone has them."""
    claims: tuple[Claim, ...] = ()

    def by_networks(self) -> UInt8Array:
        """As both stages say."""
        return _painted(self.labels, self.claims)

    def by_colours(self, image: UInt8Array) -> UInt8Array:
        """As the colours of the image (h, w, 3) say too; a drone and another before it may be painted alike."""
        weighed = (replace(claim, logit=weigh_by_colour(claim.logit, image[claim.box])) for claim in self.claims)
        return _painted(self.labels, weighed)


class Outliner:
    """Finds out which pixels of one camera are whose."""

    def __init__(self, camera: RigCamera, stride: int) -> None:
        """``stride``: image pixels per pixel of the first stage's map."""
        self._camera, self._stride = camera, stride
        width, height = camera.camera.size
        # A pixel of the map tells of the last one of its block: those are the ones that networks are trained on.
        u, v = np.meshgrid(*(np.arange(stride, size + 1, stride) - 0.5 for size in (width, height)))
        rays = camera.camera.rays(np.stack([u.ravel(), v.ravel()], 1)) @ camera.T_body_camera.rotation.T
        self._rays: Float32Array = np.asarray(rays.reshape(*u.shape, 3), dtype=np.float32)

    def outlines(
        self,
        labels: UInt8Array,
        logit: Float32Array,
        detections: Sequence[Detection],
        masks_of: Mapping[int, Sequence[Mask]],
    ) -> Outlines:
        """What both stages say of each detection's pixels.

        Args:
            labels: (h, w) as the first stage alone has them.
            logit: (h / stride, w / stride) of a pixel being any drone's, as the first stage says.
            detections: of the whole rig.
            masks_of: the second stage's, by the detection's label; none where it does not tell.
        """
        claims = []
        for detection in detections:
            masks = masks_of[detection.label]
            if self._camera.name not in detection.cameras or not masks:
                continue
            box, said = self._said(detection.position, masks, logit)
            if said.size:
                claims.append(Claim(detection.label, box, said))
        return Outlines(labels, tuple(claims))

    def _said(
        self, position: FloatArray, masks: Sequence[Mask], logit: Float32Array
    ) -> tuple[tuple[slice, slice], Float32Array]:
        """A part of the image, and the logit of each of its pixels being this drone's.

        The pictures' mean, and what the first stage says of the pixel being any drone's, add up.
        """
        stride, range_m = self._stride, float(np.linalg.norm(position))
        widest = min(_TO_THE_CORNERS * max(mask.half_angle for mask in masks), math.pi / 2)
        rows, columns = np.nonzero(self._rays @ (position / range_m).astype(np.float32) > math.cos(widest))
        if not len(rows):
            return (slice(0), slice(0)), np.zeros((0, 0), np.float32)
        points = self._camera.T_body_camera.translation + range_m * self._rays[rows, columns].astype(np.float64)
        seen = np.stack([mask.crop.look_up(mask.logit, points) for mask in masks])
        told = np.isfinite(seen)
        top, left, bottom, right = rows.min(), columns.min(), rows.max() + 1, columns.max() + 1
        mean = np.where(told, seen, 0.0).sum(0) / np.maximum(told.sum(0), 1)
        said = np.full((bottom - top, right - left), _SURELY_NOT, np.float32)
        said[rows - top, columns - left] = np.where(told.any(0), mean + logit[rows, columns], _SURELY_NOT)
        size = int(right - left) * stride, int(bottom - top) * stride
        back = np.array([[1.0, 0.0, 1.0 - stride], [0.0, 1.0, 1.0 - stride]]) / stride
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        fine = cv2.warpAffine(said, back, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        box = slice(top * stride, bottom * stride), slice(left * stride, right * stride)
        return box, np.asarray(fine, np.float32)


def _painted(labels: UInt8Array, claims: Iterable[Claim]) -> UInt8Array:
    """Each drone where its logit is above 0; of those that claim a pixel, the surest."""
    drawn, highest = labels.copy(), np.zeros(labels.shape, np.float32)
    for claim in claims:
        mine = claim.logit > highest[claim.box]
        drawn[drawn == claim.label] = UNCLASSED  # the pictures hold all of the drone: whose is the rest?
        drawn[claim.box][mine] = claim.label
        highest[claim.box][mine] = claim.logit[mine]
    return drawn
