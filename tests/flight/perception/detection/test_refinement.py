"""The cascade of crops, the range by a known size, and which of the candidates are one drone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from flockd.core.config.perception import DetectionParameters, PerceptionConfig
from flockd.core.messages import FloatArray, LearnedSize
from flockd.flight.geometry import log_polar
from flockd.flight.perception import Crops, Perception, RangeEstimates
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.detection.nms import fuse, suppress
from flockd.flight.perception.detection.proposals import Proposal
from flockd.flight.perception.detection.refinement import Candidate, Estimates
from tests.flight.pilot.flyer import Flyer, scenario_with


@pytest.fixture
def flyer() -> Flyer:
    """Another drone is 3 m ahead."""
    return Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))


def answering(flyer: Flyer, change: Callable[[int, Crops, RangeEstimates], RangeEstimates]) -> list[Crops]:
    """Has the second stage's estimates, of one crop at a time, changed by how often it was asked before; its crops."""
    estimates, crops = flyer.truth.sound("ranges"), list[Crops]()

    def ranges(asked: Crops) -> RangeEstimates:
        given = change(len(crops), asked, estimates(asked))
        crops.append(asked)
        return given

    flyer.truth.instead["ranges"] = ranges
    return crops


@pytest.mark.parametrize(
    ("wrong_by", "wanted"),
    [
        ((1.0,), 2),
        ((1.03, 1.0), 2),
        ((1.08, 1.0), 3),
        ((1.6, 1.0), 3),
        ((1.6, 1.3, 1.0), 4),
        ((1.6, 1.3, 1.6, 1.0), 4),
    ],
)
def test_a_proposal_is_cropped_again_until_the_crop_suits_the_drone(
    flyer: Flyer, wrong_by: tuple[float, ...], wanted: int
) -> None:
    """What a badly cut crop says of the range cuts the next one; the last estimate counts."""
    factors = [math.log(factor) for factor in wrong_by]
    crops = answering(
        flyer, lambda asked, _, one: one._replace(log_range=factors[min(asked, len(factors) - 1)] + one.log_range)
    )
    (detection,) = flyer.step().detections
    assert len(crops) == wanted + 1
    assert detection.range_m == pytest.approx(3.0, rel=0.01)


def test_the_mirrored_crop_is_weighted_by_its_variance(flyer: Flyer) -> None:
    """A drone is 3 m away: the last crop says 3 m, its mirror image 6."""

    def judged(asked: int, crop: Crops, one: RangeEstimates) -> RangeEstimates:
        if crop.mirrored.all():
            says = {"log_range": math.log(6.0), "log_range_sigma": 0.1, "drone_probability": 0.85}
        else:
            says = {"log_range_sigma": 0.05, "drone_probability": 0.9}
        return one._replace(**{name: np.array([value]) for name, value in says.items()})

    crops = answering(flyer, judged)
    (detection,) = flyer.step().detections
    assert [crop.mirrored.all() for crop in crops] == [False, False, True]
    assert detection.range_m == pytest.approx(3.0 * 2 ** (1 / 5), rel=0.005)  # 1 of 1 + 4
    assert detection.drone_probability == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ((0.3, 0.9, 0.9), 1),
        ((0.3, 0.55, 0.55), 1),
        ((0.1, 0.9, 0.9), 0),
        ((0.9, 0.45, 0.9), 0),
        ((0.9, 0.9, 0.45), 0),
    ],
)
def test_a_low_probability_of_the_first_crop_does_not_outlive_the_next(
    flyer: Flyer, given: tuple[float, ...], found: int
) -> None:
    """Only a very low one rejects at once; the first crop was not cut to this drone."""
    answering(flyer, lambda asked, _, one: one._replace(drone_probability=np.array([given[asked]])))
    assert len(flyer.step().detections) == found


# A known size: the range is the size over the apparent size, and its deviation is the networks' and the size's.


