"""From the depth maps of all cameras to the nearest obstacle in each direction."""

from __future__ import annotations

import math

import numpy as np

from flockd.config.avoidance import ObstacleParameters
from flockd.geometry import Rig, RigCamera, grid_pixels
from flockd.messages import (
    SECTORS,
    UNCLASSED,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    ObstacleRanges,
    UInt8Array,
)
from flockd.perception.observation import Observation

_STRIDE_PX = 4
"""Between pixels that are taken: a trunk of 0.2 m at 10 m is 4 px wide at 222 px a radian."""
_NEAREST_M = 0.3
_RATIO = 1.1
"""Of a range to that of the bin before it."""
_GROUND_MARGIN_M = 0.7
"""What is no higher than this above the ground counts as ground."""
_HORIZON = 0.1
"""Tangent of the elevation up to which a ray shows how far the drone sees at its own height."""


class ObstacleRanging:
    """Takes pixels of the depth maps for points, and of each sector the nearest distance that enough of them agree on.

    Points count in the band of heights that the drone needs, where they are no ground and on no drone. The sky is far.
    Glass, wires thinner than a pixel, and what is in the dark have no depth, or a wrong one: they are not seen.
    """

    def __init__(self, rig: Rig, parameters: ObstacleParameters) -> None:
        self._rig, self._parameters = rig, parameters
        self._rays = {name: _body_rays(camera) for name, camera in rig.cameras.items()}
        self._bins = 1 + math.ceil(_bin(parameters.range_m))

    def ranges(self, observation: Observation) -> ObstacleRanges:
        """Of one observation, whose depth has its scale."""
        points, labels = [np.empty((3, 0), np.float32)], [np.empty(0, np.uint8)]
        R_ned_body = observation.vehicle.R_ned_body.astype(np.float32)
        grid = slice(_STRIDE_PX // 2, None, _STRIDE_PX)  # of `grid_pixels`
        for name, camera in observation.cameras.items():
            origin = R_ned_body @ self._rig.cameras[name].T_body_camera.translation.astype(np.float32)
            north, east, down = (R_ned_body @ self._rays[name]) * camera.depth[grid, grid].ravel() + origin[:, None]
            about_level = (np.abs(down) <= self._parameters.height_band_m) | _is_level(north, east, down)
            points.append(np.stack([north[about_level], east[about_level], down[about_level]]))
            labels.append(camera.labels[grid, grid].ravel()[about_level])
        return self._nearest(observation, np.concatenate(points, axis=1), np.concatenate(labels))

    def _nearest(self, observation: Observation, points: Float32Array, labels: UInt8Array) -> ObstacleRanges:
        """Of points (3, n) metres NED from the drone, and what they are labelled with (n,)."""
        p = self._parameters
        north, east, down = points
        away_m = np.hypot(north, east)
        sectors = np.round(np.arctan2(east, north) * (SECTORS / (2 * math.pi))).astype(np.int64) % SECTORS
        in_band = np.abs(down) <= p.height_band_m
        above_ground = down <= _ground_down_m(observation, north, east) - _GROUND_MARGIN_M
        counts = in_band & above_ground & (labels == 0) & (away_m <= p.range_m)
        range_m = self._agreed(sectors[counts], away_m[counts].astype(float))
        level = _is_level(north, east, down) & (labels != UNCLASSED)
        seen_m = _medians(sectors[level], np.minimum(away_m[level], p.range_m))
        found = np.isfinite(range_m)
        sigma_m = np.where(found, p.range_sigma * np.where(found, range_m, 0.0), 0.0)
        return ObstacleRanges(
            observation.time_s, range_m, sigma_m, np.where(found, np.minimum(range_m, p.range_m), seen_m)
        )

    def _agreed(self, sectors: IntArray, away_m: FloatArray) -> FloatArray:
        """(SECTORS,) metres: the mean of the nearest points of each sector that are enough; inf where none are."""
        bins = np.minimum(np.floor(_bin(away_m)), self._bins - 1).astype(np.int64)
        shape = (SECTORS, self._bins)
        cells = sectors * shape[1] + bins
        count = np.bincount(cells, minlength=math.prod(shape)).reshape(shape)
        total_m = np.bincount(cells, away_m, minlength=math.prod(shape)).reshape(shape)
        enough = np.cumsum(count, axis=1) >= self._parameters.min_pixels
        first = np.argmax(enough, axis=1)
        every = np.arange(SECTORS)
        with np.errstate(invalid="ignore"):
            mean_m = total_m[every, first] / count[every, first]
        return np.where(enough.any(axis=1), mean_m, np.inf)


def _ground_down_m(observation: Observation, north: Float32Array, east: Float32Array) -> float | Float32Array:
    """How far below the drone the ground is under points (n,): level, or the plane that ranges to it tell."""
    ground = observation.ground
    if ground is None:
        return observation.vehicle.height_m
    return np.asarray(ground.height_m - north * ground.slope[0] - east * ground.slope[1], np.float32)


def _bin(range_m: FloatArray | float) -> FloatArray:
    """On the logarithmic scale of ranges."""
    bins: FloatArray = np.log(np.maximum(range_m, _NEAREST_M) / _NEAREST_M) / math.log(_RATIO)
    return bins


def _is_level(north: Float32Array, east: Float32Array, down: Float32Array) -> BoolArray:
    """(n,) of points: whether they are about as high as the drone, seen from it; NaN is not."""
    level: BoolArray = down**2 <= _HORIZON**2 * (north**2 + east**2)
    return level


def _body_rays(camera: RigCamera) -> Float32Array:
    """(3, n): what has to be multiplied by the depth of each pixel that is taken, in body axes."""
    pixels = grid_pixels(camera.camera.size, _STRIDE_PX)
    rays: FloatArray = camera.T_body_camera.rotation @ camera.camera.unproject(pixels, np.ones(len(pixels))).T
    return rays.astype(np.float32)


def _medians(sectors: IntArray, values: Float32Array) -> FloatArray:
    """(SECTORS,) of each sector's values; 0 where there are none."""
    order = np.lexsort((values, sectors))
    count = np.bincount(sectors, minlength=SECTORS)
    first = np.cumsum(count) - count
    middle = np.minimum(first + count // 2, max(len(values) - 1, 0))
    if not len(values):
        return np.zeros(SECTORS)
    return np.where(count > 0, values[order][middle], 0.0).astype(float)
