"""Intervals and the comparison, with numbers from outside the code."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.campaign.figures import mean_interval
from flockd.campaign.results import paired_p


def test_a_mean_has_students_interval() -> None:
    """t(4 degrees of freedom, 97.5 %) is 2.776; of 1 to 5 the standard deviation is 1.5811."""
    interval = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert interval is not None
    assert interval.mean == 3.0
    assert interval.half_width == pytest.approx(2.776 * 1.5811 / 5**0.5, abs=1e-3)
    assert mean_interval([1.0]) is None
    assert mean_interval([]) is None


def test_a_share_has_wilsons_interval() -> None:
    """Newcombe, "Two-sided confidence intervals for the single proportion" (1998), table I, without continuity
    correction: 81 of 263 is 0.2553 to 0.3662, 0 of 20 is 0 to 0.1611."""
    of_many = mean_interval([1.0] * 81 + [0.0] * 182, is_share=True)
    assert of_many is not None
    assert of_many[1:] == pytest.approx((0.2553, 0.3662), abs=1e-4)
    none = mean_interval([0.0] * 20, is_share=True)
    assert none is not None
    assert none[1:] == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_paired_differences_that_all_go_one_way() -> None:
    """Two of 2^5 ways to give signs have a sum as far from zero: p = 1/16."""
    assert paired_p(np.array([0.3, 0.1, 0.2, 0.5, 0.4])) == 2 / 32
    assert paired_p(np.array([1.0, -1.0, 1.0, -1.0])) == 1.0
    assert paired_p(np.full(30, 0.2)) < 1e-3
    assert paired_p(np.tile([1.0, -1.1], 15)) > 0.5
