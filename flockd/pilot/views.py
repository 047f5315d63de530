"""What all cameras saw in one frame set, with one label a drone across the whole rig."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np

from flockd.geometry import Rig, RigCamera, ground_inverse_depth, log_polar, log_polar_covariance, virtual_crop
from flockd.messages import (
    UNCLASSED,
    BoolArray,
    Detection,
    Float32Array,
    FloatArray,
    Frame,
    FrameSet,
    UInt8Array,
    VehicleState,
)
from flockd.perception import Instance, Picture, RangeEstimate, SceneMaps
from flockd.perception.depth import fix_by_height
from flockd.pilot.outlines import Mask, Outliner, Outlines
from flockd.tracking import ExpectedNeighbour

_OUTLINE_PX = 5
_FIRST_MARGIN = 0.95
"""Half the first picture of a drone is so wide, of the way from its centre to its box's farthest corner."""
_CUT_PX, _CUT_MARGIN = 2, 1.4
"""So wide is it where the box comes so near to the image's border: the drone is larger than what is seen of it."""
_SURE = 0.8
"""What the second look says is a drone with less than this probability is none."""
_MARGIN = 0.68
"""Half of a picture of a drone of known size is this many times its size wide."""
_MAX_RESIZE = 1.7
"""A further picture's angle is at most this many times the last one's, and at least as much smaller."""
_MOST_LOOKS = 4
_MIRROR_WIDTH = 0.9
"""The last picture is in a mirror, which the network errs on differently, and so wide, of what suits the drone."""
_MEAN_SIGMA = 0.98
"""The error of the mean of both, as a share of what a single picture's would be."""
_WORTH_ANOTHER_LOOK = 0.2
_SAME_AIM, _SAME_SIZE = 0.03, 1.05
"""Two pictures show the same if one is moved by less than this share of half its width, and resized by less than this.
"""
_REST_OFF_PX, _REST_PX, _MOST_RESTS = 4, 24, 6
"""What the first stage takes for a part of a drone and the second does not: so far from it, so many pixels, and of a
camera at most so many, the largest: an image full of ghosts must not cost the deadline."""
_SURE_OF_EXPECTED = 0.7
_EXPECTED_GATE = 0.2
"""What is found where a drone was expected must be as near to that place as this share of its range, or 0.5 m."""
_SAME_DRONE = 0.6
"""Two detections closer than this share of their size are one drone seen by two cameras."""
_SAME_BEARING, _SAME_RANGE = 0.4, 1.5
"""Or in directions closer than this share of their angular size, with ranges that differ by less than this factor."""
_HIDES = 0.25
"""Nothing is seen of what lies behind a drone within this share of its angular size from its middle."""
_BEARING_SIGMA_RAD = 0.004
_MIN_RELATIVE_SIGMA = 0.005
_DEPTH_MAP_RELATIVE_SIGMA = 0.08
"""Of a drone's range where the depth map alone gives it."""
_MAX_DRONE_RADIUS_M = 0.6
_NEAREST_M, _FARTHEST_M = 0.2, 60.0
_HALF_ANGLES = (np.radians(1.0), np.radians(35.0))
"""Of the second stage's pictures."""


