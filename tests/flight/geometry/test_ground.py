"""The ground's inverse depth against geometry done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flockd.flight.geometry import (
    GroundSamples,
    RigidTransform,
    fit_ground,
    ground_inverse_depth,
    inverse_ranges_of_rays,
)

from .synthetic_world import four_camera_rig

RIG = four_camera_rig()
LEVEL = np.eye(3)


def test_a_level_camera_sees_the_ground_under_45_degrees_as_far_ahead_as_it_is_high() -> None:
    inverse = ground_inverse_depth(RIG.cameras["front"], LEVEL, 4.0)
    assert inverse.shape == (640, 480)
    assert inverse.dtype == np.float32
    # Row 541 has its centre 221.5 px below the principal point: z = 4 m * 222 / 221.5, in every column.
    assert np.allclose(inverse[541], 221.5 / 222.0 / 4.0, rtol=1e-5)
    assert (inverse[:320] == 0.0).all()  # the sky
    assert (inverse[320:] > 0.0).all()


@pytest.mark.fault("ground-reached")
def test_a_camera_on_the_ground_and_a_stride_that_does_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'front'.*ground"):
        ground_inverse_depth(RIG.cameras["front"], LEVEL, 0.0)
    with pytest.raises(ValueError, match=r"7.*480x640"):
        ground_inverse_depth(RIG.cameras["front"], LEVEL, 4.0, stride=7)


def test_a_slope_is_ground_that_rises_by_so_much_for_each_metre() -> None:
    """Against points of a hillside 4 m below the drone that rises by 10 % to the north and falls by 5 % to the east."""
    attitude = Rotation.from_euler("ZYX", [50.0, 4.0, -7.0], degrees=True)
    random, slope = np.random.default_rng(2), (0.1, -0.05)
    for camera in RIG.cameras.values():
        inverse = ground_inverse_depth(camera, attitude.as_matrix(), 4.0, slope=slope)
        level = random.uniform(-12.0, 12.0, (300, 2))
        points = np.column_stack([level, 4.0 - level @ np.array(slope)])  # NED, from the drone
        seen = camera.T_body_camera.inverse().apply(attitude.inv().apply(points))
        pixels = 222.0 * seen[:, :2] / seen[:, 2:] + np.array([240.0, 320.0])
        shown = (seen[:, 2] > 0.5) & (pixels >= 1.0).all(axis=1) & (pixels < [479.0, 639.0]).all(axis=1)
        assert shown.sum() > 10
        column, row = pixels[shown].astype(int).T
        np.testing.assert_allclose(inverse[row, column], 1.0 / seen[shown, 2], atol=0.003)  # half a pixel off


# The ground's plane from two images of it: points of a known hillside, projected by a separate camera model.


MOTION_NED = np.array([0.48, -0.1, 0.03])
Array = NDArray[np.float64]


def _hillside(rng: np.random.Generator, slope: Array, height_m: float, rough_m: float, trees: float) -> Array:
    """(n, 3) NED from the drone; some points stand above the ground."""
    level = rng.uniform(-14.0, 14.0, (6000, 2))
    down = height_m - level @ slope + rough_m * rng.standard_normal(6000)
    down -= (rng.random(6000) < trees) * rng.uniform(0.3, 3.0, 6000)
    return np.column_stack([level, down])


def _pixels(points: Array, camera: str, attitude: Rotation, place: Array) -> Array:
    mount = RIG.cameras[camera].T_body_camera
    body = attitude.inv().apply(points - place)
    seen = (body - mount.translation) @ mount.rotation
    pixels = 222.0 * seen[:, :2] / seen[:, 2:] + np.array([240.0, 320.0])
    inside = (seen[:, 2] > 0.3) & (pixels > 0.0).all(axis=1) & (pixels < [480.0, 640.0]).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _seen(points: Array, scale: float, noise_px: float, rng: np.random.Generator) -> GroundSamples:
    """Triangulated with a motion that is ``scale`` times too long."""
    before = Rotation.from_euler("ZYX", [0.4, 0.05, -0.02])
    now = Rotation.from_euler("ZYX", [0.45, -0.03, 0.04])
    motion = RigidTransform((before.inv() * now).as_matrix(), scale * before.inv().apply(MOTION_NED))
    parts = []
    for name, camera in RIG.cameras.items():
        first, second = (
            _pixels(points, name, attitude, place) for attitude, place in ((before, -MOTION_NED), (now, np.zeros(3)))
        )
        both = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
        start, end = first[both], second[both] + noise_px * rng.standard_normal((both.sum(), 2))
        between = camera.T_body_camera.inverse() @ motion @ camera.T_body_camera
        inverse, baseline = inverse_ranges_of_rays(camera.camera.rays(start), camera.camera.rays(end), between)
        R_ned_camera = now.as_matrix() @ camera.T_body_camera.rotation
        rays = np.column_stack([(end - [240.0, 320.0]) / 222.0, np.ones(len(end))])
        share = 1.0 / np.linalg.norm(rays, axis=1)  # of z in the range
        rays = share[:, None] * rays @ R_ned_camera.T
        offsets = np.tile(now.apply(camera.T_body_camera.translation), (len(end), 1))
        clear = (baseline > 0.08) & (inverse > 0.0)
        parts.append(GroundSamples(rays, inverse, offsets, 0.3 / 222.0 * share / np.maximum(baseline, 0.08))[clear])
    return GroundSamples.concatenate(parts)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.15, -0.05), (-0.08, 0.12)])
def test_the_height_comes_in_the_motions_unit_and_the_slope_as_it_is(slope: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    samples = _seen(_hillside(rng, np.array(slope), 5.0, 0.0, 0.0), 1.05, 0.0, rng)
    height, found = fit_ground(samples, 5.0, np.zeros(2), np.zeros(2))
    assert height == pytest.approx(5.25, rel=0.003)  # the mounts' 0.1 m have the true unit
    assert found == pytest.approx(slope, abs=0.003)


def test_rough_ground_with_things_on_it_and_noisy_flow() -> None:
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        samples = _seen(_hillside(rng, np.array([0.1, 0.05]), 5.0, 0.1, 0.2), 1.0, 0.3, rng)
        height, slope = fit_ground(samples, 5.2, np.array([0.05, 0.0]), np.zeros(2))
        errors.append([height / 5.0 - 1.0, *(slope - [0.1, 0.05])])
    assert np.abs(np.median(errors, axis=0)).max() < 0.01
    assert np.abs(errors).max() < 0.03


def test_a_wall_and_too_little_ground_are_no_plane() -> None:
    rng = np.random.default_rng(0)
    samples = _seen(_hillside(rng, np.zeros(2), 5.0, 0.0, 0.0), 1.0, 0.0, rng)
    with pytest.raises(ValueError, match="too little ground"):
        fit_ground(samples, 9.0, np.zeros(2), np.zeros(2))
    few = samples[np.arange(len(samples.inverse)) < 40]
    with pytest.raises(ValueError, match="too little ground"):
        fit_ground(few, 5.0, np.zeros(2), np.zeros(2))


def _bumpy(level: Array) -> Array:
    """How far down ground with waves of 0.25 m is, with a crest straight below the drone."""
    return np.asarray(5.0 - 0.25 * np.cos(2.0 * np.pi * level[:, 0] / 14.0) - 0.05 * level[:, 1])


def test_a_crest_below_the_drone_misleads_the_plane_and_the_places_that_were_measured_do_not() -> None:
    rng = np.random.default_rng(3)
    level = rng.uniform(-14.0, 14.0, (12_000, 2))
    samples = _seen(np.column_stack([level, _bumpy(level) - (rng.random(12_000) < 0.1)]), 0.96, 0.3, rng)
    behind = np.column_stack([-0.5 * np.arange(20), 0.1 * np.arange(20)])
    track = np.column_stack([behind, _bumpy(behind) * (1.0 + 0.015 * rng.standard_normal(20))])
    below, _ = fit_ground(samples, 4.75, np.zeros(2), np.zeros(2))
    assert abs(4.75 / below * 0.96 - 1.0) > 0.02, "else this shows nothing"
    height, slope = fit_ground(samples, 4.75, np.zeros(2), track[:, :2].mean(axis=0))
    measured_m = float((track[:, 2] + track[:, :2] @ slope).mean())
    assert measured_m / height == pytest.approx(1.0 / 0.96, rel=0.01)
