"""Robust kernels, which reduce the weight of large residuals, and fits with them.

A kernel takes squared residuals and gives weights for iteratively reweighted least squares (Holland & Welsch, Robust
regression using iteratively reweighted least-squares, 1977), which also lists the scales at which each is 95 %
efficient for Gaussian errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from flockd.core.messages import FloatArray

Fit = TypeVar("Fit")


class Kernel(Protocol):
    """The weight of a squared residual."""

    def weight(self, squared: FloatArray) -> FloatArray:
        """(n,) weights, 1 at zero, of squared residuals (n,)."""
        ...


@dataclass(frozen=True)
class Cauchy:
    """The weight falls with the square of the residual and never reaches zero: a distant start still converges.

    95 % efficient for a scale of 2.385 standard deviations.
    """

    scale: float
    """Residual with weight one half."""

    def weight(self, squared: FloatArray) -> FloatArray:
        """See `Kernel`."""
        weights: FloatArray = 1.0 / (1.0 + squared / self.scale**2)
        return weights

    def loss(self, squared: FloatArray) -> FloatArray:
        """(n,) cost in units of the squared scale; its derivative by ``squared / scale^2`` is `weight`."""
        losses: FloatArray = np.log1p(squared / self.scale**2)
        return losses


@dataclass(frozen=True)
class Tukey:
    """The biweight (Beaton & Tukey 1974): the weight is zero beyond its scale.

    95 % efficient for a scale of 4.685 standard deviations; six median deviations are Cleveland's choice (Robust
    locally weighted regression, 1979).
    """

    scale: float
    """Residual from which on the weight is zero."""

    def weight(self, squared: FloatArray) -> FloatArray:
        """See `Kernel`."""
        weights: FloatArray = np.maximum(1.0 - squared / self.scale**2, 0.0) ** 2
        return weights


def median(values: FloatArray) -> float:
    """Median of values (n,) without NaN, n at least 1; for a few hundred `np.median` takes several times as long."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    parted = np.partition(values, (middle - 1, middle))
    return float(parted[middle - 1] + parted[middle]) / 2.0


def reweighted(
    fit: Callable[[FloatArray, Fit | None], Fit],
    residuals: Callable[[Fit], FloatArray],
    kernel: Callable[[FloatArray], Kernel],
    weights: FloatArray,
    *,
    rounds: int,
    settled: float = 0.0,
) -> tuple[Fit, FloatArray]:
    """Iteratively reweighted fit: the last fit, and the weights (n,) of its residuals (Holland & Welsch 1977).

    Args:
        fit: from weights (n,) and the fit before, None at first.
        residuals: (n,) of a fit.
        kernel: a kernel for residuals (n,), whose size gives its scale.
        weights: (n,) at the start.
        rounds: largest number of fits.
        settled: stops when no weight changes by as much.
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