class Perceiver(Protocol):
    """The networks' side of the pilot: ``flockd.perception.Perception``, or the simulator's truth in its place."""

    picture_size: int
    map_scale: int

    @property
    def has_distance(self) -> bool:
        """Whether there is a second stage for a drone's range."""
        ...

    def flow(self, camera: str, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
        """(h, w, 2) pixels from the first image to the second; ``labels`` (h, w) say which of the first are drones."""
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
    """0 background, k the detection with label k, 255 not to be used."""


@dataclass(frozen=True, eq=False)
class RigView:
    """All cameras at one time."""

    time_s: float
    vehicle: VehicleState
    cameras: Mapping[str, CameraView]
    detections: tuple[Detection, ...]
    reasons: tuple[str, ...]


class Observer:
    """Turns frame sets into rig views."""

    def __init__(self, rig: Rig, perceiver: Perceiver, *, height_fixes_scale: bool) -> None:
        self._rig = rig
        self._perceiver = perceiver
        self._height_fixes_scale = height_fixes_scale
        self._tangents = {name: _ray_tangents(c, perceiver.map_scale) for name, c in rig.cameras.items()}
        self._outliners = {name: Outliner(c, perceiver.map_scale) for name, c in rig.cameras.items()}

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
                geometry = self._geometry(camera, vehicle)
                scene = self._perceiver.scene(name, frame.image, geometry)
                maps[name] = fix_by_height(scene, geometry[2]) if self._height_fixes_scale else scene
            except (FloatingPointError, ValueError) as error:  # a network gone astray; a height below the ground
                reasons.append(f"camera {name}: {error}")
        return maps, reasons

    def view(
        self,
        frames: FrameSet,
        vehicle: VehicleState,
        maps: Mapping[str, SceneMaps],
        reasons: Sequence[str],
        expected: Sequence[ExpectedNeighbour] = (),
    ) -> RigView:
        """Detections of the whole rig, and the maps relabelled by them.

        Where a drone is ``expected`` but not segmented, the second stage looks once more.
        """
        images = {name: frames.frames[name].image for name in maps}
        found, refused = self._locate(images, maps) if maps else ([], set())
        looks = bool(maps) and self._perceiver.has_distance
        if looks:
            found += self._look_again(images, vehicle, found, expected)
        merged = _merge(_without_hidden(found))
        outlines = self._outlines(maps, merged, refused)
        rest = self._look_at_the_rest(images, maps, outlines) if looks else []
        if rest:
            merged = _merge(_without_hidden(found + rest))
            outlines = self._outlines(maps, merged, refused)
        views = {}
        for name, scene in maps.items():
            drawn = outlines[name].by_colours(images[name])
            depth = self._drone_depth(scene.depth, drawn, self._rig.cameras[name], merged.detections)
            views[name] = CameraView(images[name], depth, _without_outline(drawn))
        return RigView(frames.time_s, vehicle, views, merged.detections, tuple(reasons))

    def _outlines(
        self, maps: Mapping[str, SceneMaps], merged: _Merged, refused: Container[Instance]
    ) -> dict[str, Outlines]:
        """Of each camera."""
        outlines = {}
        for name, scene in maps.items():
            table = np.full(256, UNCLASSED, np.uint8)
            table[0] = 0
            for instance in scene.instances:
                otherwise = 0 if instance in refused else UNCLASSED
                table[instance.label] = merged.label_of.get((name, instance.label), otherwise)
            labels = table[scene.labels]
            if scene.unsure is not None:
                labels[scene.unsure & (labels > 0)] = UNCLASSED
            outlines[name] = Outlines(labels)
            if scene.logit is not None:
                outliner = self._outliners[name]
                outlines[name] = outliner.outlines(labels, scene.logit, merged.detections, merged.masks_of)
        return outlines

    def _geometry(self, camera: RigCamera, vehicle: VehicleState) -> Float32Array:
        tangents = self._tangents[camera.name]
        ground = np.zeros(tangents.shape[1:], np.float32)
        if self._height_fixes_scale:
            stride = self._perceiver.map_scale
            ground = ground_inverse_depth(camera, vehicle.R_ned_body, vehicle.height_m, stride=stride)
        return np.concatenate([tangents, ground[None]])

    def _locate(
        self, images: Mapping[str, UInt8Array], maps: Mapping[str, SceneMaps]
    ) -> tuple[list[_Located], set[Instance]]:
        """The drones among the instances, and which of them are surely none."""
        live = Rig({name: self._rig.cameras[name] for name in maps})
        candidates = [
            _Candidate((name,), *_aim(self._rig.cameras[name], instance), instance)
            for name, scene in maps.items()
            for instance in scene.instances
        ]
        if not self._perceiver.has_distance:
            located = [self._locate_by_depth(c, maps[c.cameras[0]]) for c in candidates]
            return [one for one in located if one is not None], set()
        found, refused = self._look(live, images, candidates)
        return [one for one in found if one.is_drone > _SURE], {one.instance for one in refused if one.instance}

    def _look_again(
        self,
        images: Mapping[str, UInt8Array],
        vehicle: VehicleState,
        found: Sequence[_Located],
        expected: Sequence[ExpectedNeighbour],
    ) -> list[_Located]:
        """What the second stage finds where a drone is expected and none was segmented."""
        live = Rig({name: self._rig.cameras[name] for name in images})
        candidates = []
        for one in expected:
            place = vehicle.R_ned_body.T @ one.position
            range_m = float(np.linalg.norm(place))
            direction = place / range_m
            half_angle = _half_angle(one.size_m, range_m)
            cameras = tuple(name for name, pixel in live.pixels_of(place[None]).items() if np.isfinite(pixel).all())
            if not cameras or any(_angle(direction, f.position) < half_angle for f in found):
                continue
            candidates.append(_Candidate(cameras, direction, half_angle, expected=place))
        located, _ = self._look(live, images, candidates)
        return [one for one in located if one.is_drone > _SURE_OF_EXPECTED and _is_as_expected(one)]

    def _look_at_the_rest(
        self, images: Mapping[str, UInt8Array], maps: Mapping[str, SceneMaps], outlines: Mapping[str, Outlines]
    ) -> list[_Located]:
        """What is found where the first stage is sure of a drone and the second does not know of one.

        A drone that another hides in part, or passes close by, is often taken for a part of it. By colours it would be
        even oftener.
        """
        live = Rig({name: self._rig.cameras[name] for name in images})
        candidates = []
        for name, scene in maps.items():
            if scene.unsure is None:
                continue
            known = outlines[name].by_networks()
            rest = (known == UNCLASSED) & (scene.labels > 0) & ~scene.unsure
            if rest.any():
                drawn = ((known > 0) & (known != UNCLASSED)).astype(np.uint8)
                rest &= cv2.dilate(drawn, np.ones((2 * _REST_OFF_PX + 1, 2 * _REST_OFF_PX + 1), np.uint8)) == 0
                candidates += [_Candidate((name,), *_aim(self._rig.cameras[name], blob)) for blob in _blobs(rest)]
        located, _ = self._look(live, images, candidates)
        return [one for one in located if one.is_drone > _SURE]

    def _look(
        self, live: Rig, images: Mapping[str, UInt8Array], candidates: Sequence[_Candidate]
    ) -> tuple[list[_Located], list[_Candidate]]:
        """The second stage, at least twice: each further picture is cut to the drone's size, with it in the middle.

        Where two cameras share the drone, they show it whole. It looks until the next picture would be the same again,
        then once more in a mirror. Also returns what is not worth another look.
        """
        settled: list[tuple[_Look, _Answer]] = []
        refused: list[_Candidate] = []
        looks = [_Look(c, c.direction, c.half_angle) for c in candidates]
        for number in range(1, _MOST_LOOKS + 1):
            if not looks:
                break
            again = []
            for look, answer in zip(looks, self._answers(live, images, looks), strict=True):
                is_drone = min(look.is_drone, answer.is_drone)
                if is_drone <= _WORTH_ANOTHER_LOOK:
                    refused.append(look.candidate)
                    continue
                if not _NEAREST_M < answer.range_m < _FARTHEST_M:
                    continue
                direction = _in_view(live, answer.position, look.candidate)
                half_angle = _half_angle(answer.size_m, answer.range_m, look.half_angle)
                surely = is_drone if number > 1 else 1.0  # the first picture may be far from what suits the drone
                further = _Look(look.candidate, direction, half_angle, answer.range_m, surely)
                if number == 1 or (number < _MOST_LOOKS and not _shows_the_same(look, further)):
                    again.append(further)
                elif is_drone > _SURE:  # others would not get surer
                    settled.append((further, answer))
            looks = again
        found = []
        for look, answer in self._last_look(live, images, settled):
            if answer.is_drone <= _WORTH_ANOTHER_LOOK:
                refused.append(look.candidate)
                continue
            sigma_m = max(_MEAN_SIGMA * answer.relative_sigma, _MIN_RELATIVE_SIGMA) * answer.range_m
            found.append(
                _Located(look.candidate, answer.position, sigma_m, answer.size_m, answer.is_drone, answer.masks)
            )
        return found, refused

    def _last_look(
        self, live: Rig, images: Mapping[str, UInt8Array], settled: Sequence[tuple[_Look, _Answer]]
    ) -> list[tuple[_Look, _Answer]]:
        """The same looks with what their last answers and a mirror say together, where both say something."""
        looks = [replace(look, half_angle=_MIRROR_WIDTH * look.half_angle, in_mirror=True) for look, _ in settled]
        together = []
        for (look, answer), other in zip(settled, self._answers(live, images, looks), strict=True):
            if _NEAREST_M < other.range_m < _FARTHEST_M and min(answer.relative_sigma, other.relative_sigma) > 0:
                together.append((look, _together(look.is_drone, [answer, other])))
        return together

    def _answers(self, live: Rig, images: Mapping[str, UInt8Array], looks: Sequence[_Look]) -> list[_Answer]:
        """What the second stage says of each look, in the body's axes."""
        if not looks:
            return []
        crops = [virtual_crop(live, look.direction, look.half_angle, self._perceiver.picture_size) for look in looks]
        pictures = [
            Picture(
                image=crop.sample(images, range_m=look.range_m)[0],
                focal_px=crop.camera.focal_px,
                R_body_camera=crop.T_body_virtual.rotation,
                position=crop.T_body_virtual.translation,
                in_mirror=look.in_mirror,
            )
            for crop, look in zip(crops, looks, strict=True)
        ]
        answers = []
        for look, crop, estimate in zip(looks, crops, self._perceiver.ranges(pictures), strict=True):
            ray = crop.camera.rays(estimate.centre[None])[0]
            position = crop.T_body_virtual.apply(estimate.range_m * ray[None])[0]
            masks = () if estimate.mask is None else (Mask(crop, estimate.mask, look.half_angle),)
            answers.append(_Answer(position, estimate.relative_sigma, estimate.size_m, estimate.is_drone, masks))
        return answers

    def _locate_by_depth(self, candidate: _Candidate, scene: SceneMaps) -> _Located | None:
        """Eq. 37 on the depth map alone: the centre of the bounding box of the drone's points."""
        if candidate.instance is None:
            return None
        rig_camera = self._rig.cameras[candidate.cameras[0]]
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
        size_m = range_m * _angular_width(rig_camera, candidate.instance)
        return _Located(candidate, position, _DEPTH_MAP_RELATIVE_SIGMA * range_m, size_m)

    @staticmethod
    def _drone_depth(
        depth: Float32Array, labels: UInt8Array, camera: RigCamera, detections: Sequence[Detection]
    ) -> Float32Array:
        """The depth map with each drone's pixels moved to its detection's range; their relief is kept."""
        moved = depth.copy()
        for detection in detections:
            if camera.name not in detection.cameras:
                continue
            mine = labels == detection.label
            z = float(camera.T_body_camera.inverse().apply(detection.position[None])[0, 2])
            if z <= 0 or not mine.any():
                continue
            relief = depth[mine] - np.median(depth[mine])
            moved[mine] = z + np.clip(relief, -detection.size_m / 2, detection.size_m / 2)
        return moved


@dataclass(frozen=True, eq=False)
class _Candidate:
    cameras: tuple[str, ...]
    direction: FloatArray
    half_angle: float
    instance: Instance | None = None
    """None where no drone was segmented, but one is expected."""
    expected: FloatArray | None = None
    """(3,) where it is expected in the body, metres."""

    @property
    def area_px(self) -> float:
        """Of its pixels."""
        return self.instance.area_px if self.instance else 0.0


@dataclass(frozen=True, eq=False)
class _Look:
    """One picture for the second stage."""

    candidate: _Candidate
    direction: FloatArray
    half_angle: float
    range_m: float | None = None
    """Of what it should show; None: not known yet."""
    is_drone: float = 1.0
    """The least probability that an earlier look gave, but for the first."""
    in_mirror: bool = False


@dataclass(frozen=True, eq=False)
class _Answer:
    """What the second stage says of one look, or of several."""

    position: FloatArray
    """(3,) in the body, metres."""
    relative_sigma: float
    size_m: float
    is_drone: float
    masks: tuple[Mask, ...] = ()

    @property
    def range_m(self) -> float:
        """From the body."""
        return float(np.linalg.norm(self.position))


@dataclass(frozen=True, eq=False)
class _Located:
    candidate: _Candidate
    position: FloatArray
    range_sigma_m: float
    size_m: float
    is_drone: float = 1.0
    masks: tuple[Mask, ...] = ()


def _blobs(pixels: BoolArray) -> list[Instance]:
    """The largest groups of pixels that touch each other, where they are large enough."""
    count, _, stats, centres = cv2.connectedComponentsWithStats(pixels.astype(np.uint8))
    largest = sorted(range(1, count), key=lambda k: -stats[k, cv2.CC_STAT_AREA])[:_MOST_RESTS]
    found = []
    for k in largest:
        left, top, width, height, area = (float(value) for value in stats[k])
        if area >= _REST_PX:
            found.append(Instance(0, centres[k] + 0.5, np.array([left, top, left + width, top + height]), area))
    return found


def _fault(frame: Frame | None, camera: RigCamera) -> str | None:
    if frame is None:
        return "no frame"
    width, height = camera.camera.size
    if frame.image.shape != (height, width, 3):
        return f"its image is {frame.image.shape[1]}x{frame.image.shape[0]} and not {width}x{height}"
    return None


def _aim(camera: RigCamera, instance: Instance) -> tuple[FloatArray, float]:
    """Direction of a drone in the body and half the angle of its first picture."""
    left, top, right, bottom = instance.box
    corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom], instance.centre])
    rays = camera.camera.rays(corners)
    inside = camera.camera.in_image(instance.centre[None])[0] and np.isfinite(rays[4]).all()
    centre = rays[4] if inside else rays[:4].mean(0) / np.linalg.norm(rays[:4].mean(0))
    reach = float(np.arccos(np.clip(rays[:4] @ centre, -1, 1)).max())
    cut = bool((instance.box[:2] < _CUT_PX).any() or (instance.box[2:] > np.array(camera.camera.size) - _CUT_PX).any())
    half_angle = float(np.clip((_CUT_MARGIN if cut else _FIRST_MARGIN) * reach, *_HALF_ANGLES))
    return camera.T_body_camera.rotation @ centre, half_angle


