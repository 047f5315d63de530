"""Iteratively reweighted least squares, for fits that have a closed form or an optimiser of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.rigid_fit import fit_rotation
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


def robust_rotation(
    source: FloatArray, target: FloatArray, kernel: Callable[[FloatArray], Kernel], *, rounds: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(3, 3) R that takes most of ``source`` (n, 3) to ``target`` (n, 3); the lengths (n,) left, and their weights."""

    def left_over(rotation: FloatArray) -> FloatArray:
        left: FloatArray = np.linalg.norm(target - source @ rotation.T, axis=1)
        return left

    rotation, weights = reweighted(
        lambda weights, _: fit_rotation(source, target, weights),
        left_over,
        kernel,
        np.ones(len(source)),
        rounds=rounds,
    )
    return rotation, left_over(rotation), weights
