"""Training samples from rendered pairs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.geometry import Rig, VirtualCrops, virtual_crops
from flockd.sim.renderer.airframe import DroneModel
from tools.training.camera_effects import as_filmed
from tools.training.dataset import (
    HEIGHT,
    MAX_DEPTH_M,
    R_BODY_CAMERA,
    WIDTH,
    PairSet,
    ground_plane,
    ray_tangents,
    rig_camera,
)

Sample = dict[str, NDArray[Any]]


def neighbours_sample(
    pairs: PairSet,
    index: int,
    rng: np.random.Generator,
    *,
    crop_px: int | None = None,
) -> Sample:
    """Image, geometry planes and targets for ``NeighboursNet``; ``crop_px``: of a square, mostly around a drone."""
    k = int(rng.integers(2))
    image, depth, ids = pairs["image"][index][k], pairs["depth"][index][k], pairs["ids"][index][k]
    focal = float(pairs["focal"][index])
    prior = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
    with_height = rng.random() < 0.7
    if with_height:
        wobble = rng.normal(0, 0.005, 3)
        tilt = np.array([[1, -wobble[2], wobble[1]], [wobble[2], 1, -wobble[0]], [-wobble[1], wobble[0], 1]])
        height = float(pairs["height"][index, k]) * (1 + rng.normal(0, 0.02))
        prior = ground_plane(focal, tilt @ pairs["R_ned_camera"][index, k], height)
    offset = _centre_offsets(pairs, index, k, ids, focal)
    geometry = np.concatenate([ray_tangents(focal), prior[None]])
    if crop_px:
        top, left = _window(pairs, index, k, crop_px, rng)
        image = image[top : top + crop_px, left : left + crop_px]
        half = np.s_[..., top // 2 : (top + crop_px) // 2, left // 2 : (left + crop_px) // 2]
        depth, ids, offset, geometry = depth[half], ids[half], offset[half], geometry[half]
    depth = np.minimum(depth.astype(np.float32), MAX_DEPTH_M)
    (image,) = as_filmed([image], rng)
    if rng.random() < 0.5:
        image, depth, ids = image[:, ::-1], depth[:, ::-1], ids[:, ::-1]
        geometry, offset = geometry[:, :, ::-1].copy(), offset[:, :, ::-1].copy()
        geometry[0] *= -1
        offset[0] *= -1
    return {
        "image": np.ascontiguousarray(image),
        "geometry": np.ascontiguousarray(geometry),
        "depth": np.ascontiguousarray(depth)[None],
        "drone": (ids > 0).astype(np.float32)[None],
        "offset": np.ascontiguousarray(offset),
    }


def _window(pairs: PairSet, index: int, k: int, size: int, rng: np.random.Generator) -> tuple[int, int]:
    """Even top and left of a square window, four times out of five around some drone."""
    seen = np.flatnonzero(pairs["drone_pixels"][index, k] > 8)
    middle = rng.uniform((0, 0), (WIDTH, HEIGHT))
    if len(seen) and rng.random() < 0.8:
        left, top, right, bottom = pairs["drone_box"][index, k, int(rng.choice(seen))]
        middle = np.array([left + right, top + bottom]) / 2 + rng.uniform(-0.4, 0.4, 2) * size
    corner = np.clip(middle - size / 2, 0, (WIDTH - size, HEIGHT - size))
    return int(corner[1]) // 2 * 2, int(corner[0]) // 2 * 2


@dataclass(frozen=True, eq=False)
class DroneInView:
    """One drone before one camera."""

    focal: float
    centre: NDArray[np.float64]
    """(3,) of the drone, in the camera's axes, metres."""
    rotation: NDArray[np.float64]
    """(3, 3) from the drone's body to the camera's axes."""
    model: DroneModel


def crop_around(drone: DroneInView, rng: np.random.Generator) -> VirtualCrops:
    """A crop in which the second stage may get the drone."""
    return crop_at(drone.centre, drone.model.size_m, drone.focal, rng)


def crop_at(centre: NDArray[Any], size_m: float, focal: float, rng: np.random.Generator) -> VirtualCrops:
    """A crop in which the second stage may get a drone at ``centre`` (3,), camera axes, m; see ``drawn_fill``."""
    fill, off = drawn_fill(rng)
    half_width = size_m / 2 * fill
    shift_m = off * half_width
    right, down = _across(centre)
    aim = R_BODY_CAMERA @ _in_view(centre + shift_m[0] * right + shift_m[1] * down, focal)
    half_angle = float(np.arctan(half_width / np.linalg.norm(centre)))
    return virtual_crops(Rig({"camera": rig_camera(focal)}), aim[None], np.array([half_angle]), 96)


