"""The nearest obstacle in each direction, from the depth maps of all cameras."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import (
    SECTORS,
    UNCLASSED,
    BoolArray,
    EgoMotion,
    Float32Array,
    FloatArray,
    GroundEstimate,
    IntArray,
    ObstacleRanges,
)
from flockd.flight.geometry import Rig, RigCamera, grid_pixels
from flockd.flight.perception.observation import Observation

_STRIDE_PX = 4
"""Spacing of the pixels used: a trunk of 0.2 m at 10 m is 4 px wide at 222 px per radian."""
_NEAREST_M = 0.3
_RATIO = 1.1
"""Ratio of the ranges of successive bins."""
_GROUND_MARGIN_M = 0.7
"""Height above the ground up to which a point counts as ground."""
_HORIZON = 0.1
"""Largest tangent of the elevation at which a ray shows the range of sight at the drone's own height."""


_GRID = slice(_STRIDE_PX // 2, None, _STRIDE_PX)
"""The rows or columns of `grid_pixels`."""
_STEEPEST = 0.6
"""Largest sine of the elevation at which pixels are triangulated: at 2 m, it includes all down to 1.5 m below the
drone. In the direction of flight, only points above or below have a parallax."""
_MIN_BASELINE_M = 0.05
"""Shortest baseline across the line of sight; below it the flow between two images shows no depth."""
_FLOW_SIGMA_PX = 1.0
_CERTAIN_SIGMAS = 5.0
"""A triangulated point counts if its inverse range is this many standard deviations above zero, the sky's."""


class _Points(NamedTuple):
    """Places (3, n) metres, with relative standard deviations of their ranges (n,)."""

    places: Float32Array
    relative_sigma: Float32Array
    obstacle: BoolArray
    """(n,) whether the point may be an obstacle."""
    classed: BoolArray
    """(n,) whether the point shows the range of sight; an unclassified point has no known place."""


class ObstacleRanging:
    """Computes points from pixels of the depth maps, and in each sector the nearest range that enough points agree on.

    Points count within the drone's band of heights, unless they are ground or on a drone. The sky is at infinity.
    Glass, wires thinner than a pixel, and anything in the dark have no depth or a wrong one: they are not detected.
    """

    def __init__(self, rig: Rig, parameters: ObstacleParameters) -> None:
        self._rig, self._parameters = rig, parameters
        self._rays = {name: _body_rays(camera) for name, camera in rig.cameras.items()}
        self._pixel_angles = {
            name: camera.camera.pixel_angle(camera.camera.rays(grid_pixels(camera.camera.size, _STRIDE_PX)))
            for name, camera in rig.cameras.items()
        }
        self._bins = 1 + math.ceil(_bin(parameters.range_m))

    def ranges(
        self, observation: Observation, ego: EgoMotion | None = None, ground: GroundEstimate | None = None
    ) -> ObstacleRanges:
        """Ranges from the flow as far as it shows them with `ego`, and from the depth maps beyond.

        The range of sight always comes from the depth maps. ``ground``: below the drone; None: level, at the
        autopilot's height zero.
        """
        R_ned_body = observation.vehicle.R_ned_body.astype(np.float32)
        parts = []
        for name, camera in observation.cameras.items():
            moving = None if camera.flow is None or observation.previous is None else ego
            mounted = self._rig.cameras[name]
            origin = R_ned_body @ mounted.T_body_camera.translation.astype(np.float32)
            if camera.depth is not None:
                depth, labels = camera.depth[_GRID, _GRID].ravel(), camera.labels[_GRID, _GRID].ravel()
                places = (R_ned_body @ self._rays[name]) * depth + origin[:, None]
                relative = np.full(places.shape[1], self._parameters.range_sigma, np.float32)
                obstacle = labels == 0
                if moving is not None:
                    obstacle &= depth > self._flow_shows_m(name, moving)
                parts.append(self._about_level(_Points(places, relative, obstacle, labels != UNCLASSED)))
            if moving is not None:
                parts.append(self._about_level(_triangulated(mounted, observation, moving)))
        if not parts:
            return ObstacleRanges(observation.time_s, np.full(SECTORS, np.inf), np.zeros(SECTORS), np.zeros(SECTORS))
        points = _Points._make(np.concatenate(columns, axis=-1) for columns in zip(*parts, strict=True))
        return self._nearest(observation, points, ground)

    def _flow_shows_m(self, name: str, ego: EgoMotion) -> Float32Array:
        """(n,) metres: longest range at which the flow of this motion would show an obstacle in each pixel."""
        way = (ego.rotation.T @ ego.translation).astype(np.float32)
        baseline = np.linalg.norm(np.cross(way, self._rays[name].T), axis=1)
        shows = baseline / (_CERTAIN_SIGMAS * _FLOW_SIGMA_PX * self._pixel_angles[name])
        return np.where(baseline > _MIN_BASELINE_M, shows, 0.0).astype(np.float32)

    def _about_level(self, points: _Points) -> _Points:
        """The points in the drone's band of heights, and those that show the range of sight."""
        kept = self._in_band(points.places[2]) | _is_level(*points.places)
        return _Points._make(column[..., kept] for column in points)

    def _in_band(self, down: Float32Array) -> BoolArray:
        """(n,) whether points this far below the drone are in its band of heights."""
        p = self._parameters
        return (down >= -p.height_band_m) & (down <= max(p.height_band_m, p.below_m))

    def _nearest(self, observation: Observation, points: _Points, ground: GroundEstimate | None) -> ObstacleRanges:
        """The nearest obstacle in each sector, from places (3, n) metres NED from the drone."""
        p = self._parameters
        north, east, down = points.places
        away_m = np.hypot(north, east)
        sectors = np.round(np.arctan2(east, north) * (SECTORS / (2 * math.pi))).astype(np.int64) % SECTORS
        in_band = self._in_band(down)
        above_ground = down <= _ground_down_m(observation, ground, north, east) - _GROUND_MARGIN_M
        counts = in_band & above_ground & points.obstacle & (away_m <= p.range_m)
        range_m, relative = self._agreed(
            sectors[counts], away_m[counts].astype(float), points.relative_sigma[counts].astype(float)
        )
        level = _is_level(north, east, down) & points.classed
        seen_m = _medians(sectors[level], np.minimum(away_m[level], p.range_m))
        found = np.isfinite(range_m)
        sigma_m = np.where(found, relative * np.where(found, range_m, 0.0), 0.0)
        return ObstacleRanges(
            observation.time_s, range_m, sigma_m, np.where(found, np.minimum(range_m, p.range_m), seen_m)
        )

    def _agreed(self, sectors: IntArray, away_m: FloatArray, relative: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(SECTORS,) metres: mean range of the nearest points of each sector that are enough; inf if there are none.
        And the mean of their relative standard deviations."""
        bins = np.minimum(np.floor(_bin(away_m)), self._bins - 1).astype(np.int64)
        shape = (SECTORS, self._bins)
        cells = sectors * shape[1] + bins

        def summed(values: FloatArray | None) -> FloatArray:
            totals = np.bincount(cells, values, minlength=math.prod(shape)).reshape(shape)
            return totals.astype(float)

        count = summed(None)
        enough = np.cumsum(count, axis=1) >= self._parameters.min_pixels
        first = (np.arange(SECTORS), np.argmax(enough, axis=1))
        in_first = np.maximum(count[first], 1)
        mean_m = np.where(enough.any(axis=1), summed(away_m)[first] / in_first, np.inf)
        return mean_m, summed(relative)[first] / in_first


def _ground_down_m(
    observation: Observation, ground: GroundEstimate | None, north: Float32Array, east: Float32Array
) -> float | Float32Array:
    """How far below the drone the ground is at points (n,): level, or the plane from measured ranges."""
    if ground is None:
        return observation.vehicle.height_m
    return np.asarray(ground.height_m - north * ground.slope[0] - east * ground.slope[1], np.float32)


def _bin(range_m: FloatArray | float) -> FloatArray:
    """Index of the bin on the logarithmic scale of ranges."""
    bins: FloatArray = np.log(np.maximum(range_m, _NEAREST_M) / _NEAREST_M) / math.log(_RATIO)
    return bins


def _is_level(north: Float32Array, east: Float32Array, down: Float32Array) -> BoolArray:
    """(n,) whether points are about as high as the drone, seen from it; false for NaN."""
    level: BoolArray = down**2 <= _HORIZON**2 * (north**2 + east**2)
    return level


def _body_rays(camera: RigCamera) -> Float32Array:
    """(3, n) unit vectors of the pixels used, in body axes."""
    pixels = grid_pixels(camera.camera.size, _STRIDE_PX)
    rays: FloatArray = camera.T_body_camera.rotation @ camera.camera.rays(pixels).T
    return rays.astype(np.float32)


def _medians(sectors: IntArray, values: Float32Array) -> FloatArray:
    """(SECTORS,) median of each sector's values; 0 without values."""
    count = np.bincount(sectors, minlength=SECTORS)
    medians = ndimage.median(values, sectors, np.arange(SECTORS)) if len(values) else 0.0
    return np.where(count > 0, medians, 0.0).astype(float)


def _triangulated(camera: RigCamera, observation: Observation, ego: EgoMotion) -> _Points:
    """Background points from the flow and the drone's own motion, in level axes.

    Those whose inverse range is not well above that of the sky are left out.
    """
    size, R_ned_camera = camera.camera.size, observation.vehicle.R_ned_body @ camera.T_body_camera.rotation
    pixels = grid_pixels(size, _STRIDE_PX)
    pixels = pixels[pixels[:, 1] // _STRIDE_PX % 2 == 0]  # every second row
    rays, inverse, baseline = observation.inverse_ranges(camera, pixels, ego)
    down = rays @ R_ned_camera[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = _FLOW_SIGMA_PX * camera.camera.pixel_angle(rays) / baseline
        certain = (baseline > _MIN_BASELINE_M) & (inverse > _CERTAIN_SIGMAS * sigma) & (np.abs(down) <= _STEEPEST)
    places = R_ned_camera @ (rays[certain] / inverse[certain, None]).T
    places += (observation.vehicle.R_ned_body @ camera.T_body_camera.translation)[:, None]
    relative = (sigma[certain] / inverse[certain]).astype(np.float32)
    every = np.ones(len(relative), bool)
    return _Points(places.astype(np.float32), relative, every, every)
