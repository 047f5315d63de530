"""The closest approach of two points as worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.flight.geometry import closest_approach


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


def test_many_pairs_at_once_keep_their_shape() -> None:
    begin = np.zeros((4, 5, 5, 3))
    begin[..., 1] = 1.0
    end = begin + np.array([0.0, -3.0, 0.0])
    end[2, 3, 4] = begin[2, 3, 4] + np.array([2.0, 0.0, 0.0])
    found = closest_approach(begin, end)
    assert found.shape == (4, 5, 5)
    assert found[2, 3, 4] == 1.0
    assert found.sum() == 1.0


@pytest.mark.parametrize("begin_m", [0.6, 1.0, 3.0])
def test_who_brakes_errs_by_no_more_than_the_bound(begin_m: float) -> None:
    """At 1 m/s towards each other, braked by 4 m/s^2: they turn 1/8 m nearer after 0.25 s, and are back at 0.5 s."""
    found = float(closest_approach(np.array([begin_m]), np.array([begin_m])))
    assert found == begin_m
    assert found - (begin_m - 1.0 / 8.0) == pytest.approx(4.0 * 0.5**2 / 8)
    halves = closest_approach(np.array([[begin_m], [begin_m - 0.125]]), np.array([[begin_m - 0.125], [begin_m]]))
    np.testing.assert_allclose(halves, begin_m - 0.125)
