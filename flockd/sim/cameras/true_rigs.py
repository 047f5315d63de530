"""Rigs as they truly are: a scenario's drones may have their cameras otherwise than their configuration says."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Rig, RigCamera, RigidTransform, build_rig, rotation_from_vector
from flockd.flight.geometry.camera_motion import scaled_focal
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.imperfect_cameras import RigErrorsConfig


def true_rigs(scenario: ScenarioConfig) -> list[Rig]:
    """Of each drone."""
    configured = build_rig(scenario.drone.rig)
    errors = None if scenario.cameras is None else scenario.cameras.rig
    if errors is None:
        return [configured] * len(scenario.vehicles)
    return [_with_errors(configured, errors, (scenario.seed, drone, 6)) for drone in range(len(scenario.vehicles))]


def _with_errors(rig: Rig, errors: RigErrorsConfig, seed: tuple[int, ...]) -> Rig:
    rng = np.random.default_rng(seed)
    cameras = {}
    for name, one in rig.cameras.items():
        turn, way, longer = _direction(rng), _direction(rng), float(rng.choice([-1.0, 1.0]))
        mounted = RigidTransform(
            rotation_from_vector(math.radians(errors.mounting_deg) * turn) @ one.T_body_camera.rotation,
            one.T_body_camera.translation + errors.mounting_m * way,
        )
        cameras[name] = RigCamera(name, scaled_focal(one.camera, math.log1p(errors.focal * longer)), mounted)
    return Rig(cameras)


def _direction(rng: np.random.Generator) -> FloatArray:
    """(3,) unit vector, body axes."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))
