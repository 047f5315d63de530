"""Regions of interest: the direction and width of a virtual camera that may show a drone, and the crops taken there."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import FloatArray, UInt8Array
from flockd.flight.geometry import Rig, RigCamera, VirtualCrop, virtual_crop
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.maps import Crop

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

    def half_angle(self, size_m: float, range_m: float, pixel_angle: float, before: float | None = None) -> float:
        """Half the angle, rad, of a crop that suits a drone of known size and range, not far from what it was.

        ``pixel_angle``: rad a pixel of the camera's image there.
        """
        angle = math.atan(self.fill * size_m / range_m)
        if before is not None:
            angle = min(max(angle, before / self.max_resize), before * self.max_resize)
        return self.bounded(angle, pixel_angle)

    def bounded(self, half_angle: float, pixel_angle: float) -> float:
        """Within what the network was trained on."""
        return min(max(half_angle, self.min_half_width_px * pixel_angle), self.max_half_angle)


@dataclass(frozen=True, eq=False)
class Roi:
    """A region of interest: a square virtual camera's direction and field of view."""

    direction: FloatArray
    """(3,) unit vector, body FRD."""
    half_angle: float
    """rad, from its centre to its borders."""
    range_m: float | None = None
    """Range of what it should show, for the parallax between cameras; None: not known yet."""
    mirrored: bool = False

    def resembles(self, other: Roi, shift: float, resize: float) -> bool:
        """Whether the other's crop would show nearly the same.

        It is moved by less than this share of half the width, and resized by less than this factor.
        """
        moved = angle_between(self.direction, other.direction) / self.half_angle
        resized = abs(math.log(other.half_angle / self.half_angle))
        return moved < shift and resized < math.log(resize)


def roi_of_instance(camera: RigCamera, instance: Instance, rules: CropRules) -> Roi | None:
    """Around a box of the first stage; None where the lens images nothing there."""
    left, top, right, bottom = instance.box
    corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom], instance.centre])
    rays = camera.camera.rays(corners)
    inside = camera.camera.in_image(instance.centre[None])[0] and np.isfinite(rays[4]).all()
    imaged = rays[:4][np.isfinite(rays[:4, 0])]  # a corner may lie outside a fisheye's image circle
    if not len(imaged):
        return None
    centre = rays[4] if inside else imaged.mean(0) / np.linalg.norm(imaged.mean(0))
    reach = float(np.arccos(np.clip(imaged @ centre, -1, 1)).max())
    far_border = np.array(camera.camera.size) - _BORDER_PX
    cut = bool((instance.box[:2] < _BORDER_PX).any() or (instance.box[2:] > far_border).any())
    pixel_angle = float(camera.camera.pixel_angle(centre[None])[0])
    half_angle = rules.bounded((rules.cut_margin if cut else rules.first_margin) * reach, pixel_angle)
    return Roi(camera.T_body_camera.rotation @ centre, half_angle)


def pixel_angle(rig: Rig, cameras: Iterable[str], direction: FloatArray) -> float:
    """rad a pixel along a body direction (3,), of the camera among these that sees the finest there."""
    angles = [
        float(camera.camera.pixel_angle((direction @ camera.T_body_camera.rotation)[None])[0])
        for camera in (rig.cameras[name] for name in cameras)
    ]
    return min(angle for angle in angles if angle > 0.0)


def take_crop(
    rig: Rig, images: Mapping[str, UInt8Array], roi: Roi, size_px: int, evidence: float = 0.0
) -> tuple[Crop, VirtualCrop]:
    """The crop of a region, drawn from whichever cameras of the rig see there, and the virtual camera."""
    view = virtual_crop(rig, roi.direction, roi.half_angle, size_px)
    image, _ = view.sample(images, range_m=roi.range_m)
    return Crop(image, view.camera, view.T_body_virtual, roi.mirrored, evidence), view


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """rad, between two vectors (3,)."""
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1)))
