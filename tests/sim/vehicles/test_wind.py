"""Gusts: a turbulent field of Dryden's spectrum, in which drones that are near each other are pushed alike."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.sim.scenario import StartConfig, VehicleConfig
from flockd.sim.vehicles.vehicles import GUST_TIME_S, MAX_LEAN_M_S2, GustField, Vehicles, push_sigma_m_s2

GUSTY = VehicleConfig(gust_m_s=0.3, gust_length_m=20.0)
FIELDS = [GustField.of(GUSTY, seed) for seed in range(600)]


def _correlation(apart_m: tuple[float, float, float]) -> tuple[float, float]:
    """Of the pushes at two places of one time, north and east, over many fields; 1 for the same place."""
    places = np.array([[0.0, 0.0, -5.0], [0.0, 0.0, -5.0]])
    places[1] += apart_m
    pushes = np.array([field.push(7.0, places) for field in FIELDS])
    north, east = (pushes[:, 0] * pushes[:, 1]).mean(axis=0) / push_sigma_m_s2(GUSTY) ** 2
    return float(north), float(east)


@pytest.mark.parametrize("r", [0.0, 2.0, 10.0, 30.0])
def test_the_correlation_over_distance_is_drydens(r: float) -> None:
    """exp(-r / L) along the offset, (1 - r / 2 L) exp(-r / L) across: of MIL-F-8785C's spectra, L = 20 m."""
    along, across = math.exp(-r / 20), (1 - r / 40) * math.exp(-r / 20)
    assert _correlation((r, 0.0, 0.0)) == pytest.approx((along, across), abs=0.12)
    assert _correlation((0.0, r, 0.0)) == pytest.approx((across, along), abs=0.12)
    assert _correlation((0.0, 0.0, r)) == pytest.approx((across, across), abs=0.12)


def test_the_wind_carries_the_field_along_and_a_gust_lasts_two_seconds() -> None:
    """At one place, the mean of along and across at 20 m / 2 s times t."""
    pushes = np.array([[field.push(t, np.zeros((1, 3)))[0] for t in (0.0, 1.0)] for field in FIELDS])
    over = 1.0 / GUST_TIME_S
    expected = (1 + (1 - over / 2)) / 2 * math.exp(-over)
    found = (pushes[:, 0] * pushes[:, 1]).mean() / push_sigma_m_s2(GUSTY) ** 2
    assert found == pytest.approx(expected, abs=0.08)


def test_without_gusts_nothing_pushes() -> None:
    np.testing.assert_array_equal(GustField.of(VehicleConfig(), 3).push(1.0, np.zeros((2, 3))), np.zeros((2, 2)))


def test_a_vehicle_leans_against_gusts_harder_than_it_follows_setpoints() -> None:
    """Pushes of 2.1 m/s^2 an axis: with no more than 4 m/s^2 against them drones were carried away at 10 m/s."""
    config = VehicleConfig(gust_m_s=0.5, velocity_time_constant_s=0.25, max_acceleration_m_s2=4.0)
    assert push_sigma_m_s2(config) == pytest.approx(2.1, abs=0.1)
    assert config.max_acceleration_m_s2 < MAX_LEAN_M_S2 == pytest.approx(9.81)
    fastest = []
    for seed in range(6):
        vehicles = Vehicles([StartConfig(position_m=(0.0, 0.0, -5.0))], config, seed=seed)
        for _ in range(60):
            vehicles.step(np.zeros((1, 2)), np.zeros(1), 1.0)
            fastest.append(np.hypot(*vehicles.velocity[0, :2]))
    assert max(fastest) < 5 * 0.5  # of 360 draws of a Rayleigh distribution the largest is 3.4 sigma


def test_a_setpoint_is_followed_no_harder_in_gusts() -> None:
    """Two vehicles side by side are pushed alike, so that their difference is what the setpoint makes."""
    vehicles = Vehicles(
        [StartConfig(position_m=(0.0, 0.0, -5.0))] * 2, VehicleConfig(gust_m_s=0.3, max_acceleration_m_s2=4.0), seed=1
    )
    for _ in range(10):
        before = vehicles.velocity[1, 0] - vehicles.velocity[0, 0]
        vehicles.step(np.array([[0.0, 0.0], [9.0, 0.0]]), np.zeros(2), 0.1)
        assert vehicles.velocity[1, 0] - vehicles.velocity[0, 0] - before <= 0.1 * 4.0 + 0.05