def _angular_width(camera: RigCamera, instance: Instance) -> float:
    left, top, right, _ = instance.box
    rays = camera.camera.rays(np.array([[left, top], [right, top]]))
    return max(_angle(rays[0], rays[1]), 1e-3)


def _angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1)))


def _half_angle(size_m: float, range_m: float, before: float | None = None) -> float:
    """Half the angle of a picture that suits a drone of known size, not far from what it was ``before``."""
    angle = float(np.arctan(_MARGIN * size_m / range_m))
    if before is not None:
        angle = float(np.clip(angle, before / _MAX_RESIZE, before * _MAX_RESIZE))
    return float(np.clip(angle, *_HALF_ANGLES))


def _shows_the_same(look: _Look, further: _Look) -> bool:
    moved = _angle(look.direction, further.direction) / look.half_angle
    resized = abs(math.log(further.half_angle / look.half_angle))
    return moved < _SAME_AIM and resized < math.log(_SAME_SIZE)


def _together(is_drone: float, answers: Sequence[_Answer]) -> _Answer:
    """The mean of log range, direction, log size and log sigma, the surer counting for more; a drone only where all see
    one."""
    sigmas = np.array([answer.relative_sigma for answer in answers])
    weights = sigmas**-2 / (sigmas**-2).sum()

    def mean(values: Sequence[float] | FloatArray) -> float:
        return float(np.exp(weights @ np.log(values)))

    ranges = np.array([answer.range_m for answer in answers])
    direction = weights @ (np.array([answer.position for answer in answers]) / ranges[:, None])
    return _Answer(
        position=mean(ranges) * direction / np.linalg.norm(direction),
        relative_sigma=mean(sigmas),
        size_m=mean([answer.size_m for answer in answers]),
        is_drone=min(is_drone, *(answer.is_drone for answer in answers)),
        masks=tuple(mask for answer in answers for mask in answer.masks),
    )


