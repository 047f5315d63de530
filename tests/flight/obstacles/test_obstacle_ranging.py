"""Ranges from depth maps that are made by geometry: a trunk, a wall, the ground, the sky, a neighbour."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import SECTORS, UNCLASSED, EgoMotion, FloatArray, GroundEstimate, ObstacleRanges
from flockd.flight.geometry import (
    RangeMap,
    Rig,
    RigCamera,
    ZMap,
    build_rig,
    grid_pixels,
    ground_inverse_depth,
    range_map,
    rotation_from_euler,
)
from flockd.flight.obstacles import ObstacleRanging
from flockd.flight.perception import Observation
from flockd.flight.perception.observation import CameraObservation
from tests.flight.geometry.synthetic_world import four_camera_rig
from tests.make import scenario, vehicle

RIG = build_rig(scenario(name="square").drone.rig)
PARAMETERS = ObstacleParameters(range_m=12.0, range_sigma=0.1, min_pixels=4)
RANGING = ObstacleRanging(RIG, PARAMETERS)
HEIGHT_M = 3.0
SKY_M = 80.0
LEVEL = np.eye(3)
EAST = SECTORS // 4


def towards_trunk(origin: FloatArray, rays: FloatArray, place: tuple[float, float], radius: float) -> FloatArray:
    """(n,) factors of the rays (n, 3) up to an upright cylinder without ends: a quadratic equation."""
    offset = origin[:2] - place
    a, b, c = np.sum(rays[:, :2] ** 2, axis=1), rays[:, :2] @ offset, offset @ offset - radius**2
    square = b**2 - a * c
    ahead = np.where(square > 0, (-b - np.sqrt(np.maximum(square, 0.0))) / a, np.inf)
    return np.where(ahead > 0, ahead, np.inf)


def blank(
    camera: RigCamera, depth: FloatArray | RangeMap, flow: FloatArray | None = None, **fields: Any
) -> CameraObservation:
    """What a camera shows of depths of its pixels, in a row."""
    width, height = camera.camera.size
    moved = None if flow is None else flow.reshape(height, width, 2).astype(np.float32)
    shown: dict[str, Any] = {"image": np.zeros((height, width, 3), np.uint8), "flow": moved}
    shown["labels"] = np.zeros((height, width), np.uint8)
    return CameraObservation(depth=RangeMap(depth.reshape(height, width).astype(np.float32)), **shown | fields)


def rays_of(camera: RigCamera, R_ned_body: FloatArray = LEVEL) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each pixel: where it is, where the rays begin, m NED from the drone, and how they go."""
    pixels = grid_pixels(camera.camera.size, 1)
    rays = camera.camera.unproject(pixels, np.ones(len(pixels))) @ (R_ned_body @ camera.T_body_camera.rotation).T
    return pixels, R_ned_body @ camera.T_body_camera.translation, rays


def seen(
    *trunks: tuple[float, float, float],
    R_ned_body: FloatArray = LEVEL,
    rig: Rig = RIG,
    labels: int = 0,
    of_label: tuple[float, float, float] = (1e6, 0.0, 0.1),
    down_m: tuple[float, float] = (-math.inf, math.inf),
    parameters: ObstacleParameters = PARAMETERS,
) -> ObstacleRanges:
    """Over flat ground under a clear sky, from the middle of the world.

    `of_label`: a trunk that is masked so; `down_m`: of trunks only what is so far below the drone.
    """
    cameras = {}
    for name, camera in rig.cameras.items():
        _, origin, rays = rays_of(camera, R_ned_body)
        depth = np.where(rays[:, 2] > 0, (HEIGHT_M - origin[2]) / np.maximum(rays[:, 2], 1e-9), SKY_M)
        for north, east, radius in trunks:
            trunk = towards_trunk(origin, rays, (north, east), radius)
            down = origin[2] + np.where(np.isfinite(trunk), trunk, 0.0) * rays[:, 2]
            depth = np.where((down >= down_m[0]) & (down <= down_m[1]), np.minimum(depth, trunk), depth)
        masked = towards_trunk(origin, rays, of_label[:2], of_label[2])
        mask = np.where(masked < depth, labels, 0).astype(np.uint8).reshape(camera.camera.size[::-1])
        cameras[name] = blank(camera, np.minimum(depth, masked), labels=mask)
    ranging = ObstacleRanging(rig, parameters)
    return ranging.ranges(Observation(2.0, vehicle(2.0, HEIGHT_M, R_ned_body=R_ned_body), cameras, (), None))


