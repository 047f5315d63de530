"""Motion blur and rolling shutter: an image's light, moved along the velocity of every pixel.

An approximation. Each row of the image is the mean of the one view that was drawn, at the middle row's time, sampled
where its pixels were at instants of the row's exposure. A pixel's velocity is that of what it shows: known from its
range, the camera's motion, and the neighbours'. Over an image velocities are constant, but for the shake, whose angle
is taken at every instant. Not drawn: what a nearer thing uncovers, which shows its surroundings instead, within its way
in the time (a few pixels), and a neighbour's own rotation. Beside the mean of views that were drawn at 48 instants, a
third of what blur and skew change is left as an error, over drones up to six tenths where they are a dozen pixels wide
(`tests/sim/cameras/test_shutter.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray
from flockd.flight.geometry import Camera
from flockd.sim.cameras.imperfect_cameras import ShakeConfig, ShutterConfig
from flockd.sim.renderer.renderer import View

_PROPELLERS, _SPREAD = 4, 0.1
_OF_REVOLUTIONS = 0.8
"""Share of the power at the propellers' frequency; the rest is at that of their two blades."""


class Shaking:
    """The shake of one camera: angles about its axes, as sums of tones with seeded frequencies and phases."""

    def __init__(self, config: ShakeConfig, rng: np.random.Generator) -> None:
        revolutions = config.frequency_hz * rng.uniform(1 - _SPREAD, 1 + _SPREAD, _PROPELLERS)
        self._rad_s = 2 * math.pi * np.concatenate([revolutions, 2 * revolutions])
        powers = np.repeat([_OF_REVOLUTIONS, 1 - _OF_REVOLUTIONS], _PROPELLERS) / _PROPELLERS
        self._amplitudes = math.radians(config.rms_deg) * np.sqrt(2 * powers)
        self._phases = rng.uniform(0, 2 * math.pi, (3, 2 * _PROPELLERS))

    def at(self, times_s: FloatArray) -> FloatArray:
        """Angles (n, 3) rad about the camera's axes at times (n,) s."""
        tones = np.sin(times_s[:, None, None] * self._rad_s + self._phases)
        return np.asarray(tones @ self._amplitudes, np.float64)


_MOST_SAMPLES = 16
"""Instants of an exposure, one for each pixel of the longest way."""
_FEW_SAMPLES = 4
_MOST_WAY_PX = 60
_SAME_DEPTH = 0.9
"""Pixels around a drone may belong to it from this share of its depth on."""
_STILL_PX = 0.02
"""Shorter ways count as standstill."""

Shake = Callable[[FloatArray], FloatArray]
"""Angles (n, 3) rad about the camera's axes at times (n,) s relative to the middle row's."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """How a camera moves while it exposes, in its own axes (RDF)."""

    velocity: FloatArray
    """(3,) m/s."""
    turn: FloatArray
    """(3,) rad/s, without the shake."""
    shake: Shake
    drones: Mapping[int, FloatArray]
    """Velocities (3,) m/s of the neighbours that may be seen, by their id in the view."""


@dataclass(frozen=True, eq=False)
class LensField:
    """How the pixels of a lens move when its camera moves; computed once for each camera."""

    u: Float32Array
    v: Float32Array
    """(h, w) as OpenCV counts."""
    by_turn: Float32Array
    """(3, h, w, 2) pixels for each radian that the camera turns about its axes."""
    by_move: Float32Array
    """(3, h, w, 2) pixels for each metre that it moves, at a range of 1 m."""
    z_share: Float32Array
    """(h, w) z over range along the pixel's ray."""
    imaged: BoolArray
    """(h, w)"""
    rays: Float32Array
    """(h, w, 3)"""
    solid_angle_sr: float

    @classmethod
    def of(cls, camera: Camera) -> LensField:
        """The field of a camera's lens."""
        width, height = camera.size
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        rays = camera.rays(np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1))
        imaged = np.asarray(np.isfinite(rays).all(axis=1), np.bool_)
        # A point X moves by -(turn x X) - move in axes that turn and move.
        by_point = np.where(imaged[:, None, None], np.nan_to_num(camera.jacobian(np.nan_to_num(rays))), 0.0)
        x, y, z = np.nan_to_num(rays).T
        zero = np.zeros_like(x)
        cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
        shape = (3, height, width, 2)
        grid = np.nan_to_num(rays).reshape(height, width, 3)
        across, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
        return cls(
            u=u.astype(np.float32),
            v=v.astype(np.float32),
            by_turn=np.moveaxis(by_point @ cross, 2, 0).reshape(shape).astype(np.float32),
            by_move=np.moveaxis(-by_point, 2, 0).reshape(shape).astype(np.float32),
            z_share=z.reshape(height, width).astype(np.float32),
            imaged=imaged.reshape(height, width),
            rays=grid.astype(np.float32),
            solid_angle_sr=float(np.linalg.norm(np.cross(across, down), axis=2)[imaged.reshape(height, width)].sum()),
        )


