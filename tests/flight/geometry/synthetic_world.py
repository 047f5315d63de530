"""A world of a ground plane and boxes, cast analytically, as four cameras of a moving drone see it twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.core.messages import BoolArray, FloatArray, IntArray
from flockd.flight.geometry import (
    PinholeCamera,
    PointPairs,
    Rig,
    RigCamera,
    RigidTransform,
    grid_pixels,
    rotation_from_euler,
)

R_FRD_RDF = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def four_camera_rig(size: tuple[int, int] = (480, 640), focal: float = 222.0, lever_m: float = 0.1) -> Rig:
    matrix = np.array([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
    cameras = {}
    for name, yaw in (("front", 0.0), ("right", np.pi / 2), ("back", np.pi), ("left", -np.pi / 2)):
        turn = rotation_from_euler(0.0, 0.0, yaw)
        mount = RigidTransform(turn @ R_FRD_RDF, turn @ np.array([lever_m, 0.0, 0.0]))
        cameras[name] = RigCamera(name, PinholeCamera(matrix, size), mount)
    return Rig(cameras)


@dataclass(frozen=True)
class World:
    """Axis-aligned boxes (m, 2, 3) as low and high corners in NED, on ground at down = 0."""

    boxes: FloatArray

    def cast(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """Distance in lengths of each direction, infinite for the sky, and what was hit: -1 ground, else the box."""
        with np.errstate(divide="ignore", invalid="ignore"):
            nearest = np.where(directions[:, 2] > 0.0, -origins[:, 2] / directions[:, 2], np.inf)
            hit = np.full(len(nearest), -1)
            for index, (low, high) in enumerate(self.boxes):
                one, other = (low - origins) / directions, (high - origins) / directions
                enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
                closer = (enter > 0.0) & (enter < leave) & (enter < nearest)
                nearest, hit = np.where(closer, enter, nearest), np.where(closer, index, hit)
        return nearest, hit


def boxes_around(random: np.random.Generator, count: int = 12) -> World:
    bearing = random.uniform(0.0, 2.0 * np.pi, count)
    distance = random.uniform(5.0, 20.0, count)
    half = random.uniform(0.5, 2.0, (count, 2))
    centre = np.stack([np.cos(bearing), np.sin(bearing)], axis=1) * distance[:, None]
    low = np.concatenate([centre - half, -random.uniform(1.0, 6.0, (count, 1))], axis=1)
    high = np.concatenate([centre + half, np.zeros((count, 1))], axis=1)
    return World(np.stack([low, high], axis=1))


@dataclass(frozen=True)
class Flaws:
    """What separates the maps from the truth."""

    flow_sigma_px: float = 0.3
    depth_sigma: float = 0.02
    object_bias: float = 0.03
    outliers: float = 0.05


EXACT = Flaws(0.0, 0.0, 0.0, 0.0)


def seen_twice(
    world: World,
    rig: Rig,
    T_ned_body: tuple[RigidTransform, RigidTransform],
    flaws: Flaws,
    random: np.random.Generator,
    *,
    stride: int = 12,
    max_depth_m: float = 40.0,
) -> PointPairs:
    """The background pairs of a drone whose body was at the first pose and then at the second."""
    bias = np.append(random.normal(1.0, flaws.object_bias, len(world.boxes)), 1.0)  # the last is the ground's: exact
    several = []
    for camera in rig.cameras.values():
        before, after = (pose @ camera.T_body_camera for pose in T_ned_body)
        pixels = grid_pixels(camera.camera.size, stride)
        depth, hit = _depth_at(world, camera, before, pixels)
        with np.errstate(invalid="ignore"):
            points = before.apply(camera.camera.unproject(pixels, depth))
            pixels_after = camera.camera.project(after.inverse().apply(points))
        pixels_after = pixels_after + random.normal(0.0, flaws.flow_sigma_px, pixels.shape)
        seen = (depth < max_depth_m) & camera.camera.in_image(pixels_after)
        pixels, pixels_after, depth, hit = pixels[seen], pixels_after[seen], depth[seen], hit[seen]
        depth_after, hit_after = _depth_at(world, camera, after, pixels_after)
        depth = depth * bias[hit] * random.normal(1.0, flaws.depth_sigma, len(depth))
        depth_after = depth_after * bias[hit_after] * random.normal(1.0, flaws.depth_sigma, len(depth))
        wrong = random.random(len(depth)) < flaws.outliers
        pixels_after = np.where(wrong[:, None], pixels_after + random.uniform(-40, 40, pixels.shape), pixels_after)
        depth_after = np.where(wrong, depth_after * random.uniform(0.5, 2.0, len(depth)), depth_after)
        seen = (depth_after < max_depth_m) & camera.camera.in_image(pixels_after)
        several.append(_lifted(camera, pixels, depth, pixels_after, depth_after, seen))
    return PointPairs.concatenate(several)


def _depth_at(
    world: World, camera: RigCamera, T_ned_camera: RigidTransform, pixels: FloatArray
) -> tuple[FloatArray, IntArray]:
    directions = camera.camera.unproject(pixels, np.ones(len(pixels))) @ T_ned_camera.rotation.T
    return world.cast(np.broadcast_to(T_ned_camera.translation, directions.shape), directions)


def _lifted(
    camera: RigCamera,
    pixels: FloatArray,
    depth: FloatArray,
    pixels_after: FloatArray,
    depth_after: FloatArray,
    kept: BoolArray,
) -> PointPairs:
    return PointPairs(
        previous=camera.T_body_camera.apply(camera.camera.unproject(pixels[kept], depth[kept])),
        current=camera.T_body_camera.apply(camera.camera.unproject(pixels_after[kept], depth_after[kept])),
        camera_names=np.full(int(kept.sum()), camera.name),
        pixels_previous=pixels[kept],
        pixels_current=pixels_after[kept],
    )
