"""Neighbours are taken to manoeuvre as hard as the own drone does, and are followed in gusts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.flight.geometry import log_polar
from flockd.flight.tracking import Measurement, Tracker, TrackingParameters
from flockd.flight.tracking.manoeuvres import Manoeuvres

Array = NDArray[np.float64]
STEP_S = 0.5
LEAST = 0.3**2 * 0.5
CALM = TrackingParameters(first_acceleration_sigma_m_s2=0.3)
"""Nothing is left of the start."""
SUBSTEPS = 50


def _ways(density: float, steps: int, seed: int) -> Array:
    """(steps, 3) m in each step of a body that white noise of this density accelerates to the north and to the east."""
    dt = STEP_S / SUBSTEPS
    kicks = np.random.default_rng(seed).normal(0.0, math.sqrt(density * dt), (steps * SUBSTEPS, 2))
    ways: Array = (np.cumsum(kicks, axis=0) * dt).reshape(steps, SUBSTEPS, 2).sum(axis=1)
    return np.column_stack([ways, np.zeros(steps)])


def test_steady_flight_has_the_density_of_the_parameters() -> None:
    manoeuvres = Manoeuvres(TrackingParameters())
    for _ in range(20):
        manoeuvres.see(np.array([0.5, 0.1, 0.0]), 0.0, STEP_S)
    np.testing.assert_allclose(manoeuvres.density, LEAST)


def test_the_start_is_wild_until_the_own_motion_says_otherwise() -> None:
    """0.8 m/s^2 for 0.5 s at first; steady flight is told from it after some of the 3 s of memory."""
    manoeuvres = Manoeuvres(TrackingParameters(first_acceleration_sigma_m_s2=0.8, own_manoeuvre_memory_s=3.0))
    assert manoeuvres.density[0] == pytest.approx(0.32)
    for _ in range(9):
        manoeuvres.see(np.array([0.5, 0.1, 0.0]), 0.0, STEP_S)
    assert manoeuvres.density[0] == pytest.approx(0.32 * math.exp(-8 * STEP_S / 3.0))


@pytest.mark.parametrize("density", [0.1, 1.0])
def test_white_noise_is_found_again(density: float) -> None:
    manoeuvres = Manoeuvres(TrackingParameters(own_manoeuvre_memory_s=500.0))
    for way in _ways(density, 10_000, seed=1):
        manoeuvres.see(way, 0.0, STEP_S)
    north, east, down = manoeuvres.density
    assert north == east == pytest.approx(density, rel=0.15)
    assert down == LEAST


def test_errors_of_the_own_motion_are_no_manoeuvres() -> None:
    """A drone that stands still, with displacements that err by 2 cm in steps of 0.1 s."""
    manoeuvres = Manoeuvres(TrackingParameters(own_manoeuvre_memory_s=500.0))
    for error in np.random.default_rng(3).normal(0.0, 0.02, (20_000, 3)):
        manoeuvres.see(error, 0.02, 0.1)
    np.testing.assert_allclose(manoeuvres.density, LEAST, atol=0.03)


def test_two_frame_sets_at_nearly_the_same_time_are_no_manoeuvre() -> None:
    """Steady flight at 1 m/s; one step takes 2 ms, in which an error of 2 cm would be 10 m/s."""
    manoeuvres = Manoeuvres(CALM)
    for _ in range(5):
        manoeuvres.see(np.array([0.5, 0.0, 0.0]), 0.02, STEP_S)
    manoeuvres.see(np.array([0.022, 0.0, 0.0]), 0.02, 0.002)
    manoeuvres.see(np.array([0.5, 0.0, 0.0]), 0.02, STEP_S)
    np.testing.assert_allclose(manoeuvres.density, LEAST)


def test_it_is_forgotten_in_calm_air() -> None:
    manoeuvres = Manoeuvres(TrackingParameters())
    ways = _ways(1.0, 20, seed=2)
    for way in ways:
        manoeuvres.see(way, 0.0, STEP_S)
    gusty = manoeuvres.density[0]
    for _ in range(6):
        manoeuvres.see(ways[-1], 0.0, STEP_S)
    assert gusty > 0.3
    assert manoeuvres.density[0] == pytest.approx(gusty * math.exp(-1))  # 6 steps of 0.5 s, 3 s of memory


def test_an_unknown_motion_is_no_manoeuvre() -> None:
    manoeuvres = Manoeuvres(CALM)
    manoeuvres.see(np.array([2.0, 0.0, 0.0]), 0.0, STEP_S)
    manoeuvres.see(None, 0.0, STEP_S)
    manoeuvres.see(np.zeros(3), 0.0, STEP_S)
    np.testing.assert_allclose(manoeuvres.density, LEAST)


def test_the_tracker_knows_its_errors_in_gusts() -> None:
    """Both drones fly in gusts; the squared error over the filter's variance has a mean of about 1 an axis."""
    ratios: list[float] = []
    for seed in range(10):
        own, other = _ways(1.0, 60, 2 * seed), _ways(1.0, 60, 2 * seed + 1)
        noise = np.random.default_rng([seed, 5]).normal(0.0, 0.05, (60, 3))
        tracker, place = Tracker(TrackingParameters(max_unseen_s=30.0)), np.array([400.0, 0.0, 0.0])
        for step in range(60):
            if step:
                tracker.predict(STEP_S, own[step])
                place = place + other[step] - own[step]
            bearing, log_range = log_polar(place + noise[step])
            covariance = (0.05 / math.exp(log_range)) ** 2 * np.eye(3)
            tracker.update(step * STEP_S, [Measurement(bearing, log_range, covariance, 0.6)], own[step] / STEP_S)
            if step > 10:
                track = max(tracker.neighbours(), key=lambda one: one.hits)
                error = track.position[:2] - place[:2]
                ratios.append(float(error @ error) / 2 / track.position_sigma_m**2)
    assert 0.3 < np.mean(ratios) < 2.0


def test_one_lie_of_the_own_motion_changes_no_track() -> None:
    """In one of twenty steps the own motion is a metre off; both neighbours keep their tracks and places."""
    random = np.random.default_rng(0)
    places = np.array([[4.0, 0.0, 0.0], [3.0, 2.0, 0.3]])
    tracker = Tracker(TrackingParameters())
    numbers = []
    for step in range(20):
        if step:
            tracker.predict(STEP_S, np.array([0.5, 1.0 if step == 12 else 0.0, 0.0]), 0.02)
        seen = [log_polar(place + random.normal(0.0, 0.05, 3)) for place in places]
        numbers.append(
            tracker.update(
                step * STEP_S,
                [Measurement(at, log_m, (0.05 / math.exp(log_m)) ** 2 * np.eye(3), 0.6) for at, log_m in seen],
                np.array([1.0, 0.0, 0.0]),
            )
        )
    assert set(numbers) == {(1, 2)}
    np.testing.assert_allclose([one.position for one in tracker.neighbours()], places, atol=0.2)
