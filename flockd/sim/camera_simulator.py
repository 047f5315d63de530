"""Simulates the cameras of all drones: rendered frame sets, and the truth behind each."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from flockd.config.scenario import ScenarioConfig
from flockd.errors import UsageError
from flockd.flocking import desired_velocity
from flockd.geometry import PinholeCamera, build_rig
from flockd.messages import FloatArray, Frame, FrameSet, UInt8Array
from flockd.sim.camera_faults import CameraFaults
from flockd.sim.drone_models import FAMILIES, drone_model
from flockd.sim.renderer import Renderer
from flockd.sim.truth_perception import RenderTruth
from flockd.sim.world import World


class FlockPoses(Protocol):
    """Poses of all drones."""

    @property
    def position(self) -> FloatArray:
        """(n, 3) metres NED."""

    @property
    def R_ned_body(self) -> FloatArray:  # noqa: N802 - the field's own notation
        """(n, 3, 3)"""


class CameraSimulator:
    """The world of a scenario, the models of its drones, and their cameras."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        """Raises UsageError for a camera model that cannot be rendered."""
        self.rig = build_rig(scenario.drone.rig)
        for name, mounted in self.rig.cameras.items():
            if not isinstance(mounted.camera, PinholeCamera) or any(mounted.camera.distortion):
                raise UsageError(
                    f"drone.rig: camera {name!r}: the renderer supports only pinhole cameras without distortion; "
                    "change its intrinsics for simulated flights"
                )
        world = World.generate(
            scenario.seed,
            ground_relief_m=scenario.world.ground_relief_m,
            keep_out=planned_path(scenario),
            clearance_m=scenario.world.clearance_m + _spread(scenario),
        )
        rng = np.random.default_rng([scenario.seed, 1])
        drawn, wanted = int(rng.integers(FAMILIES)), scenario.world.drone_family
        family = drawn if wanted == "any" else wanted
        self._count = len(scenario.vehicles)
        models = [drone_model(family, int(rng.integers(1 << 31))) for _ in range(self._count)]
        self._renderer = Renderer(world, models)
        self._noise = _ImageNoise(scenario.sensors.image_noise, scenario.seed)
        self._faults = CameraFaults(scenario.faults, scenario.seed)

    def capture(self, drone: int, step: int, time_s: float, vehicles: FlockPoses) -> tuple[FrameSet, RenderTruth]:
        """The frame set of one drone, and the truth behind it."""
        others = [i for i in range(self._count) if i != drone]
        R_ned_body, position = vehicles.R_ned_body[drone], vehicles.position[drone]
        views, turns, places, frames = {}, {}, {}, {}
        for name, mounted in self.rig.cameras.items():
            turns[name] = R_ned_body @ mounted.T_body_camera.rotation
            places[name] = position + R_ned_body @ mounted.T_body_camera.translation
            views[name] = self._renderer.render(
                mounted.camera.matrix, mounted.camera.size, turns[name], places[name],
                drone_rotations=vehicles.R_ned_body, drone_positions=vehicles.position, shown=others,
            )  # fmt: skip
            image = self._faults.applied(drone, name, time_s, self._noise.add(views[name].rgb))
            frames[name] = Frame(name, image, time_s, step)
        truth = RenderTruth(views, turns, places, R_ned_body, position, vehicles.R_ned_body, vehicles.position, others)
        return FrameSet(time_s, frames), truth


class _ImageNoise:
    """Noise that differs from image to image: a seeded crop of one large tile of normal noise."""

    def __init__(self, sigma: float, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 2])
        self._tile = sigma * self._rng.standard_normal((1031, 1033, 3), dtype=np.float32) if sigma > 0 else None

    def add(self, image: UInt8Array) -> UInt8Array:
        if self._tile is None:
            return image
        height, width = image.shape[:2]
        top = int(self._rng.integers(self._tile.shape[0] - height))
        left = int(self._rng.integers(self._tile.shape[1] - width))
        noise = self._tile[top : top + height, left : left + width]
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)


def planned_path(scenario: ScenarioConfig) -> FloatArray:
    """(n, 2) north and east of the flock's middle if it flies exactly as desired, and on for a few metres."""
    times = np.arange(0.0, scenario.duration_s + 5.0, 0.5)
    steps = np.array([desired_velocity(scenario.drone.desired, float(t)) * 0.5 for t in times])
    start = np.mean([vehicle.position_m[:2] for vehicle in scenario.vehicles], axis=0)
    return np.asarray(start + np.cumsum(steps, axis=0))


def _spread(scenario: ScenarioConfig) -> float:
    """How far from their middle the outermost vehicles start, beyond the four metres of a flock of five."""
    starts = np.array([vehicle.position_m[:2] for vehicle in scenario.vehicles])
    return max(0.0, float(np.linalg.norm(starts - starts.mean(0), axis=1).max()) - 4.0)
