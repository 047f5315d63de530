"""What all cameras saw in one frame set, with one label a drone across the whole rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from flockd.geometry import Rig, RigCamera, ground_inverse_depth, virtual_crop
from flockd.messages import Float32Array, FloatArray, Frame, FrameSet, Sighting, UInt8Array, VehicleState
from flockd.perception import Instance, Picture, RangeEstimate, SceneMaps

UNCLASSED = 255
"""Label of pixels too near a drone's outline to be sure of, and of drones that are not sighted."""
_OUTLINE_PX = 5
_FIRST_MARGIN = 1.3
"""A picture of a drone is this much wider than its box."""
_SURE = 0.5
"""What the second look says is a drone with less than this probability is none."""
_SAME_DRONE = 0.6
"""Two sightings closer than this share of their size are one drone seen by two cameras."""
_BEARING_SIGMA_RAD = 0.004
_MIN_RELATIVE_SIGMA = 0.005
_DEPTH_MAP_RELATIVE_SIGMA = 0.08
"""Of a drone's range where the depth map alone gives it."""
_MAX_DRONE_RADIUS_M = 0.6


class Perceiver(Protocol):
    """The networks' side of the pilot: ``flockd.perception.Perception``, or the simulator's truth in its place."""

    picture_size: int
    map_scale: int

    @property
    def has_distance(self) -> bool:
        """Whether there is a second stage for a drone's range."""
        ...

    def flow(self, camera: str, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 2) pixels from the first image to the second."""
        ...

    def scene(self, camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        """Depth and drones of one image."""
        ...

    def ranges(self, pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each picture."""
        ...


@dataclass(frozen=True, eq=False)
class CameraView:
    """One camera's image and maps, all of the camera's size."""

    image: UInt8Array
    depth: Float32Array
    labels: UInt8Array
    """0 background, k the sighting with label k, 255 not to be used."""


@dataclass(frozen=True, eq=False)
class RigView:
    """All cameras at one time."""

    time_s: float
    vehicle: VehicleState
    cameras: Mapping[str, CameraView]
    sightings: tuple[Sighting, ...]
    reasons: tuple[str, ...]


