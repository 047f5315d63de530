"""One solver, against solutions from outside: closed forms and SciPy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares

from flockd.core.messages import FloatArray
from flockd.flight.geometry.robust.kernels import Cauchy, Tukey
from flockd.flight.geometry.robust.line import ransac_line
from flockd.flight.geometry.robust.solver import GaussNewton, NormalEquations, Problem


@dataclass(frozen=True, eq=False)
class Decay(Problem[FloatArray]):
    """``y = a exp(-b t)``"""

    t: FloatArray
    y: FloatArray
    kernel: Cauchy | None = None
    longest: float = math.inf

    def residuals(self, state: FloatArray) -> FloatArray:
        with np.errstate(over="ignore"):
            left: FloatArray = state[0] * np.exp(-state[1] * self.t) - self.y
        return left

    def linearise(self, state: FloatArray) -> NormalEquations:
        left = self.residuals(state)
        with np.errstate(over="ignore", invalid="ignore"):
            fall = np.exp(-state[1] * self.t)
            jacobian = np.stack([fall, -state[0] * self.t * fall], axis=1)
            return NormalEquations.of(left, jacobian, self.kernel.weight(left**2) if self.kernel else None)

    def move(self, state: FloatArray, step: FloatArray) -> FloatArray:
        moved: FloatArray = state + step
        return moved

    def limited(self, step: FloatArray) -> FloatArray:
        return step * min(1.0, self.longest / max(float(np.abs(step).max()), 1e-300))


T = np.linspace(0.0, 4.0, 40)
NOISY = 3.0 * np.exp(-0.7 * T) + 0.05 * np.random.default_rng(0).normal(size=40)
SPOILT = np.where(np.arange(40) % 8 == 3, 6.0, NOISY)


def test_the_least_squares_are_scipys() -> None:
    problem = Decay(T, NOISY)
    found = GaussNewton(max_steps=20, tolerance=1e-9).minimise(problem, np.array([2.0, 0.5]))
    theirs = least_squares(problem.residuals, np.array([3.0, 0.7]), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert found.converged
    assert found.state == pytest.approx(theirs.x, abs=1e-6)
    assert found.equations.cost == pytest.approx(2.0 * theirs.cost, rel=1e-6)


def test_reweighted_steps_minimise_the_kernels_loss() -> None:
    problem = Decay(T, SPOILT, Cauchy(0.1))
    found = GaussNewton(max_steps=100, tolerance=1e-10).minimise(problem, np.array([2.0, 0.5]))
    theirs = least_squares(problem.residuals, np.array([3.0, 0.7]), loss="cauchy", f_scale=0.1, xtol=1e-14, ftol=1e-14)
    assert found.converged
    assert found.state == pytest.approx(theirs.x, abs=1e-5)
    loss = Cauchy(0.1).loss(problem.residuals(found.state) ** 2).sum()
    assert 0.5 * 0.1**2 * loss == pytest.approx(theirs.cost, rel=1e-8)


def test_a_step_is_no_longer_than_it_may_be() -> None:
    limited = GaussNewton(max_steps=1, tolerance=0.0).minimise(Decay(T, NOISY, longest=0.01), np.array([2.0, 0.5]))
    assert np.abs(limited.state - [2.0, 0.5]).max() == pytest.approx(0.01)
    assert not limited.converged


def test_before_its_least_number_of_steps_nothing_has_converged() -> None:
    problem = Decay(T, NOISY)
    best = GaussNewton(max_steps=20, tolerance=1e-9).minimise(problem, np.array([3.0, 0.7])).state
    assert GaussNewton(max_steps=3, tolerance=1e-3).minimise(problem, best).converged
    assert not GaussNewton(max_steps=3, tolerance=1e-3, min_steps=4).minimise(problem, best).converged


def test_what_is_no_solution_is_distinguished() -> None:
    nowhere = np.array([math.nan, 0.5])
    found = GaussNewton(max_steps=5, tolerance=1e-3).minimise(Decay(T, NOISY), nowhere)
    assert not found.equations.solvable
    assert not found.converged
    # Without any fall a decay's time says nothing of its rate: the matrix is singular.
    undetermined = Decay(np.zeros(40), NOISY)
    found = GaussNewton(max_steps=5, tolerance=1e-3, max_condition=1e12).minimise(undetermined, np.array([2.0, 0.5]))
    assert not found.equations.solvable
    # With hardly any fall it says next to nothing.
    for max_condition, solvable in ((1e4, False), (1e12, True)):
        optimizer = GaussNewton(max_steps=1, tolerance=1e-3, max_condition=max_condition)
        assert optimizer.minimise(Decay(1e-3 * T, NOISY), np.array([2.0, 0.5])).equations.solvable is solvable


def test_a_damped_parameter_moves_less() -> None:
    equations = Decay(T, NOISY).linearise(np.array([2.0, 0.5]))
    held = equations.damped(np.array([0.0, 1e9])).step()
    assert abs(held[1]) < 1e-6 < abs(equations.step()[1])


@pytest.mark.parametrize(("kernel", "half"), [(Cauchy(2.0), 2.0), (Tukey(2.0), 2.0 * math.sqrt(1.0 - math.sqrt(0.5)))])
def test_kernels_weigh_as_the_literature_says(kernel: Cauchy | Tukey, half: float) -> None:
    assert kernel.weight(np.array([0.0, half**2])) == pytest.approx([1.0, 0.5])
    far = kernel.weight(np.array([4.0 * 2.0**2]))[0]
    assert far == pytest.approx(0.0 if isinstance(kernel, Tukey) else 1.0 / 5.0)


@pytest.mark.parametrize("intercept", [True, False])
def test_a_line_is_found_although_half_of_the_points_are_wrong(intercept: bool) -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(0.1, 1.0, 500)
    y = 2.5 * x + (0.3 if intercept else 0.0) + 0.002 * rng.normal(size=500)
    y[::2] = rng.uniform(0.0, 3.0, 250)
    line = ransac_line(x, y, np.full(500, 0.01), intercept=intercept, min_inliers=100, min_inlier_ratio=0.25)
    assert line is not None
    assert line.slope == pytest.approx(2.5, abs=0.01)
    assert line.intercept == pytest.approx(0.3 if intercept else 0.0, abs=0.005)


def test_points_without_a_line_have_none() -> None:
    rng = np.random.default_rng(3)
    x, y, tolerance = rng.uniform(0.0, 1.0, 500), rng.uniform(0.0, 1.0, 500), np.full(500, 0.01)
    assert ransac_line(x, y, tolerance, intercept=True, min_inliers=100, min_inlier_ratio=0.25) is None
    few = np.arange(50.0)
    assert ransac_line(few, few, np.ones(50), intercept=True, min_inliers=100, min_inlier_ratio=0.25) is None
    falling = np.arange(200.0)
    assert ransac_line(falling, -falling, np.ones(200), intercept=True, min_inliers=100, min_inlier_ratio=0.25) is None