def drawn_fill(rng: np.random.Generator) -> tuple[float, NDArray[np.float64]]:
    """The crop's width in drone sizes, and its aiming error (2,), right and down, in half widths.

    Half of the time as aimed by the first stage, else as by the second.
    """
    aimed = rng.random() < 0.5
    # How much of the crop the drone fills must say nothing about metres: it is drawn apart from family and range.
    fill = float(np.exp(np.clip(rng.normal(np.log(1.35), 0.1 if aimed else 0.27), np.log(0.7), np.log(2.4))))
    return fill, rng.normal(0, 0.03 if aimed else 0.15, 2)


def sample_of(drone: DroneInView, crop: VirtualCrops, image: NDArray[Any], mine: NDArray[Any]) -> Sample:
    """What ``crop`` shows of the camera's ``image`` (h, w, 3), with the truth; ``mine`` (h, w): the drone's pixels."""
    (picture,), _ = crop.sample({"camera": image})
    hubs = drone.centre + four_motors(drone.model.hubs) @ drone.rotation.T
    points = np.vstack([drone.centre[None], hubs]) @ R_BODY_CAMERA.T @ crop.R_body_virtual[0]
    place, *motors = crop.focal_px * points[:, :2] / points[:, 2:]
    log_range = np.log(np.linalg.norm(drone.centre) / crop.focal_px[0])
    return {
        "picture": picture,
        "mask": _mask_of(crop, mine),
        "target": np.array([log_range, *place], np.float32),
        "motors": np.asarray(motors, np.float32),
        "family": np.array(drone.model.family),
        "apparent": np.array(np.log(drone.model.size_m) - log_range, np.float32),
        "drone": np.array(1.0, np.float32),
    }


def four_motors(hubs: NDArray[np.float64]) -> NDArray[np.float64]:
    """The four of a drone's motors (n, 3) with the largest spread in both directions."""
    if len(hubs) == 4:
        return hubs

    def spread(chosen: tuple[int, ...]) -> float:
        places = hubs[list(chosen), :2]
        narrow, wide = np.linalg.eigvalsh(np.cov(places.T))
        return float(narrow + 0.1 * wide)

    best = max(combinations(range(len(hubs)), 4), key=spread)
    return hubs[list(best)]


def _mask_of(crop: VirtualCrops, mine: NDArray[Any]) -> NDArray[np.uint8]:
    """(96, 96) how much of each of the crop's pixels is the drone's, 0-255."""
    (picture,), (seen,) = crop.sample({"camera": np.repeat(np.uint8(255) * mine.astype(np.uint8)[:, :, None], 3, 2)})
    return np.where(seen, picture[:, :, 0], np.uint8(0))


def no_drone_sample(pairs: PairSet, negative: NDArray[Any] | None, rng: np.random.Generator) -> Sample:
    """A crop without a drone: at a row of negatives.npy (tools.training.mine), or anywhere in any image."""
    if negative is not None:
        pair, k = int(negative[0]), int(negative[1])
        middle, half_px = negative[2:4] + rng.normal(0, 0.15, 2) * negative[4], negative[4]
        half_px = half_px * np.exp(rng.uniform(0.0, 1.0))
    else:
        pair, k = int(rng.integers(pairs.count)), int(rng.integers(2))
        middle, half_px = rng.uniform((0, 0), (WIDTH, HEIGHT)), np.exp(rng.uniform(np.log(6), np.log(90)))
        boxes = pairs["drone_box"][pair, k][pairs["drone_pixels"][pair, k] > 0]
        if len(boxes) and (np.abs((boxes[:, :2] + boxes[:, 2:]) / 2 - middle).max(1) < 1.5 * half_px).any():
            return no_drone_sample(pairs, None, rng)
    focal = float(pairs["focal"][pair])
    middle = np.clip(middle, 1, (WIDTH - 1, HEIGHT - 1))
    aim = R_BODY_CAMERA @ np.array([*((middle - (WIDTH / 2, HEIGHT / 2)) / focal), 1.0])
    half_angle = float(np.arctan(max(half_px, 4.0) / focal))
    crop = virtual_crops(Rig({"camera": rig_camera(focal)}), aim[None], np.array([half_angle]), 96)
    return sample_without_drone(crop, np.asarray(pairs["image"][pair][k]))


def sample_without_drone(crop: VirtualCrops, image: NDArray[Any]) -> Sample:
    """What ``crop`` shows of the camera's ``image`` (h, w, 3), without a drone."""
    (picture,), _ = crop.sample({"camera": image})
    return {
        "picture": picture,
        "mask": np.zeros(picture.shape[:2], np.uint8),
        "target": np.zeros(3, np.float32),
        "motors": np.zeros((4, 2), np.float32),
        "family": np.array(0),
        "apparent": np.array(0.0, np.float32),
        "drone": np.array(0.0, np.float32),
    }


