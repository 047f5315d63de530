"""Where a board is before a camera, by one image of it; and which images do not fit the others."""

from __future__ import annotations

import math

import cv2
import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import Camera, RigidTransform, rotation_from_vector
from flockd.ground.calibration.board import BoardDetection

_FACTOR = 2.5
MAX_DROPPED = 1 / 3
"""Share of all; where more contradict the others, it is not known which are right."""


def inliers(rms_px: FloatArray, margin_px: float) -> BoolArray:
    """Mask (n,) of residuals (n,) that are no outliers: within `_FACTOR` times the median, or ``margin_px`` above."""
    median = float(np.median(rms_px))
    kept: BoolArray = rms_px <= max(_FACTOR * median, median + margin_px)
    return kept


def root_mean_square(residuals: FloatArray) -> float:
    """Root of the mean squared length of residuals (n, 2)."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


_NEAREST_ANGLE = 0.15
"""Cosine of the largest angle from the board's middle at which a corner still helps to find a first pose."""


def residuals_px(camera: Camera, seen: BoardDetection, pose: RigidTransform) -> FloatArray:
    """(n, 2) pixels, seen less predicted; ``pose``: ``T_camera_board``."""
    return seen.pixels - camera.project(pose.apply(seen.points))


def first_pose(camera: Camera, seen: BoardDetection) -> tuple[float, RigidTransform | None]:
    """``T_camera_board`` by the board's outline (IPPE), after its residual; none, after infinity, where it fits none.

    Of the two that a flat board may have by its outline the likelier.
    """
    rays = camera.rays(seen.pixels)
    usable = np.isfinite(rays).all(axis=1)
    if not usable.any():
        return math.inf, None
    # Through a pinhole whose axis points straight at the board: so a lens may see the board beside or behind itself.
    R_virtual_camera = _turn_to_axis(rays[usable].mean(axis=0))
    turned = rays @ R_virtual_camera.T
    usable &= turned[:, 2] > _NEAREST_ANGLE
    if usable.sum() < 4:
        return math.inf, None
    flat = turned[usable, :2] / turned[usable, 2:]
    try:
        _, turns, places, _ = cv2.solvePnPGeneric(
            seen.points[usable], flat, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners in one line
        return math.inf, None
    virtual = RigidTransform(R_virtual_camera.T, np.zeros(3))
    best: tuple[float, RigidTransform | None] = (math.inf, None)
    for start in zip(turns, places, strict=True):
        if np.isfinite(start).all():
            turn, place = cv2.solvePnPRefineLM(seen.points[usable], flat, np.eye(3), np.zeros(4), *start)
            pose = virtual @ RigidTransform(rotation_from_vector(np.ravel(turn)), np.ravel(place))
            error = root_mean_square(residuals_px(camera, seen, pose))
            if error < best[0]:
                best = error, pose
    return best


def _turn_to_axis(direction: FloatArray) -> FloatArray:
    """(3, 3) the shortest rotation that takes a direction to the optical axis."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    across = np.cross(unit, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(across))
    if sine < 1e-9:
        return np.eye(3) if unit[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    return rotation_from_vector(across / sine * np.arctan2(sine, unit[2]))
