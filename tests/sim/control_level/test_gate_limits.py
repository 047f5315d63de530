"""Flights at control level with safety gates against the gates themselves, one object a drone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockd.sim.control_level import fly_flocks
from flockd.sim.control_level.flock_flights import FlockFlights
from flockd.sim.flock.exact_states import fly_exact_states
from flockd.sim.flock.start import scattered
from flockd.sim.scenario import ScenarioConfig
from tests.sim.control_level.flocks import SHIPPED, flock, level


def _scenario(drones: int, **keys: Any) -> ScenarioConfig:
    """A flock that is too dense: its gates have to limit it."""
    dense = {"drone__safety__gate__fence_radius_m": None, "drone__flocking__weight__kind": "uniform"}
    return scattered(level(flock(drones=drones, duration_s=6.0, **dense, **keys)), 0.8)


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"drone__flocking__cohesion": 0.5, "drone__safety__gate__min_separation_m": 1.4},
        {"vehicle__gust_m_s": 0.3, "seed": 4, "drone__safety__gate__max_acceleration_m_s2": 1.0},
        {
            "world__obstacles__kind": "forest",
            "world__obstacles__trees_per_hectare": 400.0,
            "world__obstacles__free_start_m": 1.0,
            "drone__obstacles__enabled": True,
            "drone__safety__gate__obstacle_clearance_m": 1.5,
        },
    ],
)
def test_each_drone_flies_as_its_gate_says(keys: dict[str, Any]) -> None:
    scenario = _scenario(9, **keys)
    expected, free = (fly_exact_states(scenario, gated=gated)[1][..., :2] for gated in (True, False))
    assert np.abs(expected - free).max() > 0.01, "the gates act"
    flights = FlockFlights([scenario], gated=True)
    for step in range(flights.steps):
        np.testing.assert_allclose(flights.states[:2, 0].T, expected[step], atol=1e-9)
        flights.step(step)


def test_drones_that_fly_at_each_other_stop_in_time() -> None:
    """With the law's command held away from 0 two drones meet head-on; 1 m is the gate's separation."""
    keys = {"drone__flocking__separation": 0.0, "drone__flocking__desired_distance_m": 0.2}
    scenario = _scenario(2, **keys)
    without, gated = (fly_flocks([scenario], gated=gated)[0] for gated in (False, True))
    assert without["min_distance_m"] < 0.7  # type: ignore[operator]
    assert gated["min_distance_m"] >= 0.99  # type: ignore[operator]


def test_a_gated_flight_is_the_same_in_any_batch() -> None:
    dense = _scenario(130).model_copy(update={"duration_s": 1.0})
    flown = [scattered(dense.model_copy(update={"seed": seed}), 0.1) for seed in range(4)]
    alone = fly_flocks(flown[2:3], errors=SHIPPED, gated=True)
    assert fly_flocks(flown, errors=SHIPPED, gated=True)[2:3] == alone
    assert fly_flocks(flown[2:3], errors=SHIPPED) != alone
