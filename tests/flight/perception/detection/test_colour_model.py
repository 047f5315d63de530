"""A pixel is a drone's where its colour is."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.flight.perception.detection.colour_model import reweight_by_colour

WEIGHT = 4.0
OWN, AROUND = (100, 100, 100), (200, 200, 200)


def reweighted(*pixels: tuple[float, tuple[int, int, int]]) -> list[float]:
    """What becomes of these, among 50 pixels of the drone and 200 around it."""
    everything = [*pixels, *[(5.0, OWN)] * 50, *[(-5.0, AROUND)] * 200]
    logits = np.array([[logit for logit, _ in everything]], np.float32)
    image = np.array([[colour for _, colour in everything]], np.uint8)
    return [float(value) for value in reweight_by_colour(logits, image, WEIGHT)[0, : len(pixels)]]


def test_what_has_the_drones_colours_becomes_the_drones_and_what_has_those_around_it_does_not() -> None:
    own, around = reweighted((-1.0, OWN), (1.0, AROUND))
    assert own > 3.0
    assert around < -3.0


def test_a_little_more_red_green_or_blue_is_still_the_drones_colour() -> None:
    red, green, blue = reweighted((0.0, (112, 100, 100)), (0.0, (100, 112, 100)), (0.0, (100, 100, 112)))
    assert red > 3.0
    assert [green, blue] == pytest.approx([red, red], rel=0.05)


def test_what_lies_far_from_a_drone_is_left_alone_and_counts_for_nothing() -> None:
    without = reweighted((0.5, (150, 150, 150)))
    far = [(-9.0, OWN)] * 300
    assert reweighted((0.5, (150, 150, 150)), *far) == pytest.approx([*without, *[-9.0] * 300])


def test_numbers_stay_finite_however_sure_the_networks_are() -> None:
    sure = reweight_by_colour(np.full((4, 4), 60.0, np.float32), np.zeros((4, 4, 3), np.uint8), WEIGHT)
    assert np.isfinite(sure).all()
    unsure = reweight_by_colour(np.full((4, 4), -60.0, np.float32), np.zeros((4, 4, 3), np.uint8), WEIGHT)
    assert (unsure == -60.0).all()
