"""A small camera that faces one direction, its image drawn from whichever real cameras see there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry.cameras import PinholeCamera
from flockd.flight.geometry.pairs import grid_pixels
from flockd.flight.geometry.rig import Rig, RigCamera
from flockd.flight.geometry.transform import RigidTransform

_GREY = 128
_NOT_IN_IT = -1.0
_MINIFICATION = 1.5
"""Image pixels per crop pixel from which on single samples would alias."""


@dataclass(frozen=True, eq=False)
class VirtualCrop:
    """A square pinhole camera in the body, at the optical centre of its main camera, and the way to its image."""

    camera: PinholeCamera
    T_body_virtual: RigidTransform
    main: str
    """The real camera at whose optical centre it sits: from there its image is exact at every range."""
    rig: Rig

    def sample(self, images: Mapping[str, UInt8Array], *, range_m: float | None = None) -> tuple[UInt8Array, BoolArray]:
        """The image (size, size, 3) and the mask (size, size) of its pixels that some camera sees; grey elsewhere.

        Each pixel comes from the main camera wherever that sees it, else from the camera in whose image it lies
        deepest. ``images`` are (h, w, 3) by camera name; a camera without an image sees nothing. With ``range_m``,
        the distance of the target, other cameras are sampled where they see that distance, which corrects
        their parallax; without it, where they see infinity.
        """
        size = self.camera.size
        crop = np.full((size[1], size[0], 3), _GREY, dtype=np.uint8)
        valid = np.zeros((size[1], size[0]), dtype=np.bool_)
        for name, where in self._maps(images, range_m).items():
            seen = np.isfinite(where[0])
            if not seen.any():
                continue
            drawn = _draw(images[name], where, self._minification(self.rig.cameras[name]))
            if seen.all():
                crop, valid = drawn, seen
            else:
                cv2.copyTo(drawn, seen.view(np.uint8), crop)
                valid |= seen
        return crop, valid

    def _maps(self, images: Mapping[str, UInt8Array], range_m: float | None) -> dict[str, Float32Array]:
        """For each camera that is needed, u and v (2, size, size) of what it fills the crop with; NaN elsewhere.

        Of several the last one counts.
        """
        shape, pixels = (2, self.camera.size[1], self.camera.size[0]), _pixels(self.camera.size)
        to_body = self.T_body_virtual.rotation @ np.linalg.inv(self.camera.matrix)
        if self.main in images and (where := _seen_whole(self.rig.cameras[self.main], to_body, pixels)) is not None:
            return {self.main: where.astype(np.float32).reshape(shape)}
        directions = to_body @ pixels  # not of unit length, which no camera needs
        maps: dict[str, FloatArray] = {}
        missing = np.arange(directions.shape[1])
        if self.main in images:
            maps[self.main] = self.rig.cameras[self.main].pixels_of_directions(directions.T).T
            missing = np.flatnonzero(np.isnan(maps[self.main][0]))
        towards = np.take(directions, missing, axis=1)
        if range_m is not None:
            towards *= range_m / np.sqrt(np.einsum("ij,ij->j", towards, towards))
            towards += self.T_body_virtual.translation[:, None]
        deepest = np.full(len(missing), _NOT_IN_IT)
        for name, camera in self.rig.cameras.items():
            if name == self.main or name not in images or not len(missing):
                continue
            see = camera.pixels_of_directions if range_m is None else camera.pixels_of_points
            seen = see(towards.T)
            margin = _margin(camera, seen)
            deeper = margin > deepest
            if deeper.any():
                maps[name] = np.full((2, directions.shape[1]), np.nan)
                maps[name][:, missing[deeper]] = np.compress(deeper, seen.T, axis=1)
                deepest = np.maximum(deepest, margin)
        return {name: where.astype(np.float32).reshape(shape) for name, where in maps.items()}

    def _minification(self, camera: RigCamera) -> int:
        """How many pixels of a camera's image, each way, fall into one of the crop's at its middle."""
        R_camera_virtual = camera.T_body_camera.rotation.T @ self.T_body_virtual.rotation
        # Pixels of the image per radian both ways across the line of sight: their product is an area.
        per_radian = camera.camera.jacobian(R_camera_virtual[:, 2][None])[0] @ R_camera_virtual[:, :2]
        (a, b), (c, d) = per_radian.tolist()
        # A camera that only sees the crop's rim may not see its middle (NaN); its pixels are then taken one by one.
        minification = math.sqrt(abs(a * d - b * c)) / self.camera.focal_px
        return round(min(minification, *camera.camera.size)) if minification > _MINIFICATION else 1


def virtual_crop(rig: Rig, direction_body: FloatArray, half_angle_rad: float, size_px: int) -> VirtualCrop:
    """The virtual camera along ``direction_body`` (3,), ``half_angle_rad`` to its borders, ``size_px`` square.

    It sits at the optical centre of the camera in whose image the direction lies deepest, and is level: its x axis is
    horizontal in the body. A rig of the cameras that work makes it choose among those. Raises ValueError where no
    camera sees the direction, and for an angle outside (0, pi/2).
    """
    if not 0.0 < half_angle_rad < math.pi / 2.0:
        raise ValueError(
            f"a pinhole's half angle lies between 0 and 90 degrees, not {math.degrees(half_angle_rad):.1f}"
        )
    forward = np.asarray(direction_body, dtype=np.float64)
    forward = forward / np.linalg.norm(forward)
    margins = {name: _margin_of(camera, forward) for name, camera in rig.cameras.items()}
    main = max(margins, key=lambda name: margins[name])
    if margins[main] < 0.0:
        raise ValueError(f"no camera sees the body direction {np.round(forward, 3).tolist()}")
    focal = size_px / 2.0 / math.tan(half_angle_rad)
    centre = size_px / 2.0
    return VirtualCrop(
        camera=PinholeCamera(
            np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]]), (size_px, size_px)
        ),
        T_body_virtual=RigidTransform(_level_towards(forward), rig.cameras[main].T_body_camera.translation),
        main=main,
        rig=rig,
    )


def _level_towards(forward: FloatArray) -> FloatArray:
    """``R_body_virtual``: z along ``forward``, x horizontal."""
    x, y, z = forward.tolist()
    length = math.hypot(x, y)
    # The right is down x forward. Straight up or down every x is horizontal: the body's right then.
    right_x, right_y = (-y / length, x / length) if length > 1e-6 else (0.0, 1.0)
    return np.array([[right_x, -z * right_y, x], [right_y, z * right_x, y], [0.0, x * right_y - y * right_x, z]])


@lru_cache(maxsize=8)
def _pixels(size: tuple[int, int]) -> FloatArray:
    """(3, n) homogeneous coordinates of the pixel centres, row by row."""
    return np.insert(grid_pixels(size, 1).T, 2, 1.0, axis=0)


def _seen_whole(camera: RigCamera, to_body: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """A camera's u and v (2, n) of homogeneous pixels of a crop (3, n) by their homography; None where there is none.

    It is that of most crops, and takes half the time: of a pinhole without distortion that has all of them in its
    image. ``to_body`` (3, 3) makes directions of the pixels.
    """
    if not isinstance(camera.camera, PinholeCamera) or camera.camera.distortion:
        return None
    seen = camera.camera.matrix @ camera.T_body_camera.rotation.T @ to_body @ pixels
    if seen[2].min() <= 0.0:
        return None
    where: FloatArray = seen[:2] / seen[2]
    return where if camera.camera.in_image(where.T).all() else None


def _draw(image: UInt8Array, where: Float32Array, minification: int) -> UInt8Array:
    """The image's colours at u and v (2, h, w), averaged over ``minification`` pixels both ways; any at NaN."""
    if minification > 1:
        # Only the part that the crop covers, a block wider, cut along whole blocks.
        low = np.maximum(np.nanmin(where, axis=(1, 2)) // minification - 1, 0).astype(np.int64) * minification
        blocks = np.nanmax(where, axis=(1, 2)).astype(np.int64) // minification + 2 - low // minification
        blocks = np.minimum(blocks, (np.array(image.shape[1::-1]) - low) // minification)
        high = low + blocks * minification
        part = cv2.resize(
            image[low[1] : high[1], low[0] : high[0]],
            (int(blocks[0]), int(blocks[1])),
            interpolation=cv2.INTER_AREA,
        )
        image = part.astype(np.uint8, copy=False)
        where = (where - low.astype(np.float32)[:, None, None]) / np.float32(minification)
    # Centres are at integers here, and beyond the outermost ones the border repeats.
    x, y = where - np.float32(0.5)
    drawn = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return drawn.astype(np.uint8, copy=False)


def _margin(camera: RigCamera, pixels: FloatArray) -> FloatArray:
    """(n,) distance from the image's border, in focal lengths so that cameras compare; `_NOT_IN_IT` elsewhere."""
    width, height = camera.camera.size
    u, v = pixels.T
    margin = np.minimum(np.minimum(u, width - u), np.minimum(v, height - v)) / camera.camera.focal_px
    return np.where(np.isfinite(margin), margin, _NOT_IN_IT)


def _margin_of(camera: RigCamera, direction_body: FloatArray) -> float:
    """The same of one direction (3,), in half the time; any negative value for what is not in it."""
    width, height = camera.camera.size
    u, v = camera.camera.project((direction_body @ camera.T_body_camera.rotation)[None])[0].tolist()
    return min(u, width - u, v, height - v) / camera.camera.focal_px if math.isfinite(u) else _NOT_IN_IT
