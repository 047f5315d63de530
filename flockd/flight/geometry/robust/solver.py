"""Nonlinear least squares on normal equations, by Gauss-Newton.

A `Problem` gives residuals, derivatives and the robust kernel; `GaussNewton` iterates and decides when to stop.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from flockd.core.messages import FloatArray

State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """A problem linearised at one state: ``hessian @ step = -gradient`` gives the step."""

    cost: float
    """Weighted sum of squares; infinite for an impossible state."""
    gradient: FloatArray
    """(n,) J^T W r"""
    hessian: FloatArray
    """(n, n) J^T W J"""

    @classmethod
    def of(cls, residuals: FloatArray, jacobian: FloatArray, weights: FloatArray | None = None) -> NormalEquations:
        """From residuals (m,), their derivatives (m, n) and weights (m,); unsolvable if a number is not finite."""
        weighted = jacobian if weights is None else jacobian * weights[:, None]
        cost = float(residuals @ (residuals if weights is None else weights * residuals))
        if not (math.isfinite(cost) and np.isfinite(weighted).all()):
            return cls.unsolvable(jacobian.shape[1])
        return cls(cost, weighted.T @ residuals, weighted.T @ jacobian)

    @classmethod
    def unsolvable(cls, parameters: int) -> NormalEquations:
        """The equations of an impossible state."""
        return cls(math.inf, np.zeros(parameters), np.eye(parameters))

    @property
    def solvable(self) -> bool:
        """Whether the state is possible."""
        return math.isfinite(self.cost)

    def damped(self, diagonal: FloatArray) -> NormalEquations:
        """With ``diagonal`` (n,) added to the hessian's: the larger, the shorter that parameter's step."""
        hessian = self.hessian.copy()
        hessian.flat[:: len(hessian) + 1] += diagonal
        return NormalEquations(self.cost, self.gradient, hessian)

    def step(self) -> FloatArray:
        """(n,)"""
        return np.asarray(np.linalg.solve(self.hessian, -self.gradient), np.float64)


class Problem(ABC, Generic[State]):
    """A minimisation over states, which steps of n numbers move."""

    @abstractmethod
    def linearise(self, state: State) -> NormalEquations:
        """The normal equations at a state."""

    @abstractmethod
    def move(self, state: State, step: FloatArray) -> State:
        """A state moved by a step (n,)."""

    def limited(self, step: FloatArray) -> FloatArray:
        """The step (n,), or the part of it for which the linearisation holds."""
        return step

    def step_size(self, step: FloatArray) -> float:
        """The size that a solver's ``tolerance`` is compared with; by default the largest number of the step (n,)."""
        return float(np.abs(step).max())


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """The state at which a solver stopped."""

    state: State
    equations: NormalEquations
    """The last ones computed, one step before ``state``."""
    converged: bool
    """Whether the last step was below the tolerance; else the steps ran out or led to an impossible state."""


@dataclass(frozen=True)
class GaussNewton:
    """Takes every step, whether or not the cost falls: for good starts, and weights that change on the way."""

    max_steps: int
    tolerance: float
    """A smaller step has converged."""
    min_steps: int = 1
    """Fewest steps before convergence."""
    max_condition: float = math.inf
    """Largest condition number of a hessian: beyond it some parameter is not observable."""

    def minimise(self, problem: Problem[State], state: State) -> Solution[State]:
        """Iterates from ``state``."""
        equations = problem.linearise(state)
        for number in range(1, self.max_steps + 1):
            if number > 1:
                equations = problem.linearise(state)
            if not equations.solvable:
                break
            step = self._step(equations)
            if step is None:
                return Solution(state, NormalEquations.unsolvable(len(equations.gradient)), converged=False)
            step = problem.limited(step)
            state = problem.move(state, step)
            if number >= self.min_steps and problem.step_size(step) < self.tolerance:
                return Solution(state, equations, converged=True)
        return Solution(state, equations, converged=False)

    def _step(self, equations: NormalEquations) -> FloatArray | None:
        """(n,); None: the hessian is singular."""
        try:
            if math.isfinite(self.max_condition):
                sizes = np.abs(np.linalg.eigvalsh(equations.hessian))
                if not sizes.max() < self.max_condition * sizes.min():
                    return None
            return equations.step()
        except np.linalg.LinAlgError:
            return None
