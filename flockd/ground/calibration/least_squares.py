"""Least squares over places and lenses, with how well each number is known; and which views do not fit the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from flockd.core.messages import BoolArray, FloatArray, IntArray
from flockd.flight.geometry import RigidTransform
from flockd.flight.geometry.rotations import rotation_from_vector
from flockd.ground.calibration.errors import CalibrationError

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
