"""Drones of families that no network was trained on find out how large the others are, by sight (`flocking.size`)."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.sim.flock.swarm import fly
from flockd.sim.renderer.drone_models import drone_model
from tests import make


def range_errors(log: FlightLog, drone: int, since_s: float, until_s: float) -> FloatArray:
    """Relative, of the neighbours that one drone knows, each by the true one nearest in bearing."""
    errors = []
    for step, i, _, *place in log.tracked:
        if int(i) == drone and since_s < log.time_s[int(step)] <= until_s:
            others = np.delete(log.position[int(step)] - log.position[int(step), drone], drone, axis=0)
            ranges, range_m = np.linalg.norm(others, axis=1), float(np.linalg.norm(place))
            errors.append(range_m / ranges[np.argmax(others @ np.array(place) / ranges)] - 1)
    return np.array(errors)


@pytest.mark.slow
@pytest.mark.parametrize("family", [12, 13])
def test_a_size_that_no_network_knows_is_found_in_twenty_seconds(family: int) -> None:
    """By the first that weaves, within twice the error that it states; its ranges are better from then on."""
    overrides = {"duration_s": 20.0, "world.drone_family": family, "drone.flocking.size": "learn"}
    log = fly(make.scenario(overrides, drones=3), pictured=False).log
    sizes = log.metadata.sizes
    drone = min(sizes, key=lambda one: sizes[one].since_s)
    since_s, true_m = sizes[drone].since_s, drone_model(family, 1).size_m
    assert abs(np.log(sizes[drone].size_m / true_m)) < 2 * sizes[drone].sigma < 0.4
    before = range_errors(log, drone, 2.0, since_s - 0.1)
    after = range_errors(log, drone, since_s - 0.1, 24.0)
    assert np.median(np.abs(after)) < np.median(np.abs(before))
