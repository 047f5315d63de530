"""Simulates the cameras of all drones: rendered frame sets, and the truth behind each."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from flockd.core.messages import FloatArray, Frame, FrameSet, UInt8Array
from flockd.flight.geometry import Rig, RigCamera, RigidTransform, build_rig, rotation_from_vector
from flockd.flight.mission import Moment, Navigator
from flockd.ground.calibration.camera_motion import scaled_focal
from flockd.sim.cameras.imperfect_cameras import RigErrorsConfig
from flockd.sim.cameras.lens_views import lens_view
from flockd.sim.cameras.real_camera import NOISE_TILE, NoiseTile, Shot, place_in_tile, real_cameras
from flockd.sim.cameras.shutter import CameraMotion
from flockd.sim.renderer.airframe import DroneModel
from flockd.sim.renderer.drone_models import FAMILIES, drone_model
from flockd.sim.renderer.renderer import Renderer, View
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.pose_trail import FlockPose, PoseTrail
from flockd.sim.vehicles.vehicles import REFERENCE_DEG, UNDISTURBED, Disturbances, Vehicles
from flockd.sim.world.obstacle_worlds import obstacles_of
from flockd.sim.world.world import World


def true_rigs(scenario: ScenarioConfig) -> list[Rig]:
    """The rig of each drone as it is really mounted, with the scenario's calibration errors."""
    configured = build_rig(scenario.drone.rig)
    errors = None if scenario.camera_faults is None else scenario.camera_faults.rig
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


def family_of(scenario: ScenarioConfig) -> int:
    """The family, from 0, of the meshes of a flight's drones."""
    wanted = scenario.world.drone_family
    return int(np.random.default_rng([scenario.seed, 1]).integers(FAMILIES)) if wanted == "any" else wanted


class CameraSimulator:
    """The world of a scenario, the models of its drones, and their cameras."""

    def __init__(
        self, scenario: ScenarioConfig, threads: int | None = None, models: Sequence[DroneModel] | None = None
    ) -> None:
        """Draws a drone's images on ``threads``; 0: on the calling one; None: as many as there are processors.

        ``models``: what each drone looks like; None: as `world.drone_family` says.
        """
        self.rig, self._rigs = build_rig(scenario.drone.rig), true_rigs(scenario)
        obstacles = obstacles_of(scenario)
        field, path = scenario.world.obstacles, planned_path(scenario)
        clearance_m = scenario.world.clearance_m + _spread(scenario)
        world = World.generate(
            scenario.seed,
            ground_relief_m=scenario.world.ground_relief_m,
            keep_out=path if field is None else np.concatenate([path, field_grid(field.extent_m)]),
            clearance_m=clearance_m if field is None else max(clearance_m, FIELD_GRID_M),
            obstacles=obstacles if obstacles.solids else None,
            hills_m=scenario.world.hills_m,
            hills_slope=scenario.world.hills_slope,
        )
        rng, self._count = np.random.default_rng([scenario.seed, 1]), len(scenario.vehicles)
        rng.integers(FAMILIES)  # drawn by `family_of`
        models = models or [drone_model(family_of(scenario), int(rng.integers(1 << 31))) for _ in range(self._count)]
        self._world, self._renderer = world, Renderer(world, models)
        by_gain = scenario.camera_faults is not None and scenario.camera_faults.noise.gain > 0
        self._scenario, self._image_noise = scenario, 0.0 if by_gain else scenario.sensors.image_noise
        self.begin_again()
        count = os.cpu_count() if threads is None else threads
        self._map = ThreadPoolExecutor(count, thread_name_prefix="camera").map if count else map

    def begin_again(self) -> None:
        """Resets noise, clocks and poses for another flight in the same world."""
        scenario, self._real = self._scenario, None
        self._noise = ImageNoise(self._image_noise, scenario.seed)
        self._captured, self._began_s = PoseTrail(), math.nan
        if scenario.camera_faults is not None:
            lenses = {name: mounted.camera for name, mounted in self.rig.cameras.items()}
            self._real = real_cameras(scenario.camera_faults, lenses, self._count, scenario.seed)

    def ground_height(self, north: FloatArray, east: FloatArray) -> FloatArray:
        """Heights (n,) m above z = 0 of the drawn ground at points (n,) m north and east."""
        return self._world.height_at(north, east)

    def capture(
        self, drone: int, step: int, time_s: float, vehicles: FlockPose | Vehicles, trail: PoseTrail | None = None,
        disturbed: Disturbances = UNDISTURBED,
    ) -> Callable[[], FrameSet]:  # fmt: skip
        """Draws the images of one drone, from 0, at a step; the result waits for its frame set. Call results in order.

        ``trail``: the flock's poses until now, for late images and for motion; None: the poses of earlier captures,
        between which motion is taken as even. ``disturbed``: cameras that are off and drones that were removed.
        """
        if trail is None:
            trail = self._captured
            trail.add(FlockPose(time_s, vehicles.position, vehicles.R_ned_body))
        others = [i for i in range(self._count) if i != drone and i not in disturbed.removed]
        self._began_s = time_s if math.isnan(self._began_s) else self._began_s
        off = disturbed.cameras_off_of(drone) | self._scenario.lost_cameras(drone, time_s - self._began_s)
        cameras = self._rigs[drone].cameras
        flock: dict[str, FlockPose | Vehicles] = dict.fromkeys(self.rig.cameras, vehicles)
        shots = {name: Shot(time_s, time_s, comes=True) for name in cameras}
        if self._real is not None:
            shots = {name: self._real[drone, name].clock.shot(time_s) for name in cameras}
            flock = {name: trail.at(shot.shown_s) for name, shot in shots.items()}
        turns = {name: self._turn(drone, name, shots[name], flock[name]) for name in cameras}
        places = {
            name: flock[name].position[drone] + flock[name].R_ned_body[drone] @ mounted.T_body_camera.translation
            for name, mounted in cameras.items()
        }
        # Drawn in the cameras' order, so that the images do not depend on their threads.
        noise = {name: self._noise.drawn(camera.camera.size) for name, camera in cameras.items()}

        def sensed_by(name: str) -> UInt8Array:
            def draw(matrix: FloatArray, size: tuple[int, int], R_lens_part: FloatArray) -> View:
                return self._renderer.render(
                    matrix, size, turns[name] @ R_lens_part, places[name],
                    drone_rotations=flock[name].R_ned_body, drone_positions=flock[name].position, shown=others,
                )  # fmt: skip

            seen = lens_view(cameras[name].camera, draw)
            if self._real is None:
                return noise[name](seen.rgb)
            if not self._real[drone, name].changes_views:
                return self._real[drone, name].compressed(noise[name](seen.rgb))
            motion = self._motion(drone, name, shots[name].shown_s, turns[name], trail)
            sun = self._world.light[0] @ turns[name]
            sensed = noise[name](self._real[drone, name].image(seen, motion, sun))
            return self._real[drone, name].compressed(sensed)

        drawn = self._map(sensed_by, cameras)

        def frame_set() -> FrameSet:
            frames = {}
            for name, image in zip(cameras, drawn, strict=True):
                if shots[name].comes and name not in off:
                    frames[name] = Frame(name, image, shots[name].stamp_s, step)
            return FrameSet(time_s, frames)

        return frame_set

    def _turn(self, drone: int, name: str, shot: Shot, flock: FlockPose | Vehicles) -> FloatArray:
        """(3, 3) from a camera's axes to NED, shaken."""
        R_ned_camera: FloatArray = flock.R_ned_body[drone] @ self._rigs[drone].cameras[name].T_body_camera.rotation
        if self._real is None:
            return R_ned_camera
        angles = self._real[drone, name].shaking.at(np.array([shot.shown_s]))[0]
        shaken: FloatArray = R_ned_camera @ rotation_from_vector(angles) if angles.any() else R_ned_camera
        return shaken

    def _motion(
        self, drone: int, name: str, shown_s: float, R_ned_camera: FloatArray, trail: PoseTrail
    ) -> CameraMotion:
        """How a camera moves around the time of its image."""
        assert self._real is not None
        flock, mounted = trail.motion_at(shown_s), self._rigs[drone].cameras[name].T_body_camera
        shaking = self._real[drone, name].shaking
        R_ned_body = trail.at(shown_s).R_ned_body[drone]
        lever = R_ned_body @ np.cross(flock.turn[drone], mounted.translation)
        return CameraMotion(
            velocity=(flock.velocity[drone] + lever) @ R_ned_camera,
            turn=flock.turn[drone] @ mounted.rotation,
            shake=lambda since_s: shaking.at(shown_s + since_s),
            drones={i + 1: flock.velocity[i] @ R_ned_camera for i in range(self._count) if i != drone},
        )


