"""How long the obstacles' part of a step takes on one core: ranges from four depth maps, local map, avoidance.

    OMP_NUM_THREADS=1 python -m tools.measure.bench_obstacles

The scene is a trunk every 3 m on ground that is flat, seen by the simulator's rig, with a flow of noise, which costs as
much as a true one; CPU time of this process.
"""

from __future__ import annotations

import time

import numpy as np

from flockd.core.config import load_scenario
from flockd.core.data import data_path
from flockd.core.messages import EgoMotion, VehicleState
from flockd.flight.flocking import FlockingLaw
from flockd.flight.geometry import RigCamera, build_rig, grid_pixels
from flockd.flight.obstacles import Avoidance, LocalMap, ObstacleRanging
from flockd.flight.perception import CameraObservation, Observation

STEPS = 100
HEIGHT_M = 4.0
TRUNK_M = 0.2
EGO = EgoMotion(np.eye(3), np.array([0.75, 0.0, 0.0]), 0.5, 100, 100, 0.01)


def main() -> None:
    """Prints milliseconds a step."""
    drone = load_scenario(data_path("config") / "square.yaml").drone
    rig = build_rig(drone.rig)
    ranging, local_map = ObstacleRanging(rig, drone.obstacles), LocalMap(drone.obstacles)
    avoidance, law = Avoidance(drone.obstacles, drone.safety.gate, drone.step_s), FlockingLaw(drone.flocking)
    cameras = {name: _camera(camera) for name, camera in rig.cameras.items()}
    neighbours = np.array([[3.0, 0.0, 0.5], [0.0, 3.0, 0.0], [-3.0, 1.0, 0.0], [0.5, -3.0, -0.5]])
    velocities, own = np.full((4, 2), [1.0, 0.0]), np.array([1.0, 0.1])
    taken_s = np.zeros(3)
    for step in range(STEPS):
        time_s = 0.5 * step
        vehicle = VehicleState(time_s, np.eye(3), HEIGHT_M)
        before = Observation(time_s - drone.step_s, vehicle, cameras, (), None)
        observation = Observation(time_s, vehicle, cameras, (), before)
        laps = [time.process_time()]
        ranges = ranging.ranges(observation, EGO)
        laps.append(time.process_time())
        view = local_map.step(time_s, ranges, np.array([0.3, 0.0]), 0.02)
        laps.append(time.process_time())
        avoidance.command(law, own, neighbours, velocities, np.array([1.5, 0.0]), view)
        laps.append(time.process_time())
        taken_s += np.diff(laps)
    for name, value in zip(("ranges", "map", "avoidance"), 1e3 * taken_s / STEPS, strict=True):
        print(f"{name}: {value:.2f} ms")
    print(f"all: {1e3 * taken_s.sum() / STEPS:.2f} ms a step, bar 10 ms")


def _camera(camera: RigCamera) -> CameraObservation:
    """A depth map of trunks on a grid, the nearest of each direction."""
    width, height = camera.camera.size
    pixels = grid_pixels((width, height), 1)
    rays = camera.camera.unproject(pixels, np.ones(len(pixels))) @ camera.T_body_camera.rotation.T
    depth = np.where(rays[:, 2] > 0, HEIGHT_M / np.maximum(rays[:, 2], 1e-9), 80.0)
    level = np.hypot(rays[:, 0], rays[:, 1])
    for place in np.mgrid[-12:13:3, -12:13:3].reshape(2, -1).T + 1.5:
        ahead = (rays[:, :2] @ place) / level
        aside = np.abs(rays[:, 0] * place[1] - rays[:, 1] * place[0]) / level
        depth = np.where((aside < TRUNK_M) & (ahead > 0), np.minimum(depth, ahead / level), depth)
    shape = (height, width)
    return CameraObservation(
        np.zeros((*shape, 3), np.uint8),
        depth.reshape(shape).astype(np.float32),
        np.zeros(shape, np.uint8),
        flow=np.random.default_rng(1).normal(0.0, 10.0, (*shape, 2)).astype(np.float32),
    )


if __name__ == "__main__":
    main()
