"""The attitude that a drone hears from its autopilot: a little old, and noisy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flockd.core.messages import VehicleState
from flockd.flight.geometry import rotation_from_vector
from flockd.sim.cameras.pose_trail import PoseTrail
from flockd.sim.scenario.imperfect_cameras import LateAttitudeConfig


class LateAttitude:
    """Of one drone, counted from 0."""

    def __init__(self, config: LateAttitudeConfig, seed: int, drone: int) -> None:
        self._config, self._drone = config, drone
        self._rng = np.random.default_rng([seed, drone, 5])

    def heard(self, state: VehicleState, trail: PoseTrail) -> VehicleState:
        """The state, whose attitude errs already as the autopilot does, with the attitude of before."""
        now, then = trail.at(state.time_s), trail.at(state.time_s - self._config.late_s)
        noise = rotation_from_vector(math.radians(self._config.noise_deg) * self._rng.standard_normal(3))
        turned = now.R_ned_body[self._drone].T @ then.R_ned_body[self._drone]
        return replace(state, R_ned_body=state.R_ned_body @ turned @ noise)
