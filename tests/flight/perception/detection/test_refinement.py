"""The cascade of crops: how often, how wide, and what becomes of contradictions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.flight.perception import Crop, RangeEstimate
from flockd.flight.perception.maps import SceneMaps
from tests.flight.pilot.flyer import Flyer, scenario_with


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
def test_a_proposal_is_cropped_again_until_the_crop_suits_the_drone(wrong_by: tuple[float, ...], wanted: int) -> None:
    """What a badly cut crop says of the range cuts the next one; the last estimate counts."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.3, -4.5)))
    estimates = flyer.truth.sound("ranges")
    asked: list[int] = []

    def ranges(crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        asked.append(len(crops))
        factor = wrong_by[min(len(asked), len(wrong_by)) - 1]
        return tuple(replace(one, log_range=math.log(factor) + one.log_range) for one in estimates(crops))

    flyer.truth.instead["ranges"] = ranges
    (detection,) = flyer.step().detections
    assert asked == [1] * (wanted + 1)
    assert np.linalg.norm(detection.position) == pytest.approx(math.hypot(3.0, 0.3), rel=0.01)


def test_the_mirrored_crop_is_weighted_by_its_variance() -> None:
    """A drone is 3 m away: the last crop says 3 m, its mirror image 6."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    estimates = flyer.truth.sound("ranges")
    mirrors: list[bool] = []

    def ranges(crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        mirrors.extend(crop.mirrored for crop in crops)
        given = [replace(one, log_range_sigma=0.05, drone_probability=0.9) for one in estimates(crops)]
        if mirrors[-1]:
            given[0] = replace(given[0], log_range=math.log(6.0), log_range_sigma=0.1, drone_probability=0.85)
        return tuple(given)

    flyer.truth.instead["ranges"] = ranges
    (detection,) = flyer.step().detections
    assert mirrors == [False, False, True]
    assert np.linalg.norm(detection.position) == pytest.approx(3.0 * 2 ** (1 / 5), rel=0.005)  # 1 of 1 + 4
    assert detection.drone_probability == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ((0.3, 0.9, 0.9), 1),
        ((0.3, 0.85, 0.85), 1),
        ((0.1, 0.9, 0.9), 0),
        ((0.9, 0.75, 0.9), 0),
        ((0.9, 0.9, 0.75), 0),
    ],
)
def test_a_low_probability_of_the_first_crop_does_not_outlive_the_next(given: tuple[float, ...], found: int) -> None:
    """Only a very low one rejects at once; the first crop was not cut to this drone."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    estimates, probabilities = flyer.truth.sound("ranges"), list(given)
    flyer.truth.instead["ranges"] = lambda crops: tuple(
        replace(one, drone_probability=probabilities.pop(0)) for one in estimates(crops)
    )
    assert len(flyer.step().detections) == found


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("wrong", [{"log_range": math.inf}, {"log_range": math.nan}, {"log_range_sigma": 0.0}])
def test_nonsense_for_the_mirrored_crop_gives_no_detection(wrong: dict[str, Any]) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    estimates = flyer.truth.sound("ranges")

    def ranges(crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        return tuple(
            replace(estimate, **wrong) if crop.mirrored else estimate
            for crop, estimate in zip(crops, estimates(crops), strict=True)
        )

    flyer.truth.instead["ranges"] = ranges
    assert not flyer.step().detections


def test_every_crop_of_a_proposal_carries_what_a_detector_said_of_it() -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.5), (3.0, 0.0, -4.5)))
    estimates, scenes = flyer.truth.sound("ranges"), flyer.truth.sound("scene")
    carried: list[float] = []

    def scene(*arguments: Any) -> SceneMaps:
        maps: SceneMaps = scenes(*arguments)
        return replace(maps, instances=tuple(replace(one, evidence=2.5) for one in maps.instances))

    def ranges(crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        carried.extend(crop.evidence for crop in crops)
        given: tuple[RangeEstimate, ...] = estimates(crops)
        return given

    flyer.truth.instead |= {"scene": scene, "ranges": ranges}
    assert flyer.step().detections
    assert carried == [2.5] * 3
