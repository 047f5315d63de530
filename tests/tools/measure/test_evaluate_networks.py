"""What the table of the networks' figures counts as found. Needs the extra `train`."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import Detection
from flockd.flight.geometry import log_polar, log_polar_covariance
from tools.measure.evaluate_networks import pairings


def detection(*position: float) -> Detection:
    bearing, log_range = log_polar(np.array(position))
    return Detection(bearing, log_range, log_polar_covariance(bearing, 0.1, 0.004), 0.9, 0.5, ("camera",), 1)


def test_a_far_drone_keeps_its_detection_though_it_lies_within_a_near_ones_outline() -> None:
    near, far = np.array([2.0, 0.0, 0.0]), np.array([10.0, 1.0, 0.0])
    of_far, of_near = detection(10.5, 1.05, 0.0), detection(2.1, -0.21, 0.0)
    found = pairings((of_far, of_near), [near, far], [0.5, 0.5])
    assert found[0] is of_near
    assert found[1] is of_far


def test_one_detection_is_not_two_drones_and_none_is_found_in_another_direction() -> None:
    near, far = np.array([2.0, 0.0, 0.0]), np.array([10.0, 0.1, 0.0])
    assert list(pairings((detection(9.0, 0.09, 0.0),), [near, far], [0.5, 0.5])) == [1]
    assert not pairings((detection(10.0, 0.6, 0.0),), [near, far], [0.1, 0.5]), "half a metre beside it, twice its half"