def found(ranges: ObstacleRanges) -> dict[int, float]:
    return {int(k): float(ranges.range_m[k]) for k in np.flatnonzero(np.isfinite(ranges.range_m))}


def test_over_open_ground_nothing_stands_and_all_is_seen() -> None:
    ranges = seen()
    assert found(ranges) == {}
    np.testing.assert_array_equal(ranges.seen_m, 12.0)
    np.testing.assert_array_equal(ranges.sigma_m, 0.0)
    assert ranges.time_s == 2.0


@pytest.mark.parametrize(("azimuth_deg", "away_m"), [(0.0, 3.0), (90.0, 8.0), (130.0, 1.5), (245.0, 6.0)])
def test_a_trunk_is_seen_where_it_stands(azimuth_deg: float, away_m: float) -> None:
    azimuth = math.radians(azimuth_deg)
    ranges = seen((away_m * math.cos(azimuth), away_m * math.sin(azimuth), 0.15))
    sector = round(azimuth_deg / 5)
    assert ranges.range_m[sector] == pytest.approx(away_m - 0.15, rel=0.06)
    assert ranges.sigma_m[sector] == pytest.approx(0.1 * ranges.range_m[sector])
    assert ranges.seen_m[sector] == ranges.range_m[sector]
    half_deg = math.degrees(math.asin(0.15 / away_m)) + 5.0
    assert all(abs(5.0 * k - azimuth_deg) <= half_deg for k in found(ranges))


def test_a_stump_whose_top_no_camera_shows_stands_in_the_way() -> None:
    """The top of what ends a metre below the drone may be too thin to be seen; what hangs a metre higher is passed."""
    assert seen((3.0, 0.0, 0.15), down_m=(1.0, 3.0)).range_m[0] == pytest.approx(2.85, rel=0.06)
    assert found(seen((3.0, 0.0, 0.15), down_m=(1.6, 3.0))) == {}
    assert found(seen((3.0, 0.0, 0.15), down_m=(-3.0, -1.0))) == {}


@pytest.mark.parametrize("label", [1, UNCLASSED])
def test_a_neighbour_is_no_obstacle(label: int) -> None:
    ranges = seen(of_label=(0.0, 4.0, 0.4), labels=label)
    assert found(ranges) == {}
    seen_m = float(ranges.seen_m[EAST])  # it hides what is behind it; what is nowhere shown is not seen
    assert seen_m == (pytest.approx(3.6, rel=0.1) if label == 1 else pytest.approx(0.0))


