"""Where no camera looks there may be somebody: closed-loop flights with a camera lost for good, or a gap in the rig."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from flockd.core.config.mission import MissionParameters
from flockd.core.messages import FloatArray
from flockd.sim.flock.control_loop import ControlLoop
from flockd.sim.flock.exact_states import ExactFlock
from flockd.sim.scenario import CameraFaultConfig, ScenarioConfig, StartConfig
from flockd.sim.vehicles.vehicles import Vehicles
from tests.make import changed
from tests.sim.flock.test_encounters import ENCOUNTER, MISSED

pytestmark = pytest.mark.fault("blind-sector")

LOST_S, FLIES_S = 6.0, 30.0
SEEN_M = 10.0
"""Farther away nobody is detected."""
APART_M = 1.0


def scenario(speed_m_s: float, hovers_at: tuple[float, float], seed: int, faults: Sequence[str] = ()) -> ScenarioConfig:
    """One that flies north, and one in its way that hovers and avoids nobody; from `LOST_S` on cameras are lost."""
    north = MissionParameters(kind="velocity", velocity_m_s=(speed_m_s, 0.0))
    vehicles = (
        StartConfig(position_m=(0.0, 0.0, -5.0), velocity_m_s=(speed_m_s, 0.0), mission=north),
        StartConfig(position_m=(*hovers_at, -5.0), mission=MissionParameters(kind="hover"), by_hand=True),
    )
    lost = tuple(CameraFaultConfig(drone=1, camera=camera, begin_s=LOST_S) for camera in faults)
    seen = {"detections__missed": MISSED} if speed_m_s > 1.5 else {}
    return changed(ENCOUNTER, vehicles=vehicles, seed=seed, faults=lost, detections__range_m=SEEN_M, **seen)


def flown(flight: ScenarioConfig) -> tuple[FloatArray, float]:
    """Where the first was, (n, 2) m each step, and how near the two came."""
    flock, loop = ExactFlock(flight), ControlLoop(flight)
    vehicles = Vehicles(flight.vehicles, flight.vehicle, seed=flight.seed, sensors=flight.sensors)
    step_s, places, apart_m = flight.drone.step_s, [], []
    for step in range(round(FLIES_S / step_s)):
        places.append(vehicles.position[0, :2])
        apart_m.append(math.dist(*vehicles.position))
        wanted = flock.step(step * step_s, vehicles.position, vehicles.velocity, own=vehicles.known_velocity)
        loop.fly(step * step_s, vehicles, wanted)
    assert not loop.handed_over
    return np.array(places), min(apart_m)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 8))])
@pytest.mark.parametrize("speed_m_s", [1.0, 2.0])
@pytest.mark.parametrize("camera", ["front", "right", "back"])
def test_one_whose_camera_is_lost_for_good_stops_before_what_is_there_and_flies_on(
    camera: str, speed_m_s: float, seed: int
) -> None:
    """What hovers is 2 m farther than it can be seen when the camera is lost. With the front camera lost the drone
    stops, turns by 60 degrees and flies on past it; with another one it has no need to."""
    hovers_m = LOST_S * speed_m_s + SEEN_M + 2.0
    places, nearest_m = flown(scenario(speed_m_s, (hovers_m, 0.3), seed, [camera]))
    assert nearest_m >= APART_M
    north_m = dict(zip(np.arange(len(places)) * 0.5, places[:, 0], strict=True))
    assert (north_m[LOST_S + 4.0] - north_m[LOST_S] < 3.4) == (camera == "front")
    assert places[-1, 0] > hovers_m - 3.0


@pytest.mark.parametrize("speed_m_s", [1.0, 2.0])
def test_a_gap_of_the_rig_is_not_flown_into(speed_m_s: float) -> None:
    """It has a camera to each side and one behind, but none ahead."""
    flight = scenario(speed_m_s, (12.0, 0.0), 1)
    behind = tuple(camera for camera in flight.drone.rig.cameras if camera.name != "front")
    places, nearest_m = flown(changed(flight, drone__rig__cameras=behind))
    assert nearest_m >= APART_M
    assert places[-1, 0] > 9.0
