"""What a flight log says of the obstacles: where they stood, and how near each drone came."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.world.obstacle_worlds import obstacles_of
from flockd.sim.world.obstacles import POINTS_A_STEP, Obstacles


def with_obstacles(log: FlightLog, scenario: ScenarioConfig) -> FlightLog:
    """The log of a scenario's flight with its obstacles and clearances; as it was where there are none."""
    obstacles = obstacles_of(scenario)
    if not obstacles.solids:
        return log
    return replace(
        log,
        obstacles=obstacles.outlines(),
        clearance=clearances(obstacles, log.time_s, log.position, log.velocity),
        metadata=log.metadata.model_copy(update={"drone_radius_m": scenario.vehicle.radius_m}),
    )


def clearances(obstacles: Obstacles, times: FloatArray, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """(S, N) m: the smallest clearance from each of the times (S,) to the next, of (S, N, 3) m and m/s NED.

    Between them each drone is taken to fly on the cubic through both states.
    """
    interval = np.diff(times)[:, None, None]
    share = np.arange(POINTS_A_STEP)[:, None, None, None] / POINTS_A_STEP
    a, b = position[:-1], position[1:]
    run, end_run = interval * velocity[:-1], interval * velocity[1:]
    path = (
        (2 * share**3 - 3 * share**2 + 1) * a
        + (share**3 - 2 * share**2 + share) * run
        + (3 * share**2 - 2 * share**3) * b
        + (share**3 - share**2) * end_run
    )
    nearest = np.minimum(obstacles.clearance(path).min(axis=0), obstacles.clearance(b))
    return np.vstack([nearest, obstacles.clearance(position[-1:])])
