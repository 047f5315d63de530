"""The own motion's scale from a range to the ground, on rendered frames with perception answered by the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flockd.core.messages import RangeReading
from flockd.flight.pilot import FlockPilot
from flockd.sim.autopilot.fake_range_finder import range_to_ground
from tests.flight.pilot.flyer import Flyer, scenario_with

HEIGHT_M = 5.0


@pytest.fixture(scope="module")
def hilly() -> Flyer:
    """Over hills, away from the level place at the origin."""
    scenario = scenario_with((14.0, 12.0, -HEIGHT_M))
    world = scenario.world.model_copy(update={"hills_m": 5.0, "ground_relief_m": 0.02})
    perception = scenario.drone.perception.model_copy(update={"height": "range_finder"})
    drone = scenario.drone.model_copy(update={"perception": perception})
    return Flyer(scenario.model_copy(update={"world": world, "drone": drone}))


@pytest.mark.parametrize("factor", [1.0, 1.06])
def test_the_motion_is_as_long_as_the_range_says_and_the_slope_is_seen(hilly: Flyer, factor: float) -> None:
    """The true depth maps give the true motion; a range that is 6 % too long makes it 6 % longer."""
    hilly.pilot = FlockPilot(hilly.scenario.drone, hilly.truth)
    for _ in range(4):
        frames, state = hilly.take_frames()
        place, R = hilly.vehicles.position[0].copy(), hilly.vehicles.R_ned_body[0].copy()
        true_m = range_to_ground(place, R[:, 2], hilly.cameras.ground_height)
        output = hilly.pilot.step(frames, replace(state, ground_range=RangeReading(state.time_s, factor * true_m)))
        hilly.move()
        moved = hilly.vehicles.position[0] - place
    frames, state = hilly.take_frames()
    place_now, R_now = hilly.vehicles.position[0], hilly.vehicles.R_ned_body[0]
    true_m = range_to_ground(place_now, R_now[:, 2], hilly.cameras.ground_height)
    output = hilly.pilot.step(frames, replace(state, ground_range=RangeReading(state.time_s, factor * true_m)))
    assert output.ego_motion is not None
    np.testing.assert_allclose(R @ output.ego_motion.translation, factor * moved, atol=0.012)
    assert output.ground is not None
    assert output.ground.source == "range_finder"
    steps = np.array([-1.0, 1.0])
    north = hilly.cameras.ground_height(place_now[0] + steps, np.full(2, place_now[1]))
    east = hilly.cameras.ground_height(np.full(2, place_now[0]), place_now[1] + steps)
    slope = np.array([north[1] - north[0], east[1] - east[0]]) / 2.0
    assert np.hypot(*slope) > 0.03, "else this shows nothing"
    np.testing.assert_allclose(output.ground.slope, slope, atol=0.03)


def test_without_a_range_there_is_no_scale_and_neighbours_are_seen_all_the_same(hilly: Flyer) -> None:
    hilly.pilot = FlockPilot(hilly.scenario.drone, hilly.truth)
    for _ in range(2):
        output = hilly.step()
        hilly.move()
    assert output.counts["height: no range finder is heard; there is no scale"] == 1
    assert (output.ego_motion, output.ground) == (None, None)
    assert output.velocity is None
