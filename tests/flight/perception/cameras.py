"""Plain cameras, and crops of them."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import UInt8Array
from flockd.flight.geometry import PinholeCamera, RigCamera, RigidTransform
from flockd.flight.perception import Crop


def pinhole(focal_px: float, size: tuple[int, int]) -> PinholeCamera:
    width, height = size
    matrix = np.array([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]])
    return PinholeCamera(matrix, size)


def camera_of(focal_px: float, size: tuple[int, int]) -> RigCamera:
    return RigCamera("front", pinhole(focal_px, size), RigidTransform(np.eye(3), np.zeros(3)))


def crop_of(image: UInt8Array, focal_px: float, *, mirrored: bool = False) -> Crop:
    size = (image.shape[1], image.shape[0])
    return Crop(np.ascontiguousarray(image), pinhole(focal_px, size), RigidTransform(np.eye(3), np.zeros(3)), mirrored)
