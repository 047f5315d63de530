"""Figures of a flock against small flocks worked out by hand; the closest approach of two points."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.review.metrics import closest_approach, min_distance, obj1, order, safety, union


def test_obj1_is_the_cosine_on_the_circle_and_the_l1_distance_after_it() -> None:
    velocities = np.array([[0.0, 2.0], [2.0, 0.0], [0.0, -1.0]])
    # -(V . efv) / (2 |efv|^2) with efv = (0, 2)
    np.testing.assert_allclose(obj1(velocities, np.array([0.0, 2.0]), circling=True), [-0.5, 0.0, 0.25])
    np.testing.assert_allclose(obj1(velocities, np.array([1.0, 0.0]), circling=False), [3.0, 1.0, 2.0])


TWO_PAIRS = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 1.0], [50.0, 1.0]])
NEAR = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9], [5.0, 0.0, 0.0]])


def row(count: int) -> FloatArray:
    """A metre apart."""
    return np.column_stack([np.arange(float(count)), np.zeros(count)])


@pytest.mark.parametrize(
    ("figure", "expected"),
    [
        # the mean cosine over pairs
        (order(np.array([[1.0, 0.0], [3.0, 0.0]])), 1.0),
        (order(np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])), -1 / 3),  # cosines 0, -1, 0
        (order(np.array([[1.0, 0.0], [0.0, 0.0]])), 0.0),
        (order(np.array([[1.0, 0.0]])), 1.0),
        # components
        (union(row(4), 1.0), 1.0),
        (union(row(4), 0.9), 0.0),
        (union(TWO_PAIRS, 5.0), 2 / 3),
        (union(row(1), 1.0), 1.0),
        (union(row(33), 1.0), 1.0),
        (safety(NEAR), 2 / 3),  # 0.9 m < 2 * 0.5 m
        (safety(NEAR, collision_radius_m=0.45), 1.0),
        (safety(NEAR[:1]), 1.0),
        (min_distance(NEAR), 0.9),
        (min_distance(NEAR[:1]), math.inf),
    ],
)
def test_figures_of_flocks_whose_answer_is_known(figure: float, expected: float) -> None:
    assert figure == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("begin", "end", "least_m"),
    [
        pytest.param([1.0, 0.34, 0.0], [-1.0, 0.34, 0.0], 0.34, id="head-on, past each other"),
        pytest.param([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 0.0, id="through each other"),
        pytest.param([5.0, 0.0, 0.0], [3.0, 0.0, 0.0], 3.0, id="not there yet"),
        pytest.param([3.0, 4.0, 0.0], [6.0, 8.0, 0.0], 5.0, id="going away"),
        pytest.param([1.0, 2.0, 2.0], [1.0, 2.0, 2.0], 3.0, id="both standing still"),
        pytest.param([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0, id="standing at one place"),
        pytest.param([4.0, 0.0], [0.0, 3.0], 2.4, id="height of a triangle of 3, 4 and 5"),
        pytest.param([0.0, 2.0, -1.0], [0.0, 2.0, 3.0], 2.0, id="one climbs past the other"),
    ],
)
def test_two_points_are_closest_where_algebra_says(begin: list[float], end: list[float], least_m: float) -> None:
    assert closest_approach(np.array(begin), np.array(end)) == pytest.approx(least_m, abs=1e-12)
    assert closest_approach(np.array(end), np.array(begin)) == pytest.approx(least_m, abs=1e-12)


@pytest.mark.parametrize("begin_m", [0.6, 1.0, 3.0])
def test_who_brakes_errs_by_no_more_than_the_bound(begin_m: float) -> None:
    """At 1 m/s towards each other, braked by 4 m/s^2: they turn 1/8 m nearer after 0.25 s, and are back at 0.5 s."""
    found = float(closest_approach(np.array([begin_m]), np.array([begin_m])))
    assert found == begin_m
    assert found - (begin_m - 1.0 / 8.0) == pytest.approx(4.0 * 0.5**2 / 8)