FIELD_GRID_M = 3.0


def field_grid(extent_m: float) -> FloatArray:
    """Points (n, 2) m north and east all over the area of obstacles, for `World.generate`'s ``keep_out``."""
    axis = np.arange(-extent_m, extent_m + FIELD_GRID_M, FIELD_GRID_M)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


class ImageNoise:
    """Normal noise of ``sigma`` grey levels, different in each image."""

    def __init__(self, sigma: float, seed: int) -> None:
        self._rng, self._tile = np.random.default_rng([seed, 2]), None
        if sigma > 0:
            levels = np.rint(sigma * NoiseTile(self._rng).normal).clip(-255, 255)
            self._tile = np.maximum(levels, 0).astype(np.uint8), np.maximum(-levels, 0).astype(np.uint8)

    def drawn(self, size: tuple[int, int]) -> Callable[[UInt8Array], UInt8Array]:
        """Adds the next noise to an image (h, w, 3) of a size (width, height)."""
        if (tile := self._tile) is None:
            return lambda image: image
        within = max(NOISE_TILE[0] - size[1], 1), max(NOISE_TILE[1] - size[0], 1)
        place = place_in_tile(size[::-1], self._rng, within)
        brighter, darker = (one[place] for one in tile)
        return lambda image: np.asarray(cv2.subtract(noisy := cv2.add(image, brighter), darker, dst=noisy), np.uint8)


def planned_path(scenario: ScenarioConfig) -> FloatArray:
    """(n, 2) north and east of the flock's middle if it flies exactly as each of its missions wants, one after the
    other, and on for a few metres."""
    start = np.mean([vehicle.position_m[:2] for vehicle in scenario.vehicles], axis=0)
    missions, path = {vehicle.mission or scenario.drone.mission for vehicle in scenario.vehicles}, []
    for mission in sorted(missions, key=lambda mission: mission.model_dump_json()):
        navigator, flown = Navigator(mission, scenario.drone.safety.gate), np.zeros(2)
        for time_s in np.arange(0.0, scenario.duration_s + 5.0, 0.5):
            moment = Moment(float(time_s), start + flown, home_deg=np.array(REFERENCE_DEG))
            flown = flown + navigator.step(moment).velocity * 0.5
            path.append(start + flown)
    return np.array(path)


def _spread(scenario: ScenarioConfig) -> float:
    """How far from their middle the outermost vehicles start, beyond the four metres of a flock of five."""
    starts = np.array([vehicle.position_m[:2] for vehicle in scenario.vehicles])
    return max(0.0, float(np.linalg.norm(starts - starts.mean(0), axis=1).max()) - 4.0)