class Observer:
    """Turns frame sets into rig views."""

    def __init__(self, rig: Rig, perceiver: Perceiver, *, height_fixes_scale: bool) -> None:
        self._rig = rig
        self._perceiver = perceiver
        self._height_fixes_scale = height_fixes_scale
        self._tangents = {name: _ray_tangents(c, perceiver.map_scale) for name, c in rig.cameras.items()}

    def scenes(self, frames: FrameSet, vehicle: VehicleState) -> tuple[dict[str, SceneMaps], list[str]]:
        """The networks' maps of every camera that can be used, and why the others cannot."""
        maps: dict[str, SceneMaps] = {}
        reasons: list[str] = []
        for name, camera in self._rig.cameras.items():
            frame = frames.frames.get(name)
            fault = _fault(frame, camera)
            if frame is None or fault:
                reasons.append(f"camera {name}: {fault}")
                continue
            try:
                maps[name] = self._perceiver.scene(name, frame.image, self._geometry(camera, vehicle))
            except (FloatingPointError, ValueError) as error:  # a network gone astray; a height below the ground
                reasons.append(f"camera {name}: {error}")
        return maps, reasons

    def view(
        self, frames: FrameSet, vehicle: VehicleState, maps: Mapping[str, SceneMaps], reasons: Sequence[str]
    ) -> RigView:
        """Sightings of the whole rig, and the maps relabelled by them."""
        images = {name: frames.frames[name].image for name in maps}
        found = self._locate(images, maps) if maps else []
        sightings, label_of = _merge(found)
        views = {}
        for name, scene in maps.items():
            table = np.full(256, UNCLASSED, np.uint8)
            table[0] = 0
            for instance in scene.instances:
                table[instance.label] = label_of.get((name, instance.label), UNCLASSED)
            labels = table[scene.labels]
            depth = self._drone_depth(scene.depth, labels, self._rig.cameras[name], sightings)
            views[name] = CameraView(images[name], depth, _without_outline(labels))
        return RigView(frames.time_s, vehicle, views, sightings, tuple(reasons))

    def _geometry(self, camera: RigCamera, vehicle: VehicleState) -> Float32Array:
        tangents = self._tangents[camera.name]
        ground = np.zeros(tangents.shape[1:], np.float32)
        if self._height_fixes_scale:
            stride = self._perceiver.map_scale
            ground = ground_inverse_depth(camera, vehicle.R_ned_body, vehicle.height_m, stride=stride)
        return np.concatenate([tangents, ground[None]])

    def _locate(self, images: Mapping[str, UInt8Array], maps: Mapping[str, SceneMaps]) -> list[_Located]:
        live = Rig({name: self._rig.cameras[name] for name in maps})
        candidates = [
            _Candidate(name, instance, *_aim(self._rig.cameras[name], instance))
            for name, scene in maps.items()
            for instance in scene.instances
        ]
        if not self._perceiver.has_distance:
            located = [self._locate_by_depth(c, maps[c.camera]) for c in candidates]
            return [one for one in located if one is not None]
        first = self._ranges(live, images, [(c.direction, c.half_angle, None) for c in candidates])
        again = [
            (_in_view(live, position, c), c.half_angle, range_m)
            for c, (position, range_m, _) in zip(candidates, first, strict=True)
        ]
        second = self._ranges(live, images, again)  # now in the middle, and whole where two cameras share it
        return [
            _Located(c, position, max(estimate.relative_sigma, _MIN_RELATIVE_SIGMA) * range_m, _size(c, range_m))
            for c, (position, range_m, estimate) in zip(candidates, second, strict=True)
            if estimate.is_drone > _SURE and 0.2 < range_m < 60.0
        ]

    def _ranges(
        self, live: Rig, images: Mapping[str, UInt8Array], aims: Sequence[tuple[FloatArray, float, float | None]]
    ) -> list[tuple[FloatArray, float, RangeEstimate]]:
        """For each (direction, half angle, range if known): position in the body, distance from it, all estimated."""
        crops = [virtual_crop(live, direction, angle, self._perceiver.picture_size) for direction, angle, _ in aims]
        pictures = [
            Picture(
                image=crop.sample(images, range_m=range_m)[0],
                focal_px=crop.camera.focal_px,
                R_body_camera=crop.T_body_virtual.rotation,
                position=crop.T_body_virtual.translation,
            )
            for crop, (_, _, range_m) in zip(crops, aims, strict=True)
        ]
        out = []
        for crop, estimate in zip(crops, self._perceiver.ranges(pictures), strict=True):
            ray = crop.camera.rays(estimate.centre[None])[0]
            position = crop.T_body_virtual.apply(estimate.range_m * ray[None])[0]
            out.append((position, float(np.linalg.norm(position)), estimate))
        return out

    def _locate_by_depth(self, candidate: _Candidate, scene: SceneMaps) -> _Located | None:
        """Eq. 37 on the depth map alone: the centre of the bounding box of the drone's points."""
        rig_camera = self._rig.cameras[candidate.camera]
        rows, columns = np.nonzero(scene.labels == candidate.instance.label)
        pixels = np.asarray(np.stack([columns, rows], 1) + 0.5, np.float64)
        points = rig_camera.camera.unproject(pixels, np.asarray(scene.depth[rows, columns], np.float64))
        distance = np.linalg.norm(points, axis=1)
        kept = np.abs(distance - np.median(distance)) < _MAX_DRONE_RADIUS_M
        if not kept.any():
            return None
        centre = (points[kept].min(0) + points[kept].max(0)) / 2
        position = rig_camera.T_body_camera.apply(centre[None])[0]
        range_m = float(np.linalg.norm(position))
        return _Located(candidate, position, _DEPTH_MAP_RELATIVE_SIGMA * range_m, _size(candidate, range_m))

    @staticmethod
    def _drone_depth(
        depth: Float32Array, labels: UInt8Array, camera: RigCamera, sightings: Sequence[Sighting]
    ) -> Float32Array:
        """The depth map with each drone's pixels moved to its sighting's range; their relief is kept."""
        moved = depth.copy()
        for sighting in sightings:
            if camera.name not in sighting.cameras:
                continue
            mine = labels == sighting.label
            z = float(camera.T_body_camera.inverse().apply(sighting.position[None])[0, 2])
            if z <= 0 or not mine.any():
                continue
            relief = depth[mine] - np.median(depth[mine])
            moved[mine] = z + np.clip(relief, -sighting.size_m / 2, sighting.size_m / 2)
        return moved