def test_range_is_size_over_apparent_size() -> None:
    """0.8 m at 4 m is a fifth of a radian wide: a drone of 0.5 m that is as wide is 2.5 m away, and 4 % of it are its
    size's, whatever the network said of that."""
    judged = np.array([0.8, 0.0, math.inf, math.nan])
    log_range, sigma, probability = (np.full(4, value) for value in (math.log(4.0), 0.03, 0.9))
    estimates = Estimates(np.tile([1.0, 0.0, 0.0], (4, 1)), log_range, sigma, judged, probability, np.full(4, 0.3))
    known = estimates.of_size(LearnedSize(0.5, 0.04))
    assert np.exp(known.log_range) == pytest.approx([2.5, math.nan, math.nan, math.nan], nan_ok=True)
    assert (known.log_range_sigma[0], known.log_size_sigma[0]) == pytest.approx((0.03, 0.04))
    assert (known.size_m[0], known.drone_probability[0], known.bearing[0, 0]) == (0.5, 0.9, 1.0)


def test_a_flights_detections_are_ranged_by_the_size_that_was_said(flyer: Flyer) -> None:
    """With exact networks, which know the drone's true size: a size said wrong by a factor moves the drone by it."""
    taken = flyer.take_frames()
    (true,) = flyer.perception().observe(*taken, None).detections
    for factor in (0.8, 1.0, 1.25):
        said = {"scale": "network", "drone_size_m": factor * true.size_m, "drone_size_sigma_m": 0.1 * true.size_m}
        config = flyer.scenario.drone.perception.model_copy(update=said)
        (known,) = Perception(flyer.cameras.rig, flyer.truth, config).observe(*taken, None).detections
        assert known.range_m == pytest.approx(factor * true.range_m, rel=0.01)
        assert known.size_m == pytest.approx(factor * true.size_m)
        wanted = math.hypot(true.range_sigma_m / true.range_m, 0.1 / factor)
        assert known.range_sigma_m / known.range_m == pytest.approx(wanted, rel=0.05)
        assert known.bearing == pytest.approx(true.bearing, abs=1e-3)


@pytest.mark.parametrize(
    "values",
    [
        {"drone_size_m": 0.04},
        {"drone_size_m": 5.1},
        {"drone_size_m": math.nan},
        {"drone_size_m": 0.35, "drone_size_sigma_m": -0.01},
        {"drone_size_m": 0.35, "drone_size_sigma_m": 0.2},
    ],
)
def test_sizes_that_cannot_be_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match="drone_size"):
        PerceptionConfig.model_validate(values)


# Non-maximum suppression: what is one drone, and what the fused detection says.

PARAMETERS = DetectionParameters()


def candidate(
    range_m: float, sigma: float, *, turned_deg: float = 0.0, size_m: float = 0.7, camera: str = "front"
) -> Candidate:
    turned = math.radians(turned_deg)
    bearing, log_range = log_polar(range_m * np.array([math.cos(turned), math.sin(turned), 0.0]))
    box: FloatArray = np.array([10.0, 10.0, 50.0, 40.0])
    proposal = Proposal((camera,), bearing, 0.2, Instance(1, np.array([30.0, 25.0]), box, 600.0))
    return Candidate(proposal, bearing, log_range, sigma, 0.004, size_m, 0.9)


@pytest.mark.parametrize(("sure", "range_m"), [(0.95, 4.0), (0.99, math.sqrt(4.0 * 4.2)), (0.5, math.sqrt(4.0 * 4.2))])
def test_a_doubtful_candidate_does_not_move_a_sure_one(sure: float, range_m: float) -> None:
    """Of 0.97 at 4 m and 0.9 at 4.2 m, equally vague: alone, or their mean where both are sure or none is."""
    both = [replace(candidate(4.0, 0.05), drone_probability=0.97), candidate(4.2, 0.05, camera="left")]
    assert [one.range_m for one in suppress(both, PARAMETERS, sure)[0]] == [pytest.approx(range_m)]


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
    both = [candidate(4.0, sigma), candidate(range_m, sigma, turned_deg=turned_deg, camera="left")]
    assert len(suppress(both, PARAMETERS)[0]) == (1 if same else 2)


def test_a_fused_detection_is_the_weighted_mean_with_the_best_ones_variance() -> None:
    """Weights 4 and 1; log 4 and log 5."""
    fused = fuse([candidate(4.0, 0.05), candidate(5.0, 0.1, camera="left")], 3)
    assert fused.range_m == pytest.approx(math.exp(0.8 * math.log(4.0) + 0.2 * math.log(5.0)))
    assert fused.range_sigma_m == pytest.approx(0.05 * fused.range_m)
    assert (fused.cameras, fused.label) == (("front", "left"), 3)
    assert np.trace(fused.covariance) == pytest.approx(0.05**2 + 2 * 0.004**2)
