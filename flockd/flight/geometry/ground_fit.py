"""The ground as a plane, fitted to the ranges of what is seen of it around the drone, and the scale of these ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.robust.kernels import Kernel, Tukey, median, reweighted

RELIEF = 0.03
"""Standard deviation of what the ground departs from its plane, as a share of the range, straight below; it grows with
the distance from there."""
NEAR_EXPECTED = 0.35
"""A point counts as ground if its inverse range is within this share of the expected plane's."""
REACH = 3.0
"""How far from the point below the drone the ground is used, in heights."""
MIN_POINTS = 60
MIN_AGREEING = 0.4
"""Least share of the points: with fewer, what is there is no plane."""
ROUNDS = 8
MEDIAN_DEVIATIONS = 6.0
"""Beyond so many of the residuals' median size a point counts nothing."""
TRACK_WIDTH = 0.2
"""Standard deviation, in heights, of the distance at which a measured place still says what is seen beside it."""
BESIDE = 2.0
"""In that unit: what is seen farther from every measured place does not count."""
MIN_TRACK_POINTS = 40
MIN_TRACK_SPAN = 0.5
"""In heights: of the measured places in view; over less, a single bump decides."""
MAX_SEEN = 1000
"""Points; of more some are left out evenly, as four times as many say the same."""
TRACK_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class GroundSamples:
    """Points seen, by their direction and inverse range, with level axes at the drone's place."""

    rays: FloatArray
    """(n, 3) NED unit vectors."""
    inverse: FloatArray
    """(n,) one over the range."""
    offsets: FloatArray
    """(n, 3) NED, of the camera from the body's origin, in the same unit as the range."""
    sigma: FloatArray
    """(n,) standard deviation of `inverse`."""

    def select(self, chosen: BoolArray) -> GroundSamples:
        """Those of a mask (n,)."""
        return GroundSamples(self.rays[chosen], self.inverse[chosen], self.offsets[chosen], self.sigma[chosen])

    @staticmethod
    def concatenate(parts: list[GroundSamples]) -> GroundSamples:
        """All together."""
        return GroundSamples(
            np.concatenate([part.rays for part in parts]), np.concatenate([part.inverse for part in parts]),
            np.concatenate([part.offsets for part in parts]), np.concatenate([part.sigma for part in parts]),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FittedGround:
    """A plane under the drone."""

    height: float
    """Height of the body's origin above it, straight down, in the samples' unit."""
    slope: FloatArray
    """(2,) rise for each metre to the north and to the east."""


def fit_ground(samples: GroundSamples, height: float, slope: FloatArray) -> FittedGround:
    """The plane that most of the samples near an expected one lie on.

    What stands on the ground is nearer than it and does not count. Raises ValueError where too little ground is seen.
    """
    normal = np.array([*slope, 1.0])
    expected = samples.rays @ normal / (height - samples.offsets @ normal)
    level = np.hypot(samples.rays[:, 0], samples.rays[:, 1])
    near = (samples.rays[:, 2] > 0.0) & (level < REACH * samples.rays[:, 2])
    near &= np.abs(samples.inverse - expected) < NEAR_EXPECTED * expected
    if near.sum() < MIN_POINTS:
        raise ValueError("too little ground is seen to fit a plane")
    ground = samples.select(near)
    away = level[near] / ground.rays[:, 2]
    spread = np.hypot(ground.sigma, RELIEF * (1.0 + away) * expected[near])
    rows = _rows(ground) / spread
    plane, weights = reweighted(
        lambda weights, _: _fitted(rows, weights),
        lambda plane: _residuals(ground, plane) / spread,
        _tukey,
        np.ones(len(spread)),
        rounds=ROUNDS,
    )
    if (weights > 0.5).mean() < MIN_AGREEING:
        raise ValueError("the ground that is seen is no plane")
    return FittedGround(float(plane[0]), plane[1:].copy())


def _rows(ground: GroundSamples) -> FloatArray:
    """(4, n) whose first three, times height and slope, make the last. A point at inverse range w is on the plane where
    ``n . (ray + w offset) = w height``."""
    x, y, z = (ground.rays + ground.inverse[:, None] * ground.offsets).T
    return np.stack([ground.inverse, -x, -y, z])


def _fitted(rows: FloatArray, weights: FloatArray) -> FloatArray:
    """(3,) height and slope."""
    products = (rows * weights) @ rows.T
    return np.asarray(np.linalg.solve(products[:3, :3], products[:3, 3]), np.float64)


def _residuals(ground: GroundSamples, plane: FloatArray) -> FloatArray:
    """(n,) of the inverse range."""
    normal = np.array([plane[1], plane[2], 1.0])
    left: FloatArray = ground.inverse - ground.rays @ normal / (plane[0] - ground.offsets @ normal)
    return left


def _tukey(left: FloatArray) -> Kernel:
    return Tukey(max(MEDIAN_DEVIATIONS * median(np.abs(left)), 1e-6))


def scale_on_track(samples: GroundSamples, track: FloatArray, slope: FloatArray, factor: float) -> float:
    """The factor by which the samples' unit has to be multiplied so that they lie on the measured ground.

    Between the places the ground continues with its slope. Things on the ground are outliers: the median counts.

    Args:
        samples: in any unit.
        track: (k, 3) metres NED from the drone, places on the ground.
        slope: (2,) of the ground, to the north and to the east.
        factor: a first estimate of the result.

    Raises ValueError where too little is seen of the places.
    """
    down_m = float(np.median(track[:, 2])) if len(track) else 0.0
    reach_m = TRACK_WIDTH * down_m
    if not reach_m > 0.0:
        raise ValueError("no place on the ground was measured")
    seen = (samples.rays / samples.inverse[:, None] + samples.offsets)[samples.rays[:, 2] > 0.0]
    margin_m = 2.0 * BESIDE * reach_m  # more than the factor's change below can move a point
    around = (factor * seen[:, :2] > track[:, :2].min(axis=0) - margin_m).all(axis=1)
    around &= (factor * seen[:, :2] < track[:, :2].max(axis=0) + margin_m).all(axis=1)
    seen = seen[around]
    seen = seen[:: -(-len(seen) // MAX_SEEN) or 1]
    x, y, z = seen.T
    # With the slope, a place says as much of the ground at x, y as its height where the slope is taken out.
    level = track[:, 2] + track[:, :2] @ slope
    for _ in range(TRACK_ROUNDS):
        away_x, away_y = (
            (factor * at[:, None] - place) / reach_m for at, place in ((x, track[:, 0]), (y, track[:, 1]))
        )
        away2 = away_x * away_x + away_y * away_y
        weights = np.exp(-0.5 * away2) * (away2 < BESIDE**2)
        total = weights.sum(axis=1)
        beside = total > 0.0
        if beside.sum() < MIN_TRACK_POINTS:
            raise ValueError("too little is seen of the ground that was measured")
        expected = (weights @ level)[beside] / total[beside] - factor * (seen[beside, :2] @ slope)
        factor = float(np.median(expected / z[beside]))
    used = track[(weights > 0.0).any(axis=0), :2]
    if float(np.linalg.norm(np.ptp(used, axis=0))) < MIN_TRACK_SPAN * down_m:
        raise ValueError("too little is seen of the ground that was measured")
    return factor
