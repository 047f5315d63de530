"""Flights at control level among obstacles against one drone's avoidance, and against the simulator's exact flights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockd.review.report.summary import obstacle_figures
from flockd.sim.control_level import fly_flocks
from flockd.sim.control_level.flock_flights import FlockFlights
from flockd.sim.flock.exact_states import ExactFlock
from flockd.sim.flock.start import scattered
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig
from tests.sim.control_level.flocks import errors, flock

STEP_S = 0.5


def _scenario(kind: str, drones: int, **keys: Any) -> ScenarioConfig:
    """A small, dense world around the drones."""
    small = {"world__obstacles__extent_m": 20.0, "world__obstacles__free_start_m": 1.0, **keys}
    scenario = flock(kind, drones, **small, drone__safety__gate__fence_radius_m=None)
    starts = scenario.vehicles
    away = np.mean([vehicle.position_m[:2] for vehicle in starts], axis=0)
    places = [(v.position_m[0] - away[0], v.position_m[1] - away[1], v.position_m[2]) for v in starts]
    moved = tuple(v.model_copy(update={"position_m": place}) for v, place in zip(starts, places, strict=True))
    return scattered(scenario.model_copy(update={"vehicles": moved}), 0.5)


@pytest.mark.parametrize(
    ("kind", "faultless", "keys"),
    [
        ("forest", False, {"world__obstacles__trees_per_hectare": 400.0, "drone__flocking__weight__nearest": 3}),
        ("village", True, {"world__obstacles__extent_m": 25.0, "drone__obstacles__clearance_m": 1.2}),
    ],
)
def test_each_drone_is_asked_to_fly_as_its_own_avoidance_says(kind: str, faultless: bool, keys: dict[str, Any]) -> None:
    scenarios = [_scenario(kind, 6, seed=seed, **keys) for seed in (0, 1)]
    blind = [_scenario(kind, 6, seed=seed, **keys, drone__obstacles__enabled=False) for seed in (0, 1)]
    flights = FlockFlights(scenarios, errors() if faultless else None)
    flocks = [(ExactFlock(scenario), ExactFlock(unseen)) for scenario, unseen in zip(scenarios, blind, strict=True)]
    flights.states[:3, :, 1] = flights.states[:3, :, 0] + [[0.02], [0.05], [-0.6]]  # above the first: in no direction
    turned = 0
    for step in range(8):
        flights.states[3:5] += np.random.default_rng(step).normal(0.0, 0.4, flights.states[3:5].shape)
        before = flights.states.copy()
        flights.step(step)
        for flight, pair in enumerate(flocks):
            states = before[:3, flight].T, before[3:, flight].T
            expected, unseen = (flock.step(step * STEP_S, *states).velocity for flock in pair)
            np.testing.assert_allclose(flights.commands[:, flight].T, expected, atol=1e-9)
            turned += (np.hypot(*(expected - unseen).T) > 0.1).sum()
    assert turned > 40


@pytest.mark.parametrize("enabled", [True, False])
def test_the_figures_are_those_of_a_flight_on_exact_states(enabled: bool) -> None:
    keys = {"world__obstacles__trees_per_hectare": 400.0, "drone__obstacles__enabled": enabled, "duration_s": 6.0}
    scenarios = [_scenario("forest", 4, seed=seed, **keys) for seed in (2, 3)]
    flown = fly_flocks(scenarios)
    for scenario, figures in zip(scenarios, flown, strict=True):
        expected = obstacle_figures(fly(scenario, perception="truth", gated=False, pictured=False).log)
        assert {key: figures[key] for key in expected} == pytest.approx(expected, abs=1e-8)
    assert (max(one["collisions"] or 0 for one in flown) > 0) is not enabled


@pytest.mark.slow  # the simulator's flights take 2.5 s each
@pytest.mark.parametrize("seed", range(4))
def test_the_shipped_forest_is_flown_as_the_simulator_flies_it(seed: int) -> None:
    scenario = flock("forest", seed=seed)
    flights, log = FlockFlights([scenario]), fly(scenario, perception="truth", gated=False, pictured=False).log
    for step in range(flights.steps):
        np.testing.assert_allclose(flights.states[:3, 0].T, log.position[step], atol=1e-9)
        flights.step(step)
    expected = obstacle_figures(log)
    assert {key: flights.figures()[0][key] for key in expected} == pytest.approx(expected, abs=1e-8)


def test_a_flight_among_obstacles_is_the_same_in_any_batch() -> None:
    keys = {"world__obstacles__trees_per_hectare": 400.0, "duration_s": 1.0}
    flown = [_scenario("forest", 150, seed=seed, **keys) for seed in (4, 5)]
    alone = [fly_flocks([one])[0] for one in flown]
    assert fly_flocks(flown[::-1]) == alone[::-1]
    assert alone[0]["min_clearance_m"] != alone[1]["min_clearance_m"]  # each seed has its own forest


def test_a_flight_without_obstacles_has_no_figures_of_them() -> None:
    scenario = flock(duration_s=1.0)
    assert fly_flocks([scenario])[0]["collisions"] is None
