"""RANSAC (Fischler & Bolles 1981) for a line: the slope and intercept that most points agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.core.messages import FloatArray

_HYPOTHESES = 200
"""Pairs drawn: with a quarter of inliers, one of them is free of outliers all but once in 400,000 times."""
_MAX_POINTS = 3000
"""Points used, drawn at random: the share that agrees with a line is then known to 1 %."""


@dataclass(frozen=True)
class RansacLine:
    """``y = slope x + intercept``."""

    slope: float
    intercept: float


def ransac_line(
    x: FloatArray, y: FloatArray, tolerance: FloatArray, *, intercept: bool, min_inliers: int, min_inlier_ratio: float
) -> RansacLine | None:
    """The line of positive slope with the most points (n,) within their ``tolerance`` (n,), refitted to those.

    A hypothesis goes through two random points, or through one and the origin without ``intercept``. Each inlier is
    weighted by its tolerance. None: no line agrees with ``min_inliers`` points and ``min_inlier_ratio`` of them.
    Deterministic.
    """
    random = np.random.default_rng(0)
    if len(x) > _MAX_POINTS:
        drawn = random.choice(len(x), _MAX_POINTS, replace=False)
        x, y, tolerance = x[drawn], y[drawn], tolerance[drawn]
    if len(x) < min_inliers:
        return None
    slopes, intercepts = _hypotheses(x, y, random, intercept=intercept)
    if not len(slopes):
        return None
    near = np.abs(slopes[:, None] * x + intercepts[:, None] - y) < tolerance
    agreeing = near[int(np.argmax(near.sum(axis=1)))]
    if agreeing.sum() < max(min_inlier_ratio * len(x), min_inliers):
        return None
    columns = [x[agreeing], np.ones(int(agreeing.sum()))] if intercept else [x[agreeing]]
    weights = 1.0 / np.maximum(tolerance[agreeing], 1e-6)
    design = np.stack(columns, axis=1) * weights[:, None]
    solution = np.linalg.lstsq(design, y[agreeing] * weights, rcond=None)[0]
    if not solution[0] > 0.0:
        return None
    return RansacLine(float(solution[0]), float(solution[1]) if intercept else 0.0)


def _hypotheses(
    x: FloatArray, y: FloatArray, random: np.random.Generator, *, intercept: bool
) -> tuple[FloatArray, FloatArray]:
    """Slopes and intercepts (h,) of lines through random points."""
    first, second = random.integers(0, len(x), (2, _HYPOTHESES))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (y[first] - y[second]) / (x[first] - x[second]) if intercept else y[first] / x[first]
        intercepts = y[first] - slopes * x[first] if intercept else np.zeros(_HYPOTHESES)
    usable = np.isfinite(slopes) & (slopes > 0)
    return slopes[usable], intercepts[usable]