def _is_as_expected(one: _Located) -> bool:
    place = one.candidate.expected
    if place is None:
        return True
    gate_m = max(_EXPECTED_GATE * float(np.linalg.norm(place)), 0.5)
    return float(np.linalg.norm(one.position - place)) < gate_m


def _in_view(live: Rig, position: FloatArray, candidate: _Candidate) -> FloatArray:
    """The direction to a position, or the candidate's own where no camera looks that way."""
    direction = position / np.linalg.norm(position)
    return direction if live.covers(direction[None])[0] else candidate.direction


def _without_hidden(found: Sequence[_Located]) -> list[_Located]:
    """Without what would be hidden behind a nearer one whose range is surer: a part of a drone cut off by an image's
    border may look like a whole one far behind it. The nearer one always stays: better a ghost than one overlooked."""

    def hides(near: _Located, far: _Located) -> bool:
        near_m, far_m = float(np.linalg.norm(near.position)), float(np.linalg.norm(far.position))
        surer = near.range_sigma_m / near_m < far.range_sigma_m / far_m
        behind = far_m >= _SAME_RANGE * near_m  # within that, it may be one drone that two cameras see
        return surer and behind and _angle(near.position, far.position) < _HIDES * near.size_m / near_m

    return [one for one in found if not any(hides(other, one) for other in found)]


