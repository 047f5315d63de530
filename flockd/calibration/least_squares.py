"""Levenberg and Marquardt's damped least squares, for problems that write down their own normal equations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from flockd.messages import FloatArray

State = TypeVar("State")
_MOST_STEPS = 60
_DAMPING = (1e-4, 1e-12, 1e9)
"""At first, least, most."""
_ENOUGH = 1e-10
"""Relative gain of a step after which nothing more is to be had."""


@dataclass(frozen=True, eq=False)
class Normal:
    """A problem near one state: ``cost`` is the sum of squares; infinite where the state is no solution at all."""

    cost: float
    gradient: FloatArray
    """(n,) J^T r"""
    hessian: FloatArray
    """(n, n) J^T J"""


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """The best state, and the problem near it."""

    state: State
    normal: Normal

    def sigma(self, residuals: int, parameters: int) -> FloatArray:
        """(n,) standard deviations of the state's ``parameters``, from ``residuals`` numbers that the fit left over.

        Infinite where the residuals say nothing of a parameter.
        """
        variance = self.normal.cost / max(residuals - parameters, 1)
        scale = np.sqrt(np.diag(self.normal.hessian))
        if not (scale > 0.0).all():
            return np.where(scale > 0.0, 0.0, math.inf)
        values, vectors = np.linalg.eigh(self.normal.hessian / np.outer(scale, scale))
        with np.errstate(divide="ignore"):
            inverse = np.where(values > 1e-13, 1.0 / values, math.inf)
            spread: FloatArray = np.sqrt(variance * np.minimum((vectors**2) @ inverse, 1e300)) / scale
        return spread


def minimise(
    state: State, linearise: Callable[[State], Normal], move: Callable[[State, FloatArray], State]
) -> Solution[State]:
    """Goes downhill from ``state``; ``move`` adds a step (n,) to a state."""
    normal = linearise(state)
    damping, least, most = _DAMPING
    for _ in range(_MOST_STEPS):
        scale = np.sqrt(np.maximum(np.diag(normal.hessian), 1e-30))
        scaled, downhill = normal.hessian / np.outer(scale, scale), -normal.gradient / scale
        while damping < most:
            step = np.linalg.solve(scaled + damping * np.eye(len(scale)), downhill) / scale
            candidate = move(state, step)
            there = linearise(candidate)
            if there.cost < normal.cost:
                break
            damping *= 10.0
        else:
            break
        gain = (normal.cost - there.cost) / normal.cost
        state, normal, damping = candidate, there, max(damping / 10.0, least)
        if gain < _ENOUGH:
            break
    return Solution(state, normal)
