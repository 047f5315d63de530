"""Iteratively reweighted least squares, for fits that have a closed form or an optimiser of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.robust.kernels import Kernel

Fit = TypeVar("Fit")


def reweighted(
    fit: Callable[[FloatArray, Fit | None], Fit],
    residuals: Callable[[Fit], FloatArray],
    kernel: Callable[[FloatArray], Kernel],
    weights: FloatArray,
    *,
    rounds: int,
    settled: float = 0.0,
) -> tuple[Fit, FloatArray]:
    """The last fit, and the weights (n,) of its residuals (Holland & Welsch 1977).

    Args:
        fit: from weights (n,) and the fit before, None at first.
        residuals: (n,) of a fit.
        kernel: for residuals (n,), whose size gives its scale.
        weights: (n,) to begin with.
        rounds: fits at most.
        settled: no further fit once no weight changes by as much.
    """
    found: Fit | None = None
    for _ in range(rounds):
        found = fit(weights, found)
        left, before = residuals(found), weights
        weights = kernel(left).weight(left**2)
        if float(np.abs(weights - before).max()) < settled:
            break
    if found is None:
        raise ValueError("at least one round is needed")
    return found, weights
