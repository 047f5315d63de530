"""From the depth maps of all cameras to the nearest obstacle in each direction."""

from __future__ import annotations

import math

import numpy as np

from flockd.config.avoidance import ObstacleParameters
from flockd.geometry import Rig, RigCamera, grid_pixels
from flockd.messages import SECTORS, UNCLASSED, Float32Array, FloatArray, IntArray, ObstacleRanges, UInt8Array
from flockd.perception.observation import Observation

_STRIDE_PX = 4
"""Between pixels that are taken: a trunk of 0.2 m at 10 m is 4 px wide at 222 px a radian."""
_NEAREST_M = 0.3
_RATIO = 1.1
"""Of a range to that of the bin before it."""
_GROUND_MARGIN_M = 0.7
"""What is no higher than this above the ground that the autopilot's height gives counts as ground."""
_HORIZON = 0.1
"""Tangent of the elevation up to which a ray shows how far the drone sees at its own height."""


class ObstacleRanging:
    """Takes pixels of the depth maps for points, and of each sector the nearest distance that enough of them agree on.

    Points count in the band of heights that the drone needs, where they are no ground and on no drone. The sky is far.
    Glass, wires thinner than a pixel, and what is in the dark have no depth, or a wrong one: they are not seen.
    """

    def __init__(self, rig: Rig, parameters: ObstacleParameters) -> None:
        self._rig, self._parameters = rig, parameters
        self._pixels = {name: grid_pixels(camera.camera.size, _STRIDE_PX) for name, camera in rig.cameras.items()}
        self._rays = {name: _body_rays(camera, self._pixels[name]) for name, camera in rig.cameras.items()}
        self._edges_m = _NEAREST_M * _RATIO ** np.arange(1 + math.ceil(_bin(parameters.range_m)))

    def ranges(self, observation: Observation) -> ObstacleRanges:
        """Of one observation, whose depth has its scale."""
        points, drones = [np.empty((0, 3), np.float32)], [np.empty(0, np.uint8)]
        for name, camera in observation.cameras.items():
            column, row = self._pixels[name].astype(np.int64).T
            R_ned_body = observation.vehicle.R_ned_body.astype(np.float32)
            offset = (R_ned_body @ self._rig.cameras[name].T_body_camera.translation).astype(np.float32)
            points.append((self._rays[name] @ R_ned_body.T) * camera.depth[row, column, None] + offset)
            drones.append(camera.labels[row, column])
        return self._nearest(observation, np.concatenate(points), np.concatenate(drones))

    def _nearest(self, observation: Observation, points: Float32Array, labels: UInt8Array) -> ObstacleRanges:
        """Of points (n, 3) metres NED from the drone, and what they are labelled with (n,)."""
        p = self._parameters
        away_m = np.hypot(points[:, 0], points[:, 1])
        sectors = (
            np.round(np.arctan2(points[:, 1], points[:, 0]) * (SECTORS / (2 * math.pi))).astype(np.int64) % SECTORS
        )
        in_band = np.abs(points[:, 2]) <= p.height_band_m
        above_ground = points[:, 2] <= observation.vehicle.height_m - _GROUND_MARGIN_M
        counts = in_band & above_ground & (labels == 0) & (away_m <= p.range_m)  # NaN counts nowhere
        range_m = self._agreed(sectors[counts], away_m[counts].astype(float))
        level = (np.abs(points[:, 2]) <= _HORIZON * away_m) & (labels != UNCLASSED)
        seen_m = _medians(sectors[level], np.minimum(away_m[level], p.range_m))
        found = np.isfinite(range_m)
        sigma_m = np.where(found, p.range_sigma * np.where(found, range_m, 0.0), 0.0)
        return ObstacleRanges(
            observation.time_s, range_m, sigma_m, np.where(found, np.minimum(range_m, p.range_m), seen_m)
        )

    def _agreed(self, sectors: IntArray, away_m: FloatArray) -> FloatArray:
        """(SECTORS,) metres: the mean of the nearest points of each sector that are enough; inf where none are."""
        bins = np.clip(np.floor(_bin(away_m)), 0, len(self._edges_m) - 1).astype(np.int64)
        shape = (SECTORS, len(self._edges_m))
        cells = sectors * shape[1] + bins
        count = np.bincount(cells, minlength=math.prod(shape)).reshape(shape)
        total_m = np.bincount(cells, away_m, minlength=math.prod(shape)).reshape(shape)
        enough = np.cumsum(count, axis=1) >= self._parameters.min_pixels
        first = np.argmax(enough, axis=1)
        every = np.arange(SECTORS)
        with np.errstate(invalid="ignore"):
            mean_m = total_m[every, first] / count[every, first]
        return np.where(enough.any(axis=1), mean_m, np.inf)


def _bin(range_m: FloatArray | float) -> FloatArray:
    """On the logarithmic scale of ranges."""
    bins: FloatArray = np.log(np.maximum(range_m, _NEAREST_M) / _NEAREST_M) / math.log(_RATIO)
    return bins


def _body_rays(camera: RigCamera, pixels: FloatArray) -> Float32Array:
    """(n, 3): what has to be multiplied by a pixel's depth, in body axes."""
    rays: FloatArray = camera.camera.unproject(pixels, np.ones(len(pixels))) @ camera.T_body_camera.rotation.T
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
