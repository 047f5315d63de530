"""The companion of a flight by sight: the same scenario with exact relative states, without rendering."""

from __future__ import annotations

import numpy as np

from flockd.config.scenario import ScenarioConfig
from flockd.flocking import FlockingLaw, course, desired_velocity
from flockd.messages import FloatArray
from flockd.sim.vehicles import Vehicles


def fly_exact_states(scenario: ScenarioConfig) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (S,) s, positions (S, N, 3) m and velocities (S, N, 3) m/s in NED, as each step begins.

    The paper's "UAV flocking based on ground truth cluster state": each vehicle gets what the flocking law commands on
    the true positions and velocities of all.
    """
    times = step_times(scenario)
    drone = scenario.drone
    law = FlockingLaw(drone.flocking)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=course(drone.desired, 0.0), seed=scenario.seed)
    positions, velocities = [], []
    for time_s in times:
        positions.append(vehicles.position)
        velocities.append(vehicles.velocity)
        here, moving = vehicles.position[:, :2], vehicles.velocity[:, :2]
        desired = desired_velocity(drone.desired, float(time_s))
        setpoints = [
            law.command(
                moving[i], np.delete(here, i, axis=0) - here[i], np.delete(moving, i, axis=0), desired, drone.step_s
            )[0]
            for i in range(len(here))
        ]
        yaw_rad = course(drone.desired, float(time_s))
        vehicles.step(np.array(setpoints), np.full(len(here), yaw_rad), drone.step_s)
    return times, np.array(positions), np.array(velocities)


def exact_states_at(times: FloatArray, scenario: ScenarioConfig) -> tuple[FloatArray, FloatArray]:
    """Positions (S, N, 3) m and velocities (S, N, 3) m/s of `fly_exact_states`, interpolated at ``times`` (S,) s."""
    steps_s, position, velocity = fly_exact_states(scenario)
    flat = [values.reshape(len(steps_s), -1) for values in (position, velocity)]
    at = [np.stack([np.interp(times, steps_s, column) for column in values.T], axis=1) for values in flat]
    shape = (len(times), *position.shape[1:])
    return at[0].reshape(shape), at[1].reshape(shape)


def step_times(scenario: ScenarioConfig) -> FloatArray:
    """When the steps of a flight begin, (S,) s: 0, step, ... up to but without its end."""
    step_s = scenario.drone.step_s
    return np.arange(round(scenario.duration_s / step_s), dtype=float) * step_s
