"""Whether an image follows from the one before it: what is damaged in blocks, or covered by soft noise, does not.

A scene is explained by its last image, moved along the optical flow, whatever its texture is. Noise and damage come
anew with each image. How much is left unexplained also depends on how the drone moves, but it moves all of its cameras.
So an image counts as broken by comparison with the other cameras' of the same moment, and only while the drone turns
slowly. A rig of one camera has none to compare with, and is not judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.perception.flow.lucas_kanade import grey

_LONGER_SIDE_PX = 96
"""Longer side of the small images that are compared: noise of single pixels averages out, and DIS takes a
millisecond."""
_PATCH_PX = 8
_WINDOW_PX = 15
"""Over which the images are compared, so that a damaged block has contrast in any window that it is in."""
_MIN_CONTRAST = 8.0
"""Standard deviation in grey levels: where one of the images has less, there is nothing to follow."""
_MAX_DIFFERENCE = 10.0
"""Grey levels by which an image may be off on average, ..."""
_MIN_CORRELATION = 0.7
"""... unless it has the same pattern: light that changes is no damage."""
_FIT_ROUNDS, _FIT_STRIDE = 3, 4
_GAINS = (0.5, 2.0)
_MAX_TURN = np.deg2rad(10.0)
"""Largest turn of the drone between two images: beyond it the flow is lost, in one camera before the others."""
_FORGOTTEN_S = 2.0
"""After so long without an image, a camera may see something else entirely."""


class ContinuityMonitor:
    """Tells which of a rig's cameras show what does not follow from their last images."""

    def __init__(self, parameters: NoiseParameters) -> None:
        self._parameters = parameters
        self._last: dict[str, _Image] = {}
        self._clean_needed: dict[str, int] = {}
        self._R_ned_body: FloatArray = np.eye(3)

    def broken(self, images: Mapping[str, UInt8Array], time_s: float, R_ned_body: FloatArray) -> list[str]:
        """The cameras whose newest images are not to be used.

        After a broken image, so are those that follow until some in a row were not.

        Args:
            images: RGB images (h, w, 3) of one moment, by camera; a camera that is not among them starts anew.
            time_s: their time.
            R_ned_body: (3, 3) the drone's attitude then.
        """
        turned = np.arccos(np.clip((np.trace(self._R_ned_body.T @ R_ned_body) - 1.0) / 2.0, -1.0, 1.0))
        self._R_ned_body = R_ned_body
        now = {name: _Image(_small_grey(image), time_s) for name, image in images.items()}
        shares = {}
        for name, image in now.items():
            last = self._last.get(name)
            if last is not None and 0.0 <= time_s - last.time_s <= _FORGOTTEN_S and turned <= _MAX_TURN:
                shares[name] = unexplained_share(last.grey, image.grey)
        self._last = now
        found = []
        for name, share in shares.items():
            others = [other for camera, other in shares.items() if camera != name]
            if others and share - float(np.median(others)) > self._parameters.max_unexplained:
                self._clean_needed[name] = self._parameters.clean_images
                found.append(name)
            else:
                self._clean_needed[name] = max(self._clean_needed.get(name, 0) - 1, 0)
                if self._clean_needed[name]:
                    found.append(name)
        return found


@dataclass(frozen=True)
class _Image:
    grey: UInt8Array
    time_s: float


def unexplained_share(before: UInt8Array, now: UInt8Array) -> float:
    """The share, 0 to 1, of a small grey image (h, w) that the one before does not explain; what came into view is not
    counted."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    dis.setFinestScale(0)
    dis.setPatchSize(_PATCH_PX)
    if before.shape != now.shape or min(now.shape) < 2 * _PATCH_PX:
        return 0.0
    flow = dis.calc(now, before, np.zeros((*now.shape, 2), np.float32))
    height, width = now.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    u, v = u + flow[..., 0], v + flow[..., 1]
    seen_before: BoolArray = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    if not seen_before.any():
        return 0.0
    moved = cv2.remap(before.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return float(_differs(np.asarray(moved, np.float32), now.astype(np.float32), seen_before)[seen_before].mean())


def _differs(moved: Float32Array, now: Float32Array, seen_before: BoolArray) -> BoolArray:
    """Where the images differ in level and in pattern, and both have one."""
    mean_moved, mean_now = _mean(moved), _mean(now)
    variance_moved = np.maximum(_mean(moved * moved) - mean_moved**2, 0.0)
    variance_now = np.maximum(_mean(now * now) - mean_now**2, 0.0)
    covariance = _mean(moved * now) - mean_moved * mean_now
    correlation = covariance / np.sqrt(np.maximum(variance_moved * variance_now, 1.0))
    difference = _mean(np.abs(_in_the_light_of(moved, now, seen_before) - now))
    contrast = np.minimum(variance_moved, variance_now) > _MIN_CONTRAST**2
    differs: BoolArray = contrast & (difference > _MAX_DIFFERENCE) & (correlation < _MIN_CORRELATION)
    return differs


def _in_the_light_of(moved: Float32Array, now: Float32Array, used: BoolArray) -> Float32Array:
    """With the gain and the offset that fit the half of the image that fits best (least trimmed squares)."""
    x, y = moved[used][::_FIT_STRIDE], now[used][::_FIT_STRIDE]
    kept = np.ones(len(x), np.bool_)
    gain = 1.0
    for _ in range(_FIT_ROUNDS):
        if x[kept].std() < 1.0:
            break
        gain, offset = _line(x[kept].astype(np.float64), y[kept].astype(np.float64))
        errors = np.abs(gain * x + offset - y)
        kept = errors <= np.median(errors)
    gain = float(np.clip(gain, *_GAINS))
    return np.asarray(gain * moved + np.median(y - gain * x), np.float32)


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Gain and offset of the line of least squares through points (n,): a fifth of the time of `np.polyfit`."""
    from_mean = x - x.mean()
    gain = float(from_mean @ y) / float(from_mean @ from_mean)
    return gain, float(y.mean() - gain * x.mean())


def _mean(values: Float32Array) -> Float32Array:
    return np.asarray(cv2.blur(values, (_WINDOW_PX, _WINDOW_PX)), np.float32)


def _small_grey(image: UInt8Array) -> UInt8Array:
    height, width = image.shape[:2]
    scale = _LONGER_SIDE_PX / max(height, width)
    size = (max(round(scale * width), 1), max(round(scale * height), 1))
    return _shrunk(grey(image), size)


def _shrunk(image: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    """A grey image (h, w) at (width, height), by means over areas; by halves first, in a fifth of the time."""
    while min(image.shape[1] / size[0], image.shape[0] / size[1]) >= 2.0:
        half = image.shape[1] // 2, image.shape[0] // 2
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
