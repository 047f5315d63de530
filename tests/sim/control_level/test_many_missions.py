"""Missions as arrays against the missions that one drone flies."""

from __future__ import annotations

import numpy as np

from flockd.core.data import data_path
from flockd.flight.mission import Moment, Navigator
from flockd.flight.safety import GateParameters
from flockd.sim.control_level.many_missions import HOME_DEG, ManyMissions
from flockd.sim.scenario import load_scenario


def test_waypoints_count_as_reached_for_the_same_drones_at_the_same_time() -> None:
    """Each drone's own `Navigator` makes the same of middles that come near, turn away and stand still."""
    scenario = load_scenario(data_path("config") / "square.yaml")
    flights, drones, rng = 3, len(scenario.vehicles), np.random.default_rng(4)
    many = ManyMissions(scenario, flights)
    ones = [[Navigator(scenario.drone_of(0).mission, GateParameters()) for _ in range(drones)] for _ in range(flights)]
    offsets = rng.normal(0, 1.5, (2, flights, drones))  # of what each takes for the middle
    positions = np.zeros((2, flights, drones))
    names: set[str] = set()
    for step in range(500):
        middles = offsets + rng.normal(0, 0.05, offsets.shape)
        velocity, _ = many.step(0.5 * step, positions, middles)
        for f, i in np.ndindex(flights, drones):
            moment = Moment(0.5 * step, positions[:, f, i], middles[:, f, i], np.array(HOME_DEG))
            guidance = ones[f][i].step(moment)
            np.testing.assert_allclose(velocity[:, f, i], ones[f][i].pull(guidance), atol=1e-9)
            names.add(guidance.sentence.split()[-3])
        positions = positions + 0.5 * velocity.mean(axis=2, keepdims=True)  # all go where they agree to go
    assert names == {"1", "2", "3", "4"}
    assert np.hypot(*(positions.mean(axis=2))).max() < 2.0  # the last waypoint is the first place
