"""Detections made up from the truth, and the flights on them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flockd.sim.flock.control_loop import Commands, ControlLoop
from flockd.sim.flock.exact_states import TrackedNeighbours, fly_exact_states
from flockd.sim.scenario import CameraFaultConfig, DetectionsConfig, ScenarioConfig, load_scenario
from flockd.sim.vehicles.vehicles import Vehicles
from tests.sim.flock.test_encounters import nearest_m

CONFIG = Path(__file__).parents[3] / "config"
ENCOUNTER = load_scenario(CONFIG / "encounter.yaml")
IDEAL = load_scenario(CONFIG / "encounter.yaml", {"ideal": True})
AHEAD = np.array([[0.0, 0.0, -5.0], [8.0, 6.0, -5.0]])


def known(seed: int = 0, steps: int = 20, positions: np.ndarray = AHEAD, **changes: Any) -> list[np.ndarray]:
    """Where the second drone, which hovers as the first does, is known to be after each step; NaN: nowhere."""
    config = DetectionsConfig(**{"false_at_once": 0.0, **changes})
    tracked = TrackedNeighbours(ENCOUNTER.model_copy(update={"seed": seed}), config, 0)
    found = [tracked.step(0.5 * i, positions, np.zeros((2, 3))) for i in range(steps)]
    return [one[0].position if one else np.full(3, np.nan) for one in found]


def test_who_is_near_is_tracked_to_within_the_errors() -> None:
    finals = np.array(
        [known(seed, missed=0.05, range_error=0.1, bearing_error_rad=0.01, error_time_s=0.0)[-1] for seed in range(20)]
    )
    errors = finals - [8.0, 6.0, 0.0]
    assert 0.02 < np.sqrt(np.mean(errors**2)) < 0.5  # one detection: 1 m along, 0.1 m across
    assert np.abs(errors.mean(axis=0)).max() < 0.3


def test_a_single_detection_is_off_by_the_errors_that_are_configured() -> None:
    """10 m away: 10 % along the line of sight, 0.02 rad across it."""
    found = np.array([known(seed, 1, missed=0.0, range_error=0.1, bearing_error_rad=0.02)[0] for seed in range(200)])
    ranges = np.linalg.norm(found, axis=1)
    assert np.std(np.log(ranges)) == pytest.approx(0.1, rel=0.2)
    assert np.std(found[:, 2] / ranges) == pytest.approx(0.02, rel=0.2)


def test_errors_that_are_not_written_are_of_the_airframe() -> None:
    perceived = yaml.safe_load((CONFIG / "perceived/shipped_networks.yaml").read_text())["detections"]["unknown"]
    found = np.array([known(seed, 1, airframe="unknown", missed=0.0)[0] for seed in range(200)])
    assert np.std(np.log(np.linalg.norm(found, axis=1))) == pytest.approx(perceived["range_error"], rel=0.2)


def test_nobody_is_known_beyond_the_range_nor_when_all_are_missed() -> None:
    assert np.isnan(known(missed=0.0, range_m=9.9)).all()
    assert np.isfinite(known(missed=0.0, range_m=10.1)[0]).all()
    assert np.isnan(known(missed=1.0)).all()


@pytest.mark.parametrize(("airframe", "beyond_m"), [("trained", 17.0), ("unknown", 10.1)])
def test_a_drone_is_missed_as_often_as_it_was_by_sight_at_that_distance(airframe: str, beyond_m: float) -> None:
    """Half way between two distances by the mean of both; beyond those that were measured always."""
    perceived = yaml.safe_load((CONFIG / "perceived/shipped_networks.yaml").read_text())["detections"][airframe]
    for (near_m, near), (far_m, far) in itertools.pairwise(perceived["missed"]):
        place = np.array([[0.0, 0.0, -5.0], [(near_m + far_m) / 2, 0.0, -5.0]])
        missed = np.mean([np.isnan(known(seed, 1, place, airframe=airframe)[0]).all() for seed in range(300)])
        assert missed == pytest.approx((near + far) / 2, abs=0.08), place
    assert np.isnan(known(steps=40, positions=np.array([[0, 0, -5], [beyond_m, 0, -5]]), airframe=airframe)).all()


def test_nobody_is_detected_in_the_view_of_a_camera_that_has_a_fault() -> None:
    """8 m north and 6 m east of a drone that faces north: 37 degrees right of ahead, which the front camera shows."""
    for camera, yaw_deg, seen in (("front", 0.0, False), ("back", 0.0, True), ("left", 90.0, False)):
        fault = CameraFaultConfig(drone=1, camera=camera, begin_s=2.0, end_s=4.0)
        scenario = ENCOUNTER.model_copy(update={"faults": (fault,)})
        tracked = TrackedNeighbours(scenario, DetectionsConfig(missed=0.0, false_at_once=0.0), 0)
        others = TrackedNeighbours(scenario, DetectionsConfig(missed=0.0, false_at_once=0.0), 1)
        unseen_s = []
        for i in range(12):
            found = tracked.step(0.5 * i, AHEAD, np.zeros((2, 3)), np.radians(yaw_deg))
            unseen_s.append(max((one.unseen_s for one in found), default=9.0))
            assert others.step(0.5 * i, AHEAD, np.zeros((2, 3)))[0].unseen_s == 0.0, "of another drone"
        assert (max(unseen_s[4:8]) == 0.0) == seen
        assert max(unseen_s[:4]) == max(unseen_s[8:]) == 0.0


def test_the_same_seed_gives_the_same_and_each_drone_its_own() -> None:
    np.testing.assert_array_equal(known(3), known(3))
    assert not np.array_equal(known(3), known(4))


def test_two_meet_head_on_and_stay_apart_and_would_not_if_they_were_blind() -> None:
    assert nearest_m(ENCOUNTER) >= 1.0
    blind = DetectionsConfig(missed=1.0)
    assert nearest_m(IDEAL.model_copy(update={"detections": blind})) < 0.1


@pytest.mark.parametrize("gated", [True, False])
def test_commands_come_late(*, gated: bool) -> None:
    """Asked for a metre a second to the north, and a step later to the east instead."""
    east_m = []
    for latency_s in (0.0, 0.3, 0.45):
        scenario = IDEAL.model_copy(update={"latency_s": latency_s})
        loop, vehicles = ControlLoop(scenario, gated=gated), Vehicles(scenario.vehicles, scenario.vehicle)
        for time_s, velocity in ((0.0, [1.0, 0.0]), (0.5, [0.0, 1.0])):
            loop.fly(time_s, vehicles, replace(Commands.of(2), velocity=np.tile(velocity, (2, 1))))
        east_m.append(float(vehicles.position[0, 1]))
    assert east_m[0] > 2 * east_m[1] > 4 * east_m[2] > 0.0


def limited(scenario: ScenarioConfig, time_s: float) -> ScenarioConfig:
    flocking = scenario.drone.flocking.model_copy(update={"cohesion_time_s": time_s})
    return scenario.model_copy(update={"drone": scenario.drone.model_copy(update={"flocking": flocking})})


def test_who_pulls_away_at_the_start_is_followed() -> None:
    """Three drones of which one knows the goal, seen up to 11 m: new neighbours pull little, but soon enough."""
    scenario = load_scenario(CONFIG / "one_knows.yaml", {"duration_s": 30.0, "ideal": True})
    three = scenario.model_copy(
        update={
            "vehicles": scenario.vehicles[:3],
            "detections": DetectionsConfig(missed=0.05, range_m=11.0, error_time_s=0.0, missed_time_s=0.0),
        }
    )
    positions = fly_exact_states(limited(three, 5.0))[1]
    apart = np.linalg.norm(positions[:, None] - positions[:, :, None], axis=-1)
    assert apart[-1].max() < 11.0
    positions = fly_exact_states(limited(three, 20.0))[1]
    assert np.linalg.norm(positions[-1, 0] - positions[-1, 1:], axis=-1).min() > 11.0


def test_errors_last_as_long_as_they_are_said_to() -> None:
    """The range's error of one neighbour, step by step: a Gauss-Markov process, its correlation exp(-t / 1.85 s)."""
    config = DetectionsConfig(missed=1.0, error_time_s=1.85)  # so that nobody is tracked
    tracked = TrackedNeighbours(ENCOUNTER, config, 0)
    errors = []
    for i in range(4000):
        tracked.step(0.5 * i, AHEAD, np.zeros((2, 3)))
        errors.append(tracked._errors[0, 0])
    for lag in (1, 6):
        assert np.corrcoef(errors[:-lag], errors[lag:])[0, 1] == pytest.approx(np.exp(-0.5 * lag / 1.85), abs=0.08)


def test_false_neighbours_are_there_as_often_and_as_long_as_they_are_said_to_be() -> None:
    """Nobody is near; 10 % of the time there is one, for 2 s each, half of them nearer than 5 m: all within 10 %."""
    config = DetectionsConfig(false_at_once=0.1, false_time_s=2.0, false_m=(3.0, 5.0, 9.0))
    alone = np.array([[0.0, 0.0, -5.0], [100.0, 0.0, -5.0]])
    found, steps = [], 20_000
    tracked = TrackedNeighbours(ENCOUNTER, config, 0)
    for i in range(steps):
        found += [(one.track, float(np.hypot(*one.position[:2]))) for one in tracked.step(0.5 * i, alone, alone * 0.0)]
    tracks = dict(found)
    assert len(found) / steps == pytest.approx(0.1, abs=0.02)
    assert 0.5 * len(found) / len(tracks) == pytest.approx(2.0, rel=0.1)
    assert np.median(list(tracks.values())) == pytest.approx(5.0, rel=0.1)
