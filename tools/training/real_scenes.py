"""Training samples for ``NeighboursNet`` from real pictures, of which no depth is known.

Without a drone everything else is known of them: no pixel is one. Of real drones only boxes are known: the middle of a
box is the drone, what lies outside is none, and what lies between is not judged. Targets that are NaN are not learnt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.ground.pictures.coco_labels import read_labels
from flockd.ground.pictures.picture_files import PictureFile, find_pictures
from tools.training.augment import as_filmed
from tools.training.dataset import FOCAL_PX, R_BODY_CAMERA, ground_plane, ray_tangents
from tools.training.samples import Sample
from tools.training.scenes import drawn_attitude

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom, pixels."""
_SCALES = (0.4, 1.5)
"""A picture is resized by, unless it would not fill the sample then."""
_DRONE_SCALES = (0.5, 1.3)
_LEAST_WIDTH_PX = 7.0
"""Least width of a drone's box: what is smaller is not made smaller still."""
_SURE_SHARE = 0.35
"""Half axes of the ellipse that is surely drone, as a share of the box."""
_MARGIN_PX = 3.0
"""Around a box, not judged either."""
_AIMED = 0.8
"""Share of the windows that show a drone, where there is one."""
_WITH_HEIGHT = 0.5
"""Share of the samples that come with a height above ground, as those of flights do."""


@dataclass(frozen=True)
class RealScenes:
    """Pictures without drones, and labelled ones with them; either may be empty."""

    without: tuple[PictureFile, ...]
    labelled: tuple[tuple[PictureFile, tuple[Box, ...]], ...]

    @classmethod
    def of(cls, without: Path | None, labels: Path | None) -> RealScenes:
        """The scenes of a folder, and of a COCO file beside its pictures. Raises UsageError and DatasetError."""
        pictures = find_pictures([without]) if without else []
        boxes = read_labels(labels, find_pictures([labels.parent])) if labels else {}
        free = [*pictures, *(picture for picture, one in boxes.items() if not one.boxes)]
        with_drones = tuple((picture, one.boxes) for picture, one in boxes.items() if one.boxes)
        return cls(tuple(picture for picture in free if not picture.is_video), with_drones)

    def background(self, size: tuple[int, int], rng: np.random.Generator) -> Image:
        """A part of a picture without drones, ``size`` (width, height) pixels large."""
        picture = self.without[int(rng.integers(len(self.without)))]
        image, _ = _placed(_read(picture), size, _SCALES, rng.random(2), rng)
        return image

    def sample_without(self, size: tuple[int, int], rng: np.random.Generator) -> Sample:
        """A sample from a picture without drones."""
        image = as_filmed(self.background(size, rng), rng)
        shape = (size[1] // 2, size[0] // 2)
        return _sample(image, np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32), rng)

    def sample_with(self, size: tuple[int, int], rng: np.random.Generator) -> Sample:
        """A sample from a picture with labelled drones."""
        picture, boxes = self.labelled[int(rng.integers(len(self.labelled)))]
        image = _read(picture)
        left, top, right, bottom = boxes[int(rng.integers(len(boxes)))]
        at = np.array([left + right, top + bottom]) / 2
        aim = at / (image.shape[1], image.shape[0]) if rng.random() < _AIMED else rng.random(2)
        least = min(max(_DRONE_SCALES[0], _LEAST_WIDTH_PX / max(right - left, 1.0)), 1.0)
        image, place = _placed(image, size, (least, _DRONE_SCALES[1]), aim, rng)
        drone, offset = _of_boxes([_moved(box, place) for box in boxes], size)
        return _sample(as_filmed(image, rng), drone, offset, rng)


def _read(picture: PictureFile) -> Image:
    (_, image) = next(picture.images(1))
    return image


def _placed(
    image: Image, size: tuple[int, int], scales: tuple[float, float], aim: NDArray[np.float64], rng: np.random.Generator
) -> tuple[Image, tuple[float, float, float]]:
    """A resized part around ``aim`` (share of width and height), and scale, left and top of it."""
    height, width = image.shape[:2]
    drawn = math.exp(rng.uniform(math.log(scales[0]), math.log(scales[1])))
    scale = max(drawn, (size[0] + 1) / width, (size[1] + 1) / height)
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(image, (math.ceil(scale * width), math.ceil(scale * height)), interpolation=method)
    room = np.array([resized.shape[1] - size[0], resized.shape[0] - size[1]])
    wanted = aim * (resized.shape[1], resized.shape[0]) - np.array(size) / 2 + rng.uniform(-0.4, 0.4, 2) * size
    left, top = np.clip(wanted, 0, room).astype(int)
    part = resized[top : top + size[1], left : left + size[0]]
    return np.ascontiguousarray(part, dtype=np.uint8), (scale, float(left), float(top))


def _moved(box: Box, place: tuple[float, float, float]) -> Box:
    scale, left, top = place
    return (scale * box[0] - left, scale * box[1] - top, scale * box[2] - left, scale * box[3] - top)


def _of_boxes(boxes: list[Box], size: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h/2, w/2) 1 on drones, NaN where nobody knows, and (2, h/2, w/2) half-size pixels to the box's middle."""
    u, v = np.meshgrid(np.arange(size[0] // 2) * 2 + 1.0, np.arange(size[1] // 2) * 2 + 1.0)
    drone, offset = np.zeros(u.shape, np.float32), np.zeros((2, *u.shape), np.float32)
    for left, top, right, bottom in boxes:
        beside = (u > left - _MARGIN_PX) & (u < right + _MARGIN_PX) & (v > top - _MARGIN_PX) & (v < bottom + _MARGIN_PX)
        drone[beside & (drone != 1)] = np.nan
        across, down = u - (left + right) / 2, v - (top + bottom) / 2
        half = max(_SURE_SHARE * (right - left), 1.5), max(_SURE_SHARE * (bottom - top), 1.5)
        sure = (across / half[0]) ** 2 + (down / half[1]) ** 2 <= 1
        drone[sure] = 1.0
        offset[:, sure] = -np.stack([across, down])[:, sure] / 2
    return drone, offset


def _sample(image: Image, drone: NDArray[np.float32], offset: NDArray[np.float32], rng: np.random.Generator) -> Sample:
    """The window is anywhere in the image of a camera of about the usual focal length."""
    height, width = drone.shape
    focal = FOCAL_PX * float(np.exp(rng.normal(0, 0.15)))
    tangents = ray_tangents(focal)
    prior = np.zeros(tangents.shape[1:], np.float32)
    if rng.random() < _WITH_HEIGHT:
        prior = ground_plane(focal, drawn_attitude(rng) @ R_BODY_CAMERA, float(rng.uniform(1.5, 8.0)))
    top = int(rng.integers(tangents.shape[1] - height + 1))
    left = int(rng.integers(tangents.shape[2] - width + 1))
    geometry = np.concatenate([tangents, prior[None]])[:, top : top + height, left : left + width].copy()
    if rng.random() < 0.5:
        image, drone, geometry, offset = image[:, ::-1], drone[:, ::-1], geometry[:, :, ::-1], offset[:, :, ::-1]
        geometry, offset = geometry.copy(), offset.copy()
        geometry[0] *= -1
        offset[0] *= -1
    return {
        "image": np.ascontiguousarray(image),
        "geometry": np.ascontiguousarray(geometry),
        "depth": np.full((1, height, width), np.nan, np.float32),
        "drone": np.ascontiguousarray(drone)[None],
        "offset": np.ascontiguousarray(offset),
    }