def flow_sample(pairs: PairSet, index: int, rng: np.random.Generator, size: tuple[int, int]) -> Sample:
    """Two quarter-size images and the flow between them, cropped to ``size`` (height, width).

    Half of the second images are the first one warped: larger motions and turns than drones make in a step.
    """
    first, second = (_quarter(image) for image in pairs["image"][index])
    ids = _pairwise(pairs["ids"][index][0]).max((-3, -1))
    if rng.random() < 0.5:
        second, flow, valid = warped(first, second, rng)
    else:
        flow = _pairwise(pairs["flow"][index].astype(np.float32)).mean((-3, -1)) / 4.0
        valid = np.asarray(_pairwise(pairs["flow_valid"][index]).all((-3, -1)))
    first, second = as_filmed([first, second], rng)
    if rng.random() < 0.5:
        first, second, valid, ids = first[:, ::-1], second[:, ::-1], valid[:, ::-1], ids[:, ::-1]
        flow = flow[:, :, ::-1] * np.array([-1, 1], np.float32)[:, None, None]
    top = int(rng.integers(first.shape[0] - size[0] + 1))
    left = int(rng.integers(first.shape[1] - size[1] + 1))
    window = np.s_[top : top + size[0], left : left + size[1]]
    return {
        "first": np.ascontiguousarray(first[window]),
        "second": np.ascontiguousarray(second[window]),
        "flow": np.ascontiguousarray(flow[(slice(None), *window)]),
        "valid": np.ascontiguousarray(valid[window]),
        "drone": np.ascontiguousarray(ids[window] > 0),
    }


def warped(
    image: NDArray[np.uint8], behind: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """The image after a projective motion, the flow (2, h, w) in pixels, and where the flow is known (h, w).

    ``behind`` (h, w, 3) fills the rest.
    """
    height, width = image.shape[:2]
    middle = np.array([width / 2, height / 2])
    angle, zoom = rng.normal(0, np.radians(10)), np.exp(rng.normal(0, 0.12))
    turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = turn @ (np.eye(2) + rng.normal(0, 0.04, (2, 2)))
    shift = rng.normal(0, 0.12, 2) * width
    tilt = rng.normal(0, 0.1, 2) / width
    away, back = np.eye(3), np.eye(3)
    away[:2, 2], back[:2, 2] = -middle, middle + shift
    motion = np.eye(3)
    motion[:2, :2], motion[2, :2] = turn, tilt
    motion = back @ motion @ away
    second = cv2.warpPerspective(image, motion, (width, height), dst=behind.copy(), borderMode=cv2.BORDER_TRANSPARENT)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    places = cv2.perspectiveTransform(np.stack([u, v], 2), motion)
    flow = np.moveaxis(places - np.stack([u, v], 2), 2, 0).astype(np.float32)
    inside = (places >= 0).all(2) & (places[..., 0] <= width - 1) & (places[..., 1] <= height - 1)
    return np.asarray(second, np.uint8), flow, np.asarray(inside)


def _quarter(image: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _pairwise(values: NDArray[Any]) -> NDArray[Any]:
    """(..., h, w) -> (..., h / 2, 2, w / 2, 2)."""
    h, w = values.shape[-2:]
    return values.reshape(*values.shape[:-2], h // 2, 2, w // 2, 2)


def _centre_offsets(pairs: PairSet, index: int, k: int, ids: NDArray[Any], focal: float) -> NDArray[np.float32]:
    """(2, h/2, w/2) half-size pixels from each drone pixel to where its drone's centre projects."""
    offset = np.zeros((2, *ids.shape), np.float32)
    rows, columns = np.nonzero(ids)
    if rows.size:
        centres = np.asarray(pairs["drone_centre"][index, k], np.float64)
        with np.errstate(invalid="ignore"):
            u = (centres[:, 0] / centres[:, 2] * focal + WIDTH / 2) / 2
            v = (centres[:, 1] / centres[:, 2] * focal + HEIGHT / 2) / 2
        mine = ids[rows, columns].astype(np.int64) - 1
        offset[0, rows, columns] = np.nan_to_num(u[mine] - (columns + 0.5))
        offset[1, rows, columns] = np.nan_to_num(v[mine] - (rows + 0.5))
    return np.clip(offset, -120, 120)


def _across(centre: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    forward = centre / np.linalg.norm(centre)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    return right, np.cross(forward, right)


def _in_view(point: NDArray[Any], focal: float) -> NDArray[Any]:
    """The point (3,), or the nearest one at its depth inside the picture."""
    reach = np.array([WIDTH / 2 - 1, HEIGHT / 2 - 1]) / focal * point[2]
    return np.append(np.clip(point[:2], -reach, reach), point[2])
