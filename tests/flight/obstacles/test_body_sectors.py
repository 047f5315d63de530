"""The local map in sectors from the nose: no sector is said to be free that is not, whatever the heading."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import SECTORS, FloatArray
from flockd.flight.obstacles import free_ahead

SEEN_M = np.full(SECTORS, 15.0)
NO_POINTS = np.empty((0, 2))
RIGHT, BEHIND, LEFT = SECTORS // 4, SECTORS // 2, 3 * SECTORS // 4


def obstacles_in(free_m: FloatArray) -> dict[int, float]:
    """By sector; all others are free."""
    assert not np.isnan(free_m).any()
    return {int(sector): float(free_m[sector]) for sector in np.flatnonzero(np.isfinite(free_m))}


@pytest.mark.parametrize(("heading_deg", "sector"), [(0.0, RIGHT), (90.0, 0), (180.0, LEFT), (-90.0, BEHIND)])
def test_an_obstacle_in_the_east_is_where_it_is_from_the_nose(heading_deg: float, sector: int) -> None:
    free_m = free_ahead(np.array([[0.0, 4.0]]), SEEN_M, 0.0, math.radians(heading_deg), 15.0)
    assert obstacles_in(free_m) == {sector: pytest.approx(4.0)}


def test_between_two_sectors_both_have_it() -> None:
    """Heading 2 degrees: the sector of 90 degrees spans 85.5 to 90.5 from the nose, so over those of 85 and 90."""
    free_m = free_ahead(np.array([[0.0, 4.0]]), SEEN_M, 0.0, math.radians(2.0), 15.0)
    assert obstacles_in(free_m) == {RIGHT - 1: pytest.approx(4.0), RIGHT: pytest.approx(4.0)}


def test_of_two_in_a_sector_the_nearer_counts() -> None:
    free_m = free_ahead(np.array([[4.0, 0.0], [3.0, 0.0], [9.0, 0.0]]), SEEN_M, 0.0, 0.0, 15.0)
    assert obstacles_in(free_m) == {0: 3.0}


def test_what_was_not_looked_at_is_unknown_and_so_is_what_only_touches_it() -> None:
    seen_m = SEEN_M.copy()
    seen_m[RIGHT] = 0.0
    assert np.flatnonzero(np.isnan(free_ahead(NO_POINTS, seen_m, 0.0, 0.0, 15.0))).tolist() == [RIGHT]
    turned = free_ahead(NO_POINTS, seen_m, 0.0, math.radians(2.0), 15.0)
    assert np.flatnonzero(np.isnan(turned)).tolist() == [RIGHT - 1, RIGHT]
    assert np.isnan(free_ahead(NO_POINTS, np.zeros(SECTORS), 0.0, 0.0, 15.0)).all()


def test_an_obstacle_counts_where_nothing_else_is_known() -> None:
    free_m = free_ahead(np.array([[4.0, 0.0]]), np.zeros(SECTORS), 0.0, 0.0, 15.0)
    assert free_m[0] == 4.0
    assert np.isnan(free_m[1:]).all()


@pytest.mark.parametrize(("seen_m", "free_m"), [(15.0, np.inf), (12.0, 11.4), (7.5, 6.9), (7.4, np.nan)])
def test_where_sight_ends_an_obstacle_may_be(seen_m: float, free_m: float) -> None:
    """The drone has moved 0.6 m since. Less than half the range is as good as nothing."""
    np.testing.assert_allclose(free_ahead(NO_POINTS, np.full(SECTORS, seen_m), 0.6, 0.0, 15.0), free_m)