@dataclass(frozen=True, eq=False)
class _Candidate:
    camera: str
    instance: Instance
    direction: FloatArray
    half_angle: float
    angular_size: float


@dataclass(frozen=True, eq=False)
class _Located:
    candidate: _Candidate
    position: FloatArray
    range_sigma_m: float
    size_m: float


def _fault(frame: Frame | None, camera: RigCamera) -> str | None:
    if frame is None:
        return "no frame"
    width, height = camera.camera.size
    if frame.image.shape != (height, width, 3):
        return f"its image is {frame.image.shape[1]}x{frame.image.shape[0]} and not {width}x{height}"
    return None


def _aim(camera: RigCamera, instance: Instance) -> tuple[FloatArray, float, float]:
    """Direction of a drone in the body, half the angle of its first picture, and its angular size."""
    left, top, right, bottom = instance.box
    corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom], instance.centre])
    rays = camera.camera.rays(corners)
    inside = camera.camera.in_image(instance.centre[None])[0] and np.isfinite(rays[4]).all()
    centre = rays[4] if inside else rays[:4].mean(0) / np.linalg.norm(rays[:4].mean(0))
    reach = float(np.arccos(np.clip(rays[:4] @ centre, -1, 1)).max())
    wide = float(np.arccos(np.clip(rays[0] @ rays[1], -1, 1)))
    half_angle = float(np.clip(_FIRST_MARGIN * reach, np.radians(1.0), np.radians(35.0)))
    return camera.T_body_camera.rotation @ centre, half_angle, max(wide, 1e-3)


def _in_view(live: Rig, position: FloatArray, candidate: _Candidate) -> FloatArray:
    """The direction to a position, or the candidate's own where no camera looks that way."""
    direction = position / np.linalg.norm(position)
    return direction if live.covers(direction[None])[0] else candidate.direction


def _size(candidate: _Candidate, range_m: float) -> float:
    return range_m * candidate.angular_size


def _merge(found: Sequence[_Located]) -> tuple[tuple[Sighting, ...], dict[tuple[str, int], int]]:
    """One sighting a drone: what two cameras place at the same spot is one. Also (camera, instance) -> label."""
    groups: list[list[_Located]] = []
    for one in sorted(found, key=lambda item: -item.candidate.instance.area_px):
        for group in groups:
            size = max(group[0].size_m, one.size_m)
            if np.linalg.norm(group[0].position - one.position) < max(_SAME_DRONE * size, 0.25):
                group.append(one)
                break
        else:
            groups.append([one])
    sightings, label_of = [], {}
    for label, group in enumerate(groups[: UNCLASSED - 1], start=1):
        weights = np.array([one.range_sigma_m**-2 for one in group])
        position = (weights[:, None] * np.array([one.position for one in group])).sum(0) / weights.sum()
        cameras = tuple(dict.fromkeys(one.candidate.camera for one in group))
        sightings.append(
            Sighting(
                position=position,
                range_sigma_m=min(one.range_sigma_m for one in group),  # errors of two pictures of one drone are alike
                bearing_sigma_rad=_BEARING_SIGMA_RAD,
                size_m=max(one.size_m for one in group),
                cameras=cameras,
                label=label,
            )
        )
        for one in group:
            label_of[(one.candidate.camera, one.candidate.instance.label)] = label
    return tuple(sightings), label_of


def _without_outline(labels: UInt8Array) -> UInt8Array:
    """Background next to a drone becomes unclassed: masks and depth maps are least sure there."""
    drone = (labels > 0).astype(np.uint8)
    if not drone.any():
        return labels
    wide = cv2.dilate(drone, np.ones((2 * _OUTLINE_PX + 1, 2 * _OUTLINE_PX + 1), np.uint8))
    return np.where((wide > 0) & (labels == 0), np.uint8(UNCLASSED), labels)


def _ray_tangents(camera: RigCamera, stride: int) -> Float32Array:
    """(2, h/stride, w/stride) tangents of the block centres' rays, right and down of the optical axis."""
    width, height = camera.camera.size
    u, v = np.meshgrid(np.arange(stride / 2, width, stride), np.arange(stride / 2, height, stride))
    rays = camera.camera.rays(np.stack([u.ravel(), v.ravel()], 1))
    tangents = rays[:, :2] / np.maximum(rays[:, 2:], 0.1)
    return np.ascontiguousarray(tangents.T.reshape(2, *u.shape), dtype=np.float32)
