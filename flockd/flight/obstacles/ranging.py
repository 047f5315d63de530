"""The nearest obstacle in each direction, from the depth maps of all cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

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
from flockd.flight.geometry import Rig, RigCamera, RigidTransform, grid_pixels, inverse_ranges_of_rays
from flockd.flight.perception.observation import CameraObservation, Observation

_STRIDE_PX = 4
"""Distance of the pixels used: a trunk of 0.2 m at 10 m is 4 px wide at 222 px per radian."""
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


@dataclass(frozen=True, eq=False)
class _Points:
    """Places (3, n) metres, with relative standard deviations of their ranges (n,)."""

    places: Float32Array
    relative_sigma: Float32Array
    obstacle: BoolArray
    """(n,) whether the point may be an obstacle."""
    classed: BoolArray
    """(n,) whether the point shows the range of sight; an unclassified point has no known place."""

    def where(self, chosen: BoolArray) -> _Points:
        return _Points(self.places[:, chosen], self.relative_sigma[chosen], self.obstacle[chosen], self.classed[chosen])

    @classmethod
    def concatenate(cls, parts: Sequence[_Points]) -> _Points:
        return cls(
            np.concatenate([part.places for part in parts], axis=1),
            np.concatenate([part.relative_sigma for part in parts]),
            np.concatenate([part.obstacle for part in parts]),
            np.concatenate([part.classed for part in parts]),
        )


_NOTHING = _Points(np.empty((3, 0), np.float32), np.empty(0, np.float32), np.empty(0, bool), np.empty(0, bool))


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
        self._triangulations = {name: _Triangulation(camera) for name, camera in rig.cameras.items()}
        self._bins = 1 + math.ceil(_bin(parameters.range_m))

    def ranges(
        self, observation: Observation, ego: EgoMotion | None = None, ground: GroundEstimate | None = None
    ) -> ObstacleRanges:
        """Ranges from the flow as far as it shows them with `ego`, and from the depth maps beyond.

        The range of sight always comes from the depth maps. ``ground``: below the drone; None: level, at the
        autopilot's height zero.
        """
        R_ned_body = observation.vehicle.R_ned_body.astype(np.float32)
        parts = [_NOTHING]
        for name, camera in observation.cameras.items():
            before = None if camera.flow is None else observation.previous
            origin = R_ned_body @ self._rig.cameras[name].T_body_camera.translation.astype(np.float32)
            if camera.depth is not None:
                places = (R_ned_body @ self._rays[name]) * camera.depth[_GRID, _GRID].ravel() + origin[:, None]
                relative = np.full(places.shape[1], self._parameters.range_sigma, np.float32)
                labels = camera.labels[_GRID, _GRID].ravel()
                obstacle = labels == 0
                if ego is not None and before is not None:
                    obstacle &= camera.depth[_GRID, _GRID].ravel() > self._flow_shows_m(name, ego)
                parts.append(self._about_level(_Points(places, relative, obstacle, labels != UNCLASSED)))
            if ego is not None and before is not None:
                moved = self._triangulations[name].points(ego, before, camera)
                parts.append(self._about_level(replace(moved, places=R_ned_body @ moved.places + origin[:, None])))
        return self._nearest(observation, _Points.concatenate(parts), ground)

    def _flow_shows_m(self, name: str, ego: EgoMotion) -> Float32Array:
        """(n,) metres: longest range at which the flow of this motion would show an obstacle in each pixel."""
        way = (ego.rotation.T @ ego.translation).astype(np.float32)
        baseline = np.linalg.norm(np.cross(way, self._rays[name].T), axis=1)
        shows = baseline / (_CERTAIN_SIGMAS * _FLOW_SIGMA_PX * self._pixel_angles[name])
        return np.where(baseline > _MIN_BASELINE_M, shows, 0.0).astype(np.float32)

    def _about_level(self, points: _Points) -> _Points:
        """The points in the drone's band of heights, and those that show the range of sight."""
        return points.where(self._in_band(points.places[2]) | _is_level(*points.places))

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
    order = np.lexsort((values, sectors))
    count = np.bincount(sectors, minlength=SECTORS)
    first = np.cumsum(count) - count
    middle = np.minimum(first + count // 2, max(len(values) - 1, 0))
    if not len(values):
        return np.zeros(SECTORS)
    return np.where(count > 0, values[order][middle], 0.0).astype(float)


class _Triangulation:
    """Triangulates background points between two images of one camera."""

    def __init__(self, camera: RigCamera) -> None:
        self._camera = camera
        width, height = camera.camera.size
        rows = slice(_STRIDE_PX // 2, height, 2 * _STRIDE_PX)  # every second row of `grid_pixels`
        self._grid = rows, slice(_STRIDE_PX // 2, width, _STRIDE_PX)
        row, column = np.mgrid[self._grid].reshape(2, -1)
        self._pixels = np.stack([column, row], axis=1) + 0.5
        self._rays = camera.camera.rays(self._pixels)
        self._down_body = camera.T_body_camera.rotation @ self._rays.T

    def points(self, ego: EgoMotion, before: Observation, now: CameraObservation) -> _Points:
        """From the flow and the drone's own motion, in body axes, relative to the camera.

        Pixels whose inverse range is not well above that of the sky are left out.
        """
        assert now.flow is not None
        mounted, lens = self._camera.T_body_camera, self._camera.camera
        between = mounted.inverse() @ RigidTransform(ego.rotation, ego.translation) @ mounted
        near_level = np.abs(before.vehicle.R_ned_body[2] @ self._down_body) <= _STEEPEST
        start, p = self._pixels[near_level], self._rays[near_level]
        end = start + now.flow[self._grid].reshape(-1, 2)[near_level]
        labels_before = before.cameras[self._camera.name].labels[self._grid].ravel()
        still = lens.in_image(end) & (labels_before[near_level] == 0)
        end, p = end[still], p[still]
        column, row = end.astype(np.int64).T
        background = now.labels[row, column] == 0
        end, p = end[background], p[background]
        ray = lens.rays(end)
        inverse, baseline = inverse_ranges_of_rays(p, ray, between)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = _FLOW_SIGMA_PX * lens.pixel_angle(ray) / baseline
            certain = (baseline > _MIN_BASELINE_M) & (inverse > _CERTAIN_SIGMAS * sigma)
        places = mounted.rotation @ (ray[certain] / inverse[certain, None]).T
        relative = (sigma[certain] / inverse[certain]).astype(np.float32)
        every = np.ones(len(relative), bool)
        return _Points(places.astype(np.float32), relative, every, every)
