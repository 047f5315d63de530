"""The curve of a remote control's sticks."""

from __future__ import annotations

import numpy as np

from flockd.sim.autopilot.sticks import stick_curve


def test_sticks_are_slow_near_the_middle_and_reach_full_speed() -> None:
    """By hand from PX4's 0.4 x + 0.6 x^3, x from the edge of the dead zone."""
    np.testing.assert_allclose(stick_curve(np.array([0.0, 0.5, -0.5, 1.0])), [0.0, 0.275, -0.275, 1.0])
    np.testing.assert_allclose(stick_curve(np.array([0.05, -0.1, 0.55, 1.0]), 0.1), [0.0, 0.0, 0.275, 1.0], atol=1e-12)
