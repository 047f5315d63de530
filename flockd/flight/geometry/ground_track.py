"""The scale of what is seen of the ground, from places where its height was measured."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.ground_fit import GroundSamples

WIDTH = 0.2
"""Standard deviation, in heights, of the distance at which a measured place still says what is seen beside it."""
BESIDE = 2.0
"""In that unit: what is seen farther from every measured place does not count."""
MIN_POINTS = 40
MIN_SPAN = 0.5
"""In heights: of the measured places in view; over less, a single bump decides."""
MAX_SEEN = 1000
"""Points; of more some are left out evenly, as four times as many say the same."""
ROUNDS = 3


def scale_on_track(samples: GroundSamples, track: FloatArray, slope: FloatArray, factor: float) -> float:
    """By what the samples' unit has to be multiplied for them to lie on the measured ground.

    Between the places the ground goes on with its slope. What stands on it is an outlier: the median counts.

    Args:
        samples: in any unit.
        track: (k, 3) metres NED from the drone, places on the ground.
        slope: (2,) of the ground, to the north and to the east.
        factor: about what is looked for.

    Raises ValueError where too little is seen of the places.
    """
    down_m = float(np.median(track[:, 2])) if len(track) else 0.0
    reach_m = WIDTH * down_m
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
    for _ in range(ROUNDS):
        away_x, away_y = (
            (factor * at[:, None] - place) / reach_m for at, place in ((x, track[:, 0]), (y, track[:, 1]))
        )
        away2 = away_x * away_x + away_y * away_y
        weights = np.exp(-0.5 * away2) * (away2 < BESIDE**2)
        total = weights.sum(axis=1)
        beside = total > 0.0
        if beside.sum() < MIN_POINTS:
            raise ValueError("too little is seen of the ground that was measured")
        expected = (weights @ level)[beside] / total[beside] - factor * (seen[beside, :2] @ slope)
        factor = float(np.median(expected / z[beside]))
    used = track[(weights > 0.0).any(axis=0), :2]
    if float(np.linalg.norm(np.ptp(used, axis=0))) < MIN_SPAN * down_m:
        raise ValueError("too little is seen of the ground that was measured")
    return factor
