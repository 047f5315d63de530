"""Log-polar coordinates of a position: a bearing (unit vector) and the natural logarithm of the range.

Their covariance is a (3, 3) matrix in the axes of the bearing: along it the variance of the log range, across it that
of the angle in rad^2. To first order it is the covariance of the position over the range squared.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.transform import EYE


def log_polar(position: FloatArray) -> tuple[FloatArray, float]:
    """Bearing (3,) and log range of a position (3,) in metres. Raises ValueError for the origin, NaN and infinity."""
    range_m = float(np.linalg.norm(position))
    if not (math.isfinite(range_m) and range_m > 0.0):
        raise ValueError(f"a place at {np.asarray(position).tolist()} m has no bearing")
    return np.asarray(position, np.float64) / range_m, math.log(range_m)


def log_polar_covariance(bearing: FloatArray, log_range_sigma: float, bearing_sigma_rad: float) -> FloatArray:
    """(3, 3) for independent errors of range and bearing, the bearing's equal in all directions."""
    along = bearing[:, None] * bearing
    covariance: FloatArray = bearing_sigma_rad**2 * (EYE - along) + log_range_sigma**2 * along
    return covariance


def log_polar_residual(
    bearing: FloatArray, log_range: FloatArray | float, from_bearing: FloatArray, from_log_range: FloatArray | float
) -> FloatArray:
    """(..., 3) between positions: across ``from_bearing`` the angle in rad, along it the change of log range.

    Bearings (..., 3), log ranges (...). Its derivative by the position, at the first one, is I / range.
    """
    cosine = np.minimum(np.maximum((bearing * from_bearing).sum(axis=-1, keepdims=True), -1.0), 1.0)
    across = bearing - cosine * from_bearing
    sine = np.sqrt((across**2).sum(axis=-1, keepdims=True))
    turned = across * np.where(sine > 1e-12, np.arctan2(sine, cosine) / np.maximum(sine, 1e-12), 1.0)
    residual: FloatArray = turned + np.subtract(log_range, from_log_range)[..., None] * from_bearing
    return residual
