"""Fits a plane to the visible ground around a place near the drone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.pairs import Columns
from flockd.flight.geometry.robust.kernels import median, tukey

RELIEF = 0.03
"""Standard deviation of the ground's departure from its plane at the place, relative to the range; it grows with
distance from the place."""
NEAR_EXPECTED = 0.35
"""Largest deviation of a ground point's inverse range from the expected plane's, as a share."""
REACH = 1.0
"""Radius around the place in which the ground is used, in heights: the larger, the less it is a plane."""
MIN_POINTS = 60
MIN_AGREEING = 0.4
"""Least share of points that agree with the plane."""
ROUNDS = 8
MEDIAN_DEVIATIONS = 6.0
"""Residuals beyond this many median deviations have no weight."""


@dataclass(frozen=True, eq=False)
class GroundSamples(Columns):
    """Points by direction and inverse range, in level axes with the drone at the origin."""

    rays: FloatArray
    """(n, 3) NED unit vectors."""
    inverse: FloatArray
    """(n,) one over the range."""
    offsets: FloatArray
    """(n, 3) NED, of the camera from the body's origin, in the same unit as the range."""
    sigma: FloatArray
    """(n,) standard deviation of `inverse`."""


def fit_ground(samples: GroundSamples, height: float, slope: FloatArray, place: FloatArray) -> tuple[float, FloatArray]:
    """The plane that most of the samples around a place lie on: its `height` and `slope`, given expected ones.

    What stands on the ground is nearer than the ground and is rejected. Raises ValueError if too little ground is seen.

    Args:
        samples: in a unit of about a metre.
        height: of the body's origin above the plane, straight down, in the samples' unit.
        slope: (2,) rise for each metre to the north and to the east.
        place: (2,) north and east, in the samples' unit.
    """
    normal = np.array([*slope, 1.0])
    expected = samples.rays @ normal / (height - samples.offsets @ normal)
    with np.errstate(divide="ignore"):  # zero above the horizon
        level = samples.rays[:, :2] / np.maximum(expected, 0.0)[:, None] - place
    away = np.hypot(*level.T) / height
    near = (away < REACH) & (np.abs(samples.inverse - expected) < NEAR_EXPECTED * expected)
    if near.sum() < MIN_POINTS:
        raise ValueError("too little ground is seen to fit a plane")
    ground = samples[near]
    spread = np.hypot(ground.sigma, RELIEF * (1.0 + away[near]) * expected[near])
    # A point at inverse range w is on the plane if n . (ray + w offset) = w height: linear in height and slope.
    x, y, z = (ground.rays + ground.inverse[:, None] * ground.offsets).T
    rows, weights = np.stack([ground.inverse, -x, -y, z]) / spread, np.ones(len(spread))
    for _ in range(ROUNDS):
        products = (rows * weights) @ rows.T
        height, *rise = np.linalg.solve(products[:3, :3], products[:3, 3]).tolist()
        normal = np.array([*rise, 1.0])
        left = (ground.inverse - ground.rays @ normal / (height - ground.offsets @ normal)) / spread
        weights = tukey(left**2, max(MEDIAN_DEVIATIONS * median(np.abs(left)), 1e-6))
    if (weights > 0.5).mean() < MIN_AGREEING:
        raise ValueError("the ground that is seen is no plane")
    return height, np.array(rise)