def test_what_no_camera_shows_is_not_seen() -> None:
    front = Rig({"front": RIG.cameras["front"]})
    ranges = seen((4.0, 0.0, 0.2), (-4.0, 0.0, 0.2), rig=front)
    assert set(found(ranges)) <= {0, 1, SECTORS - 1}
    assert ranges.seen_m[SECTORS // 2] == 0.0
    assert ranges.seen_m[5] == 12.0


def flown(
    trunk: tuple[float, float, float],
    way: FloatArray,
    R_ned_body: FloatArray = LEVEL,
    *,
    top_m: float = -math.inf,
    depth_map_m: float = SKY_M,
) -> Observation:
    """Two steps beside a trunk, with the flow between them that geometry says; level, and looking north at first.

    Every depth map says ``depth_map_m`` everywhere, as of a network that knows no trunks.
    """
    before, now = {}, {}
    for name, camera in RIG.cameras.items():
        pixels, origin, rays = rays_of(camera)
        said = np.full(len(pixels), depth_map_m)
        ground = np.where(rays[:, 2] > 0, (HEIGHT_M - origin[2]) / np.maximum(rays[:, 2], 1e-9), 1e4)
        stands = towards_trunk(origin, rays, trunk[:2], trunk[2])
        is_trunk = origin[2] + np.where(np.isfinite(stands), stands, 0.0) * rays[:, 2] >= top_m
        depth = np.where(is_trunk, np.minimum(ground, stands), ground)
        points = (origin + rays * depth[:, None] - way) @ R_ned_body  # in the body now
        flow = camera.camera.project((points - origin) @ camera.T_body_camera.rotation) - pixels
        before[name], now[name] = blank(camera, said), blank(camera, said, flow)
    first = Observation(0.0, vehicle(0.0, HEIGHT_M), before, (), None)
    return Observation(0.5, vehicle(0.5, HEIGHT_M - way[2], R_ned_body=R_ned_body), now, (), first)


@pytest.mark.parametrize(
    ("trunk", "way", "yaw_deg", "top_m"),
    [
        ((3.0, -0.8, 0.3), (0.5, 0.3, 0.05), 8.0, -math.inf),
        ((3.0, 0.0, 0.2), (0.7, 0.0, 0.0), 0.0, 0.9),  # straight ahead, and all of it lower
    ],
)
def test_what_depth_does_not_show_the_flow_does(
    trunk: tuple[float, float, float], way: FloatArray, yaw_deg: float, top_m: float
) -> None:
    """The drone flies 0.6 m and yaws; depth is that of the sky, as of a network that knows no trunks."""
    way, R_ned_body = np.array(way), rotation_from_euler(0.0, 0.0, math.radians(yaw_deg))
    observation = flown(trunk, way, R_ned_body, top_m=top_m)
    assert found(RANGING.ranges(observation)) == {}
    ranges = RANGING.ranges(observation, EgoMotion(R_ned_body, way, 0.5, 100, 100, 0.01))
    offset = np.array(trunk[:2]) - way[:2]
    sector = round(math.degrees(math.atan2(offset[1], offset[0])) / 5) % SECTORS
    away_m = float(np.hypot(*offset)) - trunk[2]
    assert ranges.range_m[sector] == pytest.approx(away_m, rel=0.07)
    assert 0.0 < ranges.sigma_m[sector] < 0.2 * away_m
    assert all((k - sector + 3) % SECTORS <= 6 for k in found(ranges))


@pytest.mark.parametrize(("way_m", "sectors"), [(0.5, 3), (0.15, 7), (0.05, SECTORS // 4), (0.0, SECTORS // 4)])
def test_a_depth_map_counts_where_the_flow_could_not_show_what_it_says(way_m: float, sectors: int) -> None:
    """A depth map that says 4 m everywhere, and a flow that shows nothing: around the way, the shorter the wider.

    A pixel spans at most 1/222; five of them are a parallax that is certain. Sine of the angle: 4 m 5 / 222 / way.
    """
    north = EgoMotion(LEVEL, np.array([way_m, 0.0, 0.0]), 0.5, 100, 100, 0.01)
    observation = flown((50.0, 50.0, 0.1), north.translation, depth_map_m=4.0)
    assert len(found(RANGING.ranges(observation))) == SECTORS
    ranges = RANGING.ranges(observation, north)
    off = np.minimum(np.arange(SECTORS) % (SECTORS // 2), -np.arange(SECTORS) % (SECTORS // 2))
    assert max(off[k] for k in found(ranges)) in {min(sectors + by, SECTORS // 4) for by in (-1, 0, 1)}
    assert all(k in found(ranges) for k in np.flatnonzero(off <= sectors - 2))
    np.testing.assert_allclose(ranges.range_m[0], 4.0, rtol=0.06)
    np.testing.assert_allclose(ranges.seen_m[SECTORS // 8], 4.0, rtol=0.06)


def test_a_hillside_ahead_is_ground_and_no_obstacle() -> None:
    """It rises to the drone's height, and ranges to the ground have told its slope."""
    rig, height_m, slope, cameras = four_camera_rig(), 2.5, (0.15, 0.0), {}
    for name, camera in rig.cameras.items():
        inverse = ground_inverse_depth(camera, LEVEL, height_m, slope=slope)
        depth = range_map(ZMap((1.0 / np.maximum(inverse, 1e-3)).astype(np.float32)), camera.camera)
        cameras[name] = blank(camera, depth)
    seen_hill = Observation(0.0, vehicle(height_m=height_m), cameras, (), None)
    ranging = ObstacleRanging(rig, ObstacleParameters())
    assert np.isfinite(ranging.ranges(seen_hill).range_m[0]), "of level ground below, the hill would stand on it"
    told = GroundEstimate(height_m, np.array(slope), "range_finder")
    assert not np.isfinite(ranging.ranges(seen_hill, ground=told).range_m).any()
