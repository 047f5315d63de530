"""Whether a camera's lens is covered, dirty, fogged, or in the sun: by what it showed of the ground before.

All four take contrast or sharpness from the image, and stay. Sky has none of either, so only blocks of the image that
look at the ground count. Ground without contrast, dusk and mist take it from all cameras of a rig: one camera is judged
beside the others. Local contrast and the share of it at the finest scale are usual measures of an image's quality (S.
Pertuz et al., "Analysis of focus measure operators for shape-from-focus", Pattern Recognition 46(5), 2013).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import RigCamera

_BLOCKS, _LEAST_BLOCK_PX = 15, 8
"""Blocks along the shorter side of an image, of so many pixels at least."""
_BELOW_RAD = math.radians(10.0)
"""A block that looks down at least so steeply shows ground, over hills too."""
_LEAST_BLOCKS = 12
"""With fewer that show ground nothing is said."""
_QUANTILE = 0.75
"""Of the blocks: a plain wall near by takes the contrast from some, a lens from all."""
_FINE_PX, _COARSE_PX = 1.0, 4.0
"""Standard deviations of the blurs between which details count as fine, and as coarse."""
_FAINTEST = 0.5
"""Grey levels: a camera's noise; ground of less contrast says nothing of sharpness."""
_EVERY_S, _REMEMBERED_S, _LEAST_REMEMBERED = 0.4, 300.0, 6
"""A camera's history."""
_LASTS_S, _LEAST_IMAGES = 2.0, 3
"""So long, and in so many images, it is bad, or good again, before it counts: a gust turns a camera for a moment."""
_GOOD_AGAIN = 1.25
"""Factor on the limit for a lens that was bad."""
_FORGOTTEN_S = 5.0


class Clarity(NamedTuple):
    """Of the ground in one image."""

    contrast: float
    """Grey levels: standard deviation of coarse details in a block of the better ones."""
    sharpness: float
    """That of fine details over it."""


def clarity(image: UInt8Array, ground: BoolArray) -> Clarity | None:
    """Of an RGB image (h, w, 3), in the blocks (rows, columns) that show ground; None: they are too few."""
    if np.count_nonzero(ground) < _LEAST_BLOCKS:
        return None
    side = _block_px(image.shape[:2])
    cut = image[: ground.shape[0] * side, : ground.shape[1] * side]
    grey = cv2.cvtColor(cut, cv2.COLOR_RGB2GRAY)
    if side >= 2 * _LEAST_BLOCK_PX:
        grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    fine_out = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _FINE_PX)
    coarse_out = cv2.GaussianBlur(fine_out, (0, 0), _COARSE_PX)
    fine = _deviations(cv2.subtract(grey, fine_out, dtype=cv2.CV_32F), ground)
    coarse = _deviations(cv2.subtract(fine_out, coarse_out), ground)
    contrast = float(np.quantile(coarse, _QUANTILE))
    return Clarity(contrast, float(np.quantile(fine, _QUANTILE)) / max(contrast, _FAINTEST))


def _deviations(details: NDArray[Any], ground: BoolArray) -> Float32Array:
    rows, columns = ground.shape
    squares = cv2.resize(cv2.multiply(details, details), (columns, rows), interpolation=cv2.INTER_AREA)
    deviations: Float32Array = np.sqrt(squares[ground])
    return deviations


@dataclass
class _History:
    """One camera's."""

    good: deque[tuple[float, Clarity]] = field(default_factory=deque)
    time_s: float = -math.inf
    since_s: float = math.inf
    """Since when it is otherwise than it counts."""
    images: int = 0
    """As many since then."""
    bad: bool = False


class LensMonitor:
    """Tells which of a rig's cameras have a lens that shows too little."""

    def __init__(self, cameras: Mapping[str, RigCamera], parameters: NoiseParameters) -> None:
        self._limit = parameters.min_clarity
        self._rays = {name: _block_rays(camera) for name, camera in cameras.items()}
        self._histories = {name: _History() for name in cameras}

    def bad(self, images: Mapping[str, UInt8Array], time_s: float, R_ned_body: FloatArray) -> dict[str, str]:
        """The cameras whose images are not to be used, each with what is wrong, for people.

        Args:
            images: RGB images (h, w, 3) of one moment, by camera, of the rig's sizes.
            time_s: their time.
            R_ned_body: (3, 3) the drone's attitude then.
        """
        shares = {}
        for name, image in images.items():
            ground = self._rays[name] @ R_ned_body[2] > math.sin(_BELOW_RAD)
            now = clarity(image, ground) if self._limit else None
            if now is not None:
                shares[name] = (now, self._share(name, now))
        faults = {}
        for name, (now, share) in shares.items():
            others = [other for camera, (_, other) in shares.items() if camera != name and other is not None]
            usual = min(float(np.median(others)), 1.0) if others else 1.0
            self._judge(name, time_s, now, None if share is None else share / max(usual, 0.1))
        for name in images:
            if self._histories[name].bad:
                faults[name] = "its lens is covered, dirty, fogged or in the sun, by the contrast of the ground"
        return faults

    def _share(self, name: str, now: Clarity) -> float | None:
        """Contrast or sharpness, whichever has lost more, over the camera's own; None: it has no history yet."""
        good = [clear for _, clear in self._histories[name].good]
        if len(good) < _LEAST_REMEMBERED:
            return None
        contrast, sharpness = np.median(good, axis=0)
        if contrast < 2.0 * _FAINTEST:
            return None
        sharp = now.sharpness / max(float(sharpness), 1e-6) if now.contrast > _FAINTEST else 1.0
        return min(now.contrast / float(contrast), sharp)

    def _judge(self, name: str, time_s: float, now: Clarity, share: float | None) -> None:
        history = self._histories[name]
        if abs(time_s - history.time_s) > _FORGOTTEN_S:
            history.since_s = math.inf
        history.time_s = time_s
        limit = self._limit * (_GOOD_AGAIN if history.bad else 1.0)
        is_bad = share is not None and share < limit
        if is_bad == history.bad:
            history.since_s, history.images = math.inf, 0
        else:
            history.since_s = min(history.since_s, time_s)
            history.images += 1
            if time_s - history.since_s >= _LASTS_S and history.images >= _LEAST_IMAGES:
                history.bad, history.since_s, history.images = is_bad, math.inf, 0
        if not (is_bad or history.bad) and (not history.good or time_s - history.good[-1][0] >= _EVERY_S):
            history.good.append((time_s, now))
            while time_s - history.good[0][0] > _REMEMBERED_S and len(history.good) > _LEAST_REMEMBERED:
                history.good.popleft()


def _block_rays(camera: RigCamera) -> FloatArray:
    """(rows, columns, 3) unit vectors in body axes through the blocks' middles; NaN where the lens images nothing."""
    side = _block_px(camera.camera.size)
    columns, rows = (length // side for length in camera.camera.size)
    u, v = np.meshgrid((np.arange(columns) + 0.5) * side, (np.arange(rows) + 0.5) * side)
    rays = camera.camera.rays(np.column_stack([u.ravel(), v.ravel()])) @ camera.T_body_camera.rotation.T
    return rays.reshape(rows, columns, 3)


def _block_px(size: tuple[int, ...]) -> int:
    return max(min(size) // _BLOCKS // 2 * 2, _LEAST_BLOCK_PX)
