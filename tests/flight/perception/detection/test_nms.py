"""Non-maximum suppression: what is one drone, what hides another, and what the fused detection says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import FloatArray
from flockd.flight.geometry import log_polar
from flockd.flight.perception import Instance
from flockd.flight.perception.detection.nms import fuse, suppress, without_occluded
from flockd.flight.perception.detection.proposals import Proposal
from flockd.flight.perception.detection.refinement import Candidate
from flockd.flight.perception.detection.roi import Roi

PARAMETERS = DetectionParameters()


def candidate(position: FloatArray, sigma: float, *, size_m: float = 0.7, camera: str = "front") -> Candidate:
    bearing, log_range = log_polar(position)
    box = np.array([10.0, 10.0, 50.0, 40.0])
    proposal = Proposal((camera,), Roi(bearing, 0.2), Instance(1, np.array([30.0, 25.0]), box, 600.0))
    return Candidate(proposal, bearing, log_range, sigma, 0.004, size_m, 0.9)


def towards(turned_deg: float, range_m: float) -> FloatArray:
    turned = math.radians(turned_deg)
    return range_m * np.array([math.cos(turned), math.sin(turned), 0.0])


@pytest.mark.parametrize(
    ("range_m", "turned_deg", "sigma", "same"),
    [
        (4.2, 0.5, 0.025, True),  # at the same spot
        (4.7, 1.0, 0.05, True),  # 16 % farther, where each range is known to 5 %
        (4.7, 1.0, 0.01, False),  # the same, where each is known to 1 %
        (7.0, 1.0, 0.05, False),  # too far behind
        (4.2, 8.0, 0.025, False),  # beside it: 0.56 m
        (4.0, 5.0, 0.025, True),  # 0.35 m beside it: half a drone's size
    ],
)
def test_candidates_are_one_drone_by_their_mahalanobis_distance(
    range_m: float, turned_deg: float, sigma: float, same: bool
) -> None:
    one, other = candidate(towards(0.0, 4.0), sigma), candidate(towards(turned_deg, range_m), sigma, camera="left")
    assert len(suppress([one, other], PARAMETERS).detections) == (1 if same else 2)


@pytest.mark.parametrize(
    ("range_m", "turned_deg", "kept_m"),
    [
        (12.0, 1.0, [3.0]),  # half of a drone at an image's border: nothing could be seen there, behind the whole one
        (12.0, 6.0, [3.0, 12.0]),  # beside it
        (1.0, 1.0, [1.0, 3.0]),  # near, however uncertain: that is never overlooked
        (3.5, 1.0, [3.0, 3.5]),  # the two may be one
    ],
)
def test_an_uncertain_one_behind_another_is_suppressed(range_m: float, turned_deg: float, kept_m: list[float]) -> None:
    certain = candidate(towards(0.0, 3.0), 0.017, size_m=0.5)
    uncertain = candidate(towards(turned_deg, range_m), 0.2, size_m=0.5, camera="left")
    kept = without_occluded([uncertain, certain], PARAMETERS)
    assert sorted(one.range_m for one in kept) == pytest.approx(kept_m)


def test_a_fused_detection_is_the_weighted_mean_with_the_best_ones_variance() -> None:
    """Weights 4 and 1; log 4 and log 5."""
    fused = fuse([candidate(towards(0.0, 4.0), 0.05), candidate(towards(0.0, 5.0), 0.1, camera="left")], 3)
    assert fused.range_m == pytest.approx(math.exp(0.8 * math.log(4.0) + 0.2 * math.log(5.0)))
    assert fused.range_sigma_m == pytest.approx(0.05 * fused.range_m)
    assert fused.cameras == ("front", "left")
    assert fused.label == 3
    assert np.trace(fused.covariance) == pytest.approx(0.05**2 + 2 * 0.004**2)


def test_a_size_that_is_not_known_makes_the_range_uncertain_too() -> None:
    """3 % by the apparent size and 40 % by the size are 40.1 %."""
    unknown = replace(candidate(towards(0.0, 4.0), 0.03), log_size_sigma=0.4)
    fused = fuse([unknown], 1)
    assert fused.log_size_sigma == 0.4
    assert fused.range_sigma_m / fused.range_m == pytest.approx(math.hypot(0.03, 0.4))
    assert np.trace(fused.covariance) == pytest.approx(0.03**2 + 2 * 0.004**2), "all its views are off alike"
