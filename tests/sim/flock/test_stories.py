"""Stories of whole flights in the closed loop: made-up detections, tracker, law, gate at 20 Hz, vehicles as PX4's.

Distances count at every instant, also between steps.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from flockd.core.config.mission import MissionParameters, WaypointParameters
from flockd.core.messages import FloatArray
from flockd.sim.flock.control_loop import ControlLoop
from flockd.sim.flock.exact_states import ExactFlock
from flockd.sim.scenario import CameraFaultConfig, StartConfig
from flockd.sim.vehicles.vehicles import Vehicles
from tests.make import changed
from tests.sim.flock.test_encounters import ENCOUNTER
from tests.sim.flock.test_mates import APART_M, _Flight, _Watched

SIDE_M = 10.0


def _irregular() -> Iterator[float]:
    """Steps of 0.1 to 0.5 s, in whole periods of the gate."""
    random = np.random.default_rng(5)
    while True:
        yield 0.05 * int(random.integers(2, 11))


def _blind(drone: int, begin_s: float, end_s: float) -> list[CameraFaultConfig]:
    """All cameras of a drone, counted from 1."""
    names = [camera.name for camera in ENCOUNTER.drone.rig.cameras]
    return [CameraFaultConfig(drone=drone, camera=name, begin_s=begin_s, end_s=end_s) for name in names]


def _flies(speed_m_s: float, steps_s: Callable[[], Iterator[float]] | None = None) -> _Flight:
    flight = _Flight(0.06, 1, speed_m_s)
    flight.fly(15.0, steps_s and steps_s())
    return flight


@pytest.mark.parametrize("speed_m_s", [2.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_steps_of_any_length_keep_the_flock_together_and_apart(speed_m_s: float) -> None:
    flight = _flies(speed_m_s, _irregular)
    flight.loop.hold(0, flight.time_s, flight.vehicles)
    flight.fly(5.0, _irregular())
    places, flown = np.array(flight.vehicles.places), np.array(flight.vehicles.velocities)
    assert flight.vehicles.nearest_m() >= APART_M
    assert flown[100:300, :, 0].mean() > 0.6 * speed_m_s
    assert max(math.dist(a, b) for a, b in itertools.combinations(places[300], 2)) < 10.0


@pytest.mark.parametrize("drone", [1, *(pytest.param(drone, marks=pytest.mark.slow) for drone in (2, 3))])
def test_one_that_sees_nothing_for_three_seconds_at_2_m_s_stops_and_nobody_comes_near(drone: int) -> None:
    """After a second of hovering its autopilot holds, and an operator would have to ask it to fly on."""
    flight = _Flight(0.06, 1, 2.0, _blind(drone, 8.0, 11.0))
    flight.fly(15.0)
    assert flight.vehicles.nearest_m() >= APART_M
    assert {number: one.reason.split(":")[0] for number, one in flight.loop.handed_over.items()} == {
        drone - 1: "too few cameras deliver images"
    }
    others = np.delete(flight.vehicles.known_velocity[:, 0], drone - 1)
    assert others.max() < 2.5


def test_taken_over_at_3_m_s_a_drone_flies_on_at_that_speed() -> None:
    """The first setpoint is its own velocity, not standstill."""
    mission = MissionParameters(kind="velocity", velocity_m_s=(3.0, 0.0))
    scenario = changed(
        ENCOUNTER, vehicles=(StartConfig(position_m=(0.0, 0.0, -5.0), velocity_m_s=(3.0, 0.0), mission=mission),)
    )
    flock, loop, vehicles = ExactFlock(scenario), ControlLoop(scenario), _Watched(scenario)
    for time_s in (0.0, 0.5, 1.0):
        commands = flock.step(time_s, vehicles.position, vehicles.velocity, own=vehicles.known_velocity)
        loop.fly(time_s, vehicles, commands)
    assert np.array(vehicles.velocities)[:, 0, 0].min() > 2.7


@pytest.mark.parametrize("to_the_right", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_square_is_flown_ten_times_to_either_side(to_the_right: bool) -> None:
    """The heading passes 360 degrees ten times, and every corner is reached."""
    side = 1.0 if to_the_right else -1.0
    corners = [(SIDE_M, 0.0), (SIDE_M, side * SIDE_M), (0.0, side * SIDE_M), (0.0, 0.0)]
    waypoints = tuple(WaypointParameters(north_m=north, east_m=east) for north, east in 10 * corners)
    mission = MissionParameters(kind="waypoints", waypoints=waypoints, speed_m_s=1.5, reached_m=1.5)
    start = StartConfig(position_m=(0.0, 0.0, -5.0), mission=mission)
    scenario = changed(ENCOUNTER, vehicles=(start,))
    flock, loop = ExactFlock(scenario), ControlLoop(scenario)
    vehicles = Vehicles((start,), scenario.vehicle, seed=scenario.seed, sensors=scenario.sensors)
    time_s, headings, arrived = 0.0, [], False
    while not arrived and time_s < 500.0:
        commands = flock.step(time_s, vehicles.position, vehicles.velocity, own=vehicles.known_velocity)
        loop.fly(time_s, vehicles, commands)
        headings.append(float(commands.yaw_rad[0]))
        arrived = commands.missions[0].arrived
        time_s += scenario.drone.step_s
    assert arrived
    assert np.abs(headings).max() <= math.pi + 1e-9
    turned: FloatArray = np.unwrap(np.array(headings))
    assert side * (turned[-1] - turned[0]) / math.tau == pytest.approx(9.75, abs=0.3)
