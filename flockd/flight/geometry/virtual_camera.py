"""Virtual cameras that each face one direction, with images sampled from the real cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from flockd.flight.geometry.pairs import grid_pixels
from flockd.flight.geometry.rig import Rig, RigCamera

_GREY = 128
_NOWHERE = -1
"""Stands for no camera, and for no distance from an image's border."""
_MINIFICATION = 1.5
"""Image pixels per crop pixel above which single samples would alias."""


@dataclass(frozen=True, eq=False)
class VirtualCrops:
    """n square pinhole cameras in the body, each at the optical centre of its main camera, and their sampling.

    They are level: their x axes are horizontal in the body.
    """

    rig: Rig
    size_px: int
    """Their width and height."""
    focal_px: FloatArray
    """(n,)"""
    R_body_virtual: FloatArray
    """(n, 3, 3)"""
    main: IntArray
    """(n,) index in the rig of the camera in whose image the direction is farthest from the border: its view is exact
    at every range. -1: no camera sees the direction, or a pinhole cannot show the angle."""

    @property
    def centres(self) -> FloatArray:
        """(n, 3) metres in the body."""
        centres: FloatArray = np.array([one.T_body_camera.translation for one in self.rig.cameras.values()])[self.main]
        return centres

    def take(self, which: IntArray) -> VirtualCrops:
        """The cameras at these indices (m,)."""
        return VirtualCrops(self.rig, self.size_px, self.focal_px[which], self.R_body_virtual[which], self.main[which])

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit vectors in the body towards one pixel (n, 2) of each camera."""
        towards = np.ones((len(pixels), 3, 1))
        towards[:, :2, 0] = (pixels - self.size_px / 2) / self.focal_px[:, None]
        return _unit((self.R_body_virtual @ towards)[:, :, 0])

    def sample(
        self, images: Mapping[str, UInt8Array], range_m: FloatArray | None = None
    ) -> tuple[UInt8Array, BoolArray]:
        """The images (n, size, size, 3), and masks (n, size, size) of their pixels that a camera sees; grey elsewhere.

        Each pixel comes from the main camera if that sees it, else from the camera in whose image it is farthest from
        the border. ``images`` are (h, w, 3) by camera name; a camera without an image sees nothing. With ``range_m``
        (n,), the ranges of the targets, other cameras are sampled at those ranges, which corrects their parallax;
        without, or if NaN, at infinity.
        """
        source, where = self._sources(images, np.full(len(self.main), np.nan) if range_m is None else range_m)
        drawn = np.full((*source.shape, 3), _GREY, np.uint8)
        for index, camera in self._with(images):
            mine = source == index
            if not mine.any():
                continue
            minification = mine.any(1) * self._minification(camera)
            for factor in set(minification.tolist()) - {0}:
                crops = (minification == factor).nonzero()[0]
                part = drawn[crops]
                cv2.copyTo(_draw(images[camera.name], where[:, crops], factor), mine[crops].view(np.uint8), part)
                drawn[crops] = part
        shape = (len(self.main), self.size_px, self.size_px)
        return drawn.reshape(*shape, 3), (source != _NOWHERE).reshape(shape)

    def _with(self, images: Mapping[str, UInt8Array]) -> list[tuple[int, RigCamera]]:
        return [(index, one) for index, one in enumerate(self.rig.cameras.values()) if one.name in images]

    def _sources(self, images: Mapping[str, UInt8Array], range_m: FloatArray) -> tuple[IntArray, Float32Array]:
        """For each pixel (n, size^2) the index of the camera that shows it, and u and v (2, n, size^2) there; -1 and
        NaN if none does."""
        pixels = _pixels(self.size_px)
        to_virtual = np.zeros((len(self.main), 3, 3))
        to_virtual[:, [0, 1], [0, 1]] = 1.0 / self.focal_px[:, None]
        to_virtual[:, :2, 2] = -self.size_px / 2 / self.focal_px[:, None]
        to_virtual[:, 2, 2] = 1.0
        to_body = self.R_body_virtual @ to_virtual
        # One contiguous array for each coordinate.
        towards = (to_body.transpose(1, 0, 2).reshape(-1, 3) @ pixels).reshape(3, len(self.main), pixels.shape[1])
        where = np.full((2, *towards.shape[1:]), np.nan, np.float32)
        for index, camera in self._with(images):
            if index in self.main:
                crops = (self.main == index).nonzero()[0]
                seen = camera.pixels_of_directions(towards[:, crops].reshape(3, -1).T)
                where[:, crops] = seen.T.reshape(2, len(crops), -1)
        source = np.where(np.isnan(where[0]), _NOWHERE, self.main[:, None])
        missing = (source == _NOWHERE).ravel().nonzero()[0]
        if not len(missing):
            return source, where
        crop = missing // pixels.shape[1]
        towards, parallax = towards.reshape(3, -1)[:, missing], np.isfinite(range_m)[crop]
        towards *= np.where(parallax, range_m[crop], 1.0) / np.sqrt((towards * towards).sum(0))
        deepest, centres = np.full(len(missing), float(_NOWHERE)), self.centres[crop]
        for index, camera in self._with(images):
            aside = parallax * (centres - camera.T_body_camera.translation).T
            seen = camera.pixels_of_directions((towards + aside).T)
            margin = _margin(camera, seen)
            deeper = (margin > deepest).nonzero()[0]
            source.reshape(-1)[missing[deeper]] = index
            where.reshape(2, -1)[:, missing[deeper]] = seen[deeper].T
            deepest = np.maximum(deepest, margin)
        return source, where

    def _minification(self, camera: RigCamera) -> IntArray:
        """(n,) image pixels per crop pixel in the middle of each crop; at least 1."""
        R_camera_virtual = camera.T_body_camera.rotation.T @ self.R_body_virtual
        # Pixels of the image per radian in both directions across the ray: the determinant is an area.
        per_radian = camera.camera.jacobian(R_camera_virtual[:, :, 2]) @ R_camera_virtual[:, :, :2]
        (a, b), (c, d) = per_radian.transpose(1, 2, 0)
        factor = np.sqrt(np.abs(a * d - b * c)) / self.focal_px
        # A camera that sees only the crop's border may not see its middle (NaN); its pixels are then taken as they are.
        whole = np.where(factor > _MINIFICATION, np.rint(factor), 1.0)
        return np.minimum(whole, min(camera.camera.size)).astype(np.int64)


def virtual_crops(rig: Rig, directions_body: FloatArray, half_angles_rad: FloatArray, size_px: int) -> VirtualCrops:
    """The virtual cameras along ``directions_body`` (n, 3), with ``half_angles_rad`` (n,) to their borders.

    They use only the cameras of ``rig``: pass one with the cameras that work.
    """
    forward = _unit(directions_body)
    margins = np.array([_margin(camera, camera.pixels_of_directions(forward)) for camera in rig.cameras.values()])
    possible = (half_angles_rad > 0.0) & (half_angles_rad < np.pi / 2) & (margins.max(0) >= 0.0)
    focal_px = size_px / 2 / np.tan(np.where(possible, half_angles_rad, 1.0))
    main = np.where(possible, margins.argmax(0), _NOWHERE)
    return VirtualCrops(rig, size_px, focal_px, _level_towards(forward), main)


def _level_towards(forward: FloatArray) -> FloatArray:
    """(n, 3, 3) ``R_body_virtual``: z along ``forward`` (n, 3), x horizontal."""
    x, y, z = forward.T
    length = np.hypot(x, y)
    level, least = length > 1e-6, np.maximum(length, 1e-6)
    # Right is down x forward. Straight up or down every x is horizontal: then the body's right.
    right_x, right_y = np.where(level, -y / least, 0.0), np.where(level, x / least, 1.0)
    columns = [right_x, -z * right_y, x, right_y, z * right_x, y, np.zeros_like(x), x * right_y - y * right_x, z]
    return np.array(columns).T.reshape(-1, 3, 3)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.sqrt((vectors * vectors).sum(1))[:, None])


@lru_cache(maxsize=8)
def _pixels(size_px: int) -> FloatArray:
    """(3, n) homogeneous coordinates of the pixel centres, row by row."""
    return np.insert(grid_pixels((size_px, size_px), 1).T, 2, 1.0, axis=0)


def _draw(image: UInt8Array, where: Float32Array, minification: int) -> UInt8Array:
    """The image's colours at u and v (2, n, m), averaged over ``minification`` pixels each way; arbitrary at NaN."""
    if minification > 1:
        # Only the part that the crops cover plus a block, cut along whole blocks.
        low = np.maximum(np.fmin.reduce(where, axis=(1, 2)) // minification - 1, 0).astype(np.int64) * minification
        blocks = np.fmax.reduce(where, axis=(1, 2)).astype(np.int64) // minification + 2 - low // minification
        width, height = np.minimum(blocks, (np.array(image.shape[1::-1]) - low) // minification).tolist()
        part = image[low[1] : low[1] + height * minification, low[0] : low[0] + width * minification]
        image = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        where = (where - low.astype(np.float32)[:, None, None]) / np.float32(minification)
    # Centres are at integers here, and beyond the outermost ones the border repeats.
    x, y = where - np.float32(0.5)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _margin(camera: RigCamera, pixels: FloatArray) -> FloatArray:
    """(n,) distance from the image's border in focal lengths, so that cameras compare; -1 outside."""
    width, height = camera.camera.size
    u, v = pixels.T
    margin = np.minimum(np.minimum(u, width - u), np.minimum(v, height - v)) / camera.camera.focal_px
    return np.where(np.isfinite(margin), margin, float(_NOWHERE))
