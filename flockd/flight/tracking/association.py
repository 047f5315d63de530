"""Which measurement is of which track: gate and optimal assignment in log-polar coordinates and size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import BoolArray
from flockd.flight.tracking.filter import MIN_RANGE_M, Innovation, State
from flockd.flight.tracking.hypotheses import Hypotheses
from flockd.flight.tracking.measurement import Measurement

_FORBIDDEN = 1e9
"""More than any sum of the costs of pairs within the gate: those are tens each, of a few hundred pairs at most."""


def assign(
    measurements: Sequence[Measurement],
    tracks: Sequence[Hypotheses],
    parameters: TrackingParameters,
) -> dict[int, tuple[int, Innovation]]:
    """One to one, the likeliest assignment of measurements to tracks: measurement -> (track, innovation), by index.

    The cost of a pair is its squared Mahalanobis distance plus the logarithm of the innovation covariance's determinant
    (twice its negative log likelihood but for a constant). A measurement without a track costs what the vaguest of its
    pairs would cost at the gate, so that no pair within the gate is given up for nothing.
    """
    if not measurements or not tracks:
        return {}
    gate = parameters.gate_sigma**2
    pairs: dict[tuple[int, int], Innovation] = {}
    states = [track.state for track in tracks]
    costs = np.full((len(measurements), len(states)), _FORBIDDEN)
    unassigned = np.full((len(measurements), len(measurements)), _FORBIDDEN)
    np.fill_diagonal(unassigned, -_FORBIDDEN)
    for row, column in np.argwhere(_near(measurements, states, parameters.gate_sigma)).tolist():
        pair = tracks[column].innovation(measurements[row], parameters)
        squared, log_determinant = pair.squared_distance, pair.log_determinant
        if squared <= gate:
            pairs[row, column] = pair
            costs[row, column] = squared + log_determinant - 2 * pair.log_prior
            unassigned[row, row] = max(unassigned[row, row], gate + log_determinant - 2 * pair.log_prior)
    rows, columns = linear_sum_assignment(np.hstack([costs, unassigned]))
    return {
        row: (column, pairs[row, column])
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if (row, column) in pairs
    }


def _near(measurements: Sequence[Measurement], states: Sequence[State], gate_sigma: float) -> BoolArray:
    """(M, N) whether a pair may be within the gate: no variance is larger than the trace, so that others are not."""
    positions = np.array([state.mean[:3] for state in states])
    ranges = np.maximum(np.linalg.norm(positions, axis=1), MIN_RANGE_M)
    cosines = np.array([m.bearing for m in measurements]) @ (positions / ranges[:, None]).T
    of_states = np.array([np.trace(state.covariance[:3, :3]) for state in states]) / ranges**2
    variances = np.array([np.trace(m.covariance) for m in measurements])[:, None] + of_states
    near: BoolArray = (np.arccos(np.clip(cosines, -1.0, 1.0)) <= gate_sigma * np.sqrt(variances)) | (
        ranges <= MIN_RANGE_M
    )
    return near