@dataclass(frozen=True, eq=False)
class _Merged:
    """One detection a drone."""

    detections: tuple[Detection, ...]
    label_of: Mapping[tuple[str, int], int]
    """By camera and the label of its instance."""
    masks_of: Mapping[int, Sequence[Mask]]


def _merge(found: Sequence[_Located]) -> _Merged:
    """What two cameras place at the same spot is one."""
    groups: list[list[_Located]] = []
    for one in sorted(found, key=lambda item: -item.candidate.area_px):
        for group in groups:
            if _is_same(group[0], one):
                group.append(one)
                break
        else:
            groups.append([one])
    detections, label_of, masks_of = [], {}, {}
    for label, group in enumerate(groups[: UNCLASSED - 1], start=1):
        weights = np.array([one.range_sigma_m**-2 for one in group])
        position = (weights[:, None] * np.array([one.position for one in group])).sum(0) / weights.sum()
        bearing, log_range = log_polar(position)
        sigma_m = min(one.range_sigma_m for one in group)  # errors of two pictures of one drone are alike
        cameras = tuple(dict.fromkeys(name for one in group for name in one.candidate.cameras))
        detections.append(
            Detection(
                bearing=bearing,
                log_range=log_range,
                covariance=log_polar_covariance(bearing, sigma_m / math.exp(log_range), _BEARING_SIGMA_RAD),
                drone_probability=max(one.is_drone for one in group),
                size_m=float((weights * [one.size_m for one in group]).sum() / weights.sum()),
                cameras=cameras,
                label=label,
            )
        )
        masks_of[label] = [mask for one in group for mask in one.masks]
        for one in group:
            if one.candidate.instance:
                label_of[(one.candidate.cameras[0], one.candidate.instance.label)] = label
    return _Merged(tuple(detections), label_of, masks_of)


def _is_same(a: _Located, b: _Located) -> bool:
    """At the same spot, or so near to each other in the picture that one drone would hide the other."""
    size_m = max(a.size_m, b.size_m)
    if np.linalg.norm(a.position - b.position) < max(_SAME_DRONE * size_m, 0.25):
        return True
    near_m, far_m = sorted((float(np.linalg.norm(a.position)), float(np.linalg.norm(b.position))))
    return far_m < _SAME_RANGE * near_m and _angle(a.position, b.position) < _SAME_BEARING * size_m / near_m


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