def exposed(
    light: Float32Array, view: View, lens: LensField, motion: CameraMotion, shutter: ShutterConfig
) -> Float32Array:
    """The light (h, w, 3) that each row gathers in its exposure, of what the view shows at the middle row's time."""
    longest_s = (shutter.exposure_s + shutter.readout_s) / 2
    if longest_s == 0.0:
        return light
    velocity = pixel_velocity(view, lens, motion, longest_s)
    row_s = _read_at(lens, shutter)
    samples = _samples(velocity, lens, motion, shutter.exposure_s)
    instants = (np.arange(samples) + 0.5) / samples - 0.5
    ways = [_way(velocity, lens, motion, row_s + instant * shutter.exposure_s) for instant in instants]
    if max(_most(way) for way in ways) < _STILL_PX:
        return light
    total = np.zeros_like(light)
    # Between pixels a linear interpolation blurs by itself; a mean of many ways is soft anyway.
    kind = cv2.INTER_CUBIC if samples <= _FEW_SAMPLES else cv2.INTER_LINEAR
    for way in ways:
        shown = cv2.remap(light, lens.u - way[..., 0], lens.v - way[..., 1], kind, borderMode=cv2.BORDER_REPLICATE)
        total += np.asarray(shown, np.float32)
    total /= samples
    return total if lens.imaged.all() else np.where(lens.imaged[..., None], total, light)


def _read_at(lens: LensField, shutter: ShutterConfig) -> FloatArray:
    """Seconds after the image's time of each of the sensor's rows: (h, 1) of the image's, or (1, w) of its columns."""
    height, width = lens.u.shape
    count = height if shutter.readout_from == "top" else width
    read_s: FloatArray = ((np.arange(count) + 0.5) / count - 0.5) * shutter.readout_s
    if shutter.readout_from == "top":
        return read_s.reshape(-1, 1)
    return (read_s if shutter.readout_from == "left" else read_s[::-1]).reshape(1, -1)


def pixel_velocity(view: View, lens: LensField, motion: CameraMotion, within_s: float) -> Float32Array:
    """Velocity (h, w, 2) px/s of what each pixel shows, or of the nearest thing that gets there within the time."""
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.where(lens.z_share > 0.0, view.depth / lens.z_share, np.inf).astype(np.float32)
    turning, moving = _times(lens.by_turn, motion.turn), _times(lens.by_move, motion.velocity)
    seen = {number: view.ids == number for number in sorted(motion.drones) if (view.ids == number).any()}
    of_drones = {number: _times(lens.by_move, motion.velocity - motion.drones[number]) for number in seen}
    drones_px_s = [_most(turning[mask] + of_drones[n][mask] / range_m[mask][:, None]) for n, mask in seen.items()]
    reach_px = math.ceil(max([_most(turning + moving / _twice(range_m)), *drones_px_s]) * within_s)
    around = np.ones((2 * min(reach_px, _MOST_WAY_PX) + 1,) * 2, np.uint8)
    range_m = np.asarray(cv2.erode(range_m, around), np.float32)
    for number, mask in seen.items():
        nearest_m = float(view.depth[mask].min())
        mine = (cv2.dilate(mask.astype(np.uint8), around) > 0) & (range_m * lens.z_share > _SAME_DEPTH * nearest_m)
        moving[mine] = of_drones[number][mine]
    return np.asarray(turning + moving / _twice(range_m), np.float32)


def _twice(values: FloatArray | Float32Array) -> Any:
    """(..., 2): numpy multiplies whole rows at once, pairs by one number each would take it many times as long."""
    return values[..., None].repeat(2, axis=-1)


def _times(by: Float32Array, vectors: FloatArray) -> Float32Array:
    """(h, w, 2) of (3, h, w, 2) and (3,), or (3, h, 1, 2) or (3, 1, w, 2) for each row or column."""
    x, y, z = vectors.astype(np.float32)
    total = by[0] * x
    total += by[1] * y
    total += by[2] * z
    return np.asarray(total, np.float32)


def _most(velocity: Float32Array) -> float:
    return float(max(velocity.max(initial=0.0), -velocity.min(initial=0.0)))


def _samples(velocity: Float32Array, lens: LensField, motion: CameraMotion, exposure_s: float) -> int:
    """One for each pixel of the longest way in an exposure."""
    if exposure_s == 0.0:
        return 1
    angles = motion.shake(np.linspace(-0.5, 0.5, 9) * exposure_s)
    shaken = float(np.ptp(angles, axis=0).max(initial=0.0)) * _most(lens.by_turn)
    way_px = float(np.percentile(np.abs(velocity), 99.5)) * exposure_s + shaken
    return int(np.clip(math.ceil(way_px) + 1, 1, _MOST_SAMPLES)) if way_px > _STILL_PX else 1


def _way(velocity: Float32Array, lens: LensField, motion: CameraMotion, row_s: FloatArray) -> Float32Array:
    """(h, w, 2) pixels that what is seen has moved since the image's time, when each row of the sensor is exposed."""
    since = motion.shake(np.append(row_s, 0.0))
    shaken = (since[:-1] - since[-1]).astype(np.float32)
    way = velocity * _twice(row_s.astype(np.float32))
    if shaken.any():
        way += _times(lens.by_turn, _twice(shaken.T.reshape(3, *row_s.shape)))
    return np.asarray(np.clip(way, -_MOST_WAY_PX, _MOST_WAY_PX), np.float32)
