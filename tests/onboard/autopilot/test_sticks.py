"""The curve of a remote control's sticks, and when they take over."""

from __future__ import annotations

import numpy as np

from flockd.sim.autopilot.sticks import StickOverride, stick_curve


def test_sticks_are_slow_near_the_middle_and_reach_full_speed() -> None:
    """By hand from PX4's 0.4 x + 0.6 x^3, x from the edge of the dead zone."""
    np.testing.assert_allclose(stick_curve(np.array([0.0, 0.5, -0.5, 1.0])), [0.0, 0.275, -0.275, 1.0])
    np.testing.assert_allclose(stick_curve(np.array([0.05, -0.1, 0.55, 1.0]), 0.1), [0.0, 0.0, 0.275, 1.0], atol=1e-12)


def _takes_over(step: float, threshold: float, positions: int) -> bool:
    """Whether a stick that moves by `step` every 30 ms does."""
    override = StickOverride()
    moved = [override.moved(0.03 * i, np.array([min(i * step, 1.0), 0.0]), threshold) for i in range(positions)]
    return any(moved)


def test_a_stick_takes_over_by_its_speed_and_only_when_it_goes_on_in_one_direction() -> None:
    """At 0.1 in 30 ms it travels 3.3 a second, at 0.02 only 0.67; PX4 wants more than 1 for three positions on end."""
    assert _takes_over(0.1, 1.0, 7)
    assert not _takes_over(0.1, 1.0, 3)  # the first position moves nothing: two steps
    assert not _takes_over(0.02, 1.0, 40)
    assert not _takes_over(0.1, -1.0, 7)  # MAN_OVERRIDE_SPD below zero: never
    shaken = StickOverride()
    assert not any(shaken.moved(0.03 * i, np.array([0.0, 0.3 * (i % 2)]), 1.0) for i in range(20))
