"""Least squares over places and lenses, with how well each number is known; and which views do not fit the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from flockd.core.messages import BoolArray, FloatArray, IntArray
from flockd.flight.geometry import Camera, RigidTransform
from flockd.flight.geometry.rotations import rotation_from_vector
from flockd.ground.calibration.board import BoardDetection, CalibrationError

_STEP = 1.5e-8
"""Of a numeric derivative: the root of double precision."""
_MAX_STEPS, _GAIN = 60, 1e-10
"""A fit ends after so many, or where a step gains no larger share: of the squares, or of the numbers."""
_UNKNOWN = 1e-13
"""Least eigenvalue of a scaled normal matrix: what is less is rounding."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Numbers that each of several things has; a residual hangs on those of one of them."""

    start: FloatArray
    """(things, numbers)"""
    of: IntArray
    """(residuals,) on which thing each hangs; -1: on none."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the squares are least."""

    numbers: tuple[FloatArray, ...]
    """As `Unknowns.start`, of each."""
    sigma: tuple[FloatArray, ...]
    """Their standard deviations, from what is left over: what noise alone leaves open."""


def fitted(residuals: Callable[[Sequence[FloatArray]], FloatArray], unknowns: Sequence[Unknowns]) -> Fit:
    """``residuals`` (m,) of numbers as `Fit` has them. Raises CalibrationError where they fit nothing to begin with."""
    ends = np.cumsum([0, *(one.start.size for one in unknowns)])

    def split(x: FloatArray) -> tuple[FloatArray, ...]:
        return tuple(
            x[first:end].reshape(one.start.shape) for one, first, end in zip(unknowns, ends[:-1], ends[1:], strict=True)
        )

    def derivative(x: FloatArray) -> FloatArray:
        """(m, n): the same number of all things is moved at once, as no residual hangs on two of them."""
        here = residuals(split(x))
        found = np.zeros((len(here), len(x)))
        for one, first, end in zip(unknowns, ends[:-1], ends[1:], strict=True):
            width, rows = one.start.shape[1], np.flatnonzero(one.of >= 0)
            for number in range(width):
                columns = np.arange(first + number, end, width)
                there = x.copy()
                there[columns] += _STEP * np.maximum(np.abs(x[columns]), 1.0)
                own = columns[one.of[rows]]
                found[rows, own] = (residuals(split(there)) - here)[rows] / (there - x)[own]
        return np.nan_to_num(found)

    start = np.concatenate([one.start.ravel() for one in unknowns])
    if not np.isfinite(residuals(split(start))).all():
        raise CalibrationError("what is seen contradicts itself; check the board's squares and the cameras' intrinsics")
    found = least_squares(
        lambda x: residuals(split(x)), start, derivative, x_scale="jac", xtol=_GAIN, ftol=_GAIN, max_nfev=_MAX_STEPS
    )
    hessian = found.jac.T @ found.jac
    scale = np.sqrt(np.diag(hessian))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    variance = 2.0 * found.cost / max(len(found.fun) - len(start), 1)
    sigma = np.sqrt(variance * (vectors**2 @ (1.0 / np.maximum(values, _UNKNOWN)))) / scale
    return Fit(split(found.x), split(sigma))


def steps_from(poses: Sequence[RigidTransform]) -> FloatArray:
    """(n, 6) the steps of `moved` that leave each pose where it is."""
    return np.array([[0.0, 0.0, 0.0, *pose.translation] for pose in poses]).reshape(-1, 6)


def moved(poses: Sequence[RigidTransform], steps: FloatArray) -> list[RigidTransform]:
    """Each turned by ``steps[:, :3]`` radians about its own origin, which comes to ``steps[:, 3:]`` metres."""
    turns = rotation_from_vector(steps[:, :3])
    return [
        RigidTransform(turn @ pose.rotation, step[3:]) for turn, pose, step in zip(turns, poses, steps, strict=True)
    ]


@dataclass(frozen=True)
class OutlierRejection:
    """Drops what has a large residual and fits again, until nothing has."""

    margin_px: float
    """Above the median's residual, nothing within this is an outlier."""
    factor: float = 2.5
    """Nor is anything within this times the median's."""
    max_dropped: float = 1 / 3
    """Share of all; where more contradict the others, it is not known which are right."""
    max_rounds: int = 5

    def inliers(self, rms_px: FloatArray) -> BoolArray:
        """Mask (n,) of what is kept, of residuals (n,)."""
        median = float(np.median(rms_px))
        kept: BoolArray = rms_px <= max(self.factor * median, median + self.margin_px)
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
    for turn, place in zip(turns, places, strict=True):
        if np.isfinite(turn).all() and np.isfinite(place).all():
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
