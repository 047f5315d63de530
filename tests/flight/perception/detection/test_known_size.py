"""A known size: the range is the size over the apparent size, and its deviation is the networks' and the size's."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from flockd.core.config.perception import PerceptionConfig
from flockd.flight.perception import Perception, RangeEstimate
from flockd.flight.perception.maps import KnownSize
from flockd.flight.tracking import Prediction
from flockd.sim.flock.truth_perception import _SIZE_M
from tests.flight.pilot.flyer import Flyer, scenario_with

ESTIMATE = RangeEstimate(math.log(4.0), 0.03, np.array([48.0, 48.0]), size_m=0.8, drone_probability=0.9)
"""0.8 m at 4 m: a fifth of a radian wide."""


def test_range_is_size_over_apparent_size() -> None:
    """A drone of 0.5 m that is a fifth of a radian wide is 2.5 m away, and 4 % of it are its size's, whatever the
    network said of that."""
    known = replace(ESTIMATE, log_size_sigma=0.3).of_size(KnownSize(0.5, 0.02))
    assert math.exp(known.log_range) == pytest.approx(2.5)
    assert (known.log_range_sigma, known.log_size_sigma) == pytest.approx((0.03, 0.04))
    assert known.size_m == 0.5
    assert (known.drone_probability, known.centre.tolist()) == (0.9, [48.0, 48.0])


def test_a_size_that_was_learned_is_that_of_drones_that_look_as_those_did() -> None:
    """Those looked 0.9 m large and were found to be 0.6 m; one that looks 1.4 m large is of another type."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    frames, vehicle = flyer.take_frames()
    (true,) = flyer.perception().observe(frames, vehicle, None).detections
    for looks, factor in ((1.0, 0.7), (1.4, 0.7), (1.6, 1.0), (0.6, 1.0)):
        learned = KnownSize(0.7 * true.size_m, 0.01, looks_m=looks * true.size_m)
        (known,) = flyer.perception().observe(frames, vehicle, None, learned_size=learned).detections
        assert known.range_m == pytest.approx(factor * true.range_m, rel=0.02)


def test_where_a_track_is_predicted_its_own_size_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first stage misses the drone; the track is 0.7 times as far as the size that is judged would have it."""
    monkeypatch.setattr("flockd.flight.perception.detection.detector.propose_instances", lambda *_: [])
    monkeypatch.setattr("flockd.flight.perception.detection.detector.propose_residuals", lambda *_: [])
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    frames, vehicle = flyer.take_frames()
    place = np.array([0.7 * 3.0, 0.0, 0.0])
    for size_m, known, factors in ((0.7 * _SIZE_M, True, [0.7]), (0.7 * _SIZE_M, False, [])):
        track = Prediction(place, 0.01 * np.eye(3), size_m, 0.99, size_known=known)
        found = flyer.perception().observe(frames, vehicle, None, [track]).detections
        assert [one.range_m / 3.0 for one in found] == pytest.approx(factors, rel=0.05)


@pytest.mark.parametrize("size_m", [0.0, math.inf, math.nan])
def test_nonsense_of_the_network_gives_no_range(size_m: float) -> None:
    assert math.isnan(replace(ESTIMATE, size_m=size_m).of_size(KnownSize(0.5, 0.02)).log_range)


def test_a_flights_detections_are_ranged_by_it() -> None:
    """With exact networks, which know the drone's true size: a size said wrong by a factor moves the drone by it."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    frames, vehicle = flyer.take_frames()
    (true,) = flyer.perception().observe(frames, vehicle, None).detections
    for factor in (0.8, 1.0, 1.25):
        said = {"scale": "network", "drone_size_m": factor * true.size_m, "drone_size_sigma_m": 0.1 * true.size_m}
        config = flyer.scenario.drone.perception.model_copy(update=said)
        (known,) = Perception(flyer.cameras.rig, flyer.truth, config).observe(frames, vehicle, None).detections
        assert known.range_m == pytest.approx(factor * true.range_m, rel=0.01)
        assert known.size_m == pytest.approx(factor * true.size_m)
        wanted = math.hypot(true.range_sigma_m / true.range_m, 0.1 / factor)
        assert known.range_sigma_m / known.range_m == pytest.approx(wanted, rel=0.05)
        assert known.bearing == pytest.approx(true.bearing, abs=1e-3)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"drone_size_m": 0.04}, "greater than or equal to 0.05"),
        ({"drone_size_m": 5.1}, "less than or equal to 5"),
        ({"drone_size_m": math.nan}, "finite number"),
        ({"drone_size_m": 0.35, "drone_size_sigma_m": -0.01}, "greater than or equal to 0"),
        ({"drone_size_m": 0.35, "drone_size_sigma_m": 0.2}, "0.2 m is more than 30% of drone_size_m, 0.35 m; measure"),
        ({"drone_size_m": 0.35, "distance": "none"}, "needs the apparent size, which a second stage gives"),
    ],
)
def test_sizes_that_cannot_be_are_refused(values: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        PerceptionConfig.model_validate(values)
