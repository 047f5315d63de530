"""Association of measurements with tracks: gate and optimal assignment in log-polar coordinates and size."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from flockd.core.messages import FloatArray

_NO_PAIR = -1e9
"""Cost of a measurement that no track's gate contains. The value does not matter: there is no alternative."""


def assign(squared_distances: FloatArray, log_likelihoods: FloatArray, gate_sigma: float) -> dict[int, int]:
    """One to one, the likeliest assignment of k measurements to n tracks: measurement -> track, by index.

    The cost of a pair is twice its negative log likelihood. A measurement without a track costs as much as the vaguest
    of its pairs would at the gate, so that no pair within the gate is given up. Both arrays are (k, n).
    """
    near = squared_distances <= gate_sigma**2
    costs = np.where(near, -2.0 * log_likelihoods, np.inf)
    at_gate = np.where(near, gate_sigma**2 - squared_distances - 2.0 * log_likelihoods, -np.inf).max(
        axis=1, initial=_NO_PAIR
    )
    alone = np.full((len(near), len(near)), np.inf)
    np.fill_diagonal(alone, at_gate)
    rows, columns = linear_sum_assignment(np.hstack([costs, alone]))
    return {k: n for k, n in zip(rows.tolist(), columns.tolist(), strict=True) if n < near.shape[1] and near[k, n]}
