"""Matches lifted to pairs of points: a camera moves towards a slanted wall whose every depth is known."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.messages import Float32Array, FloatArray, IntArray
from flockd.flight.geometry import (
    PointPairs,
    RangeMap,
    RigCamera,
    grid_pixels,
    lift_matches,
)

from .synthetic_world import four_camera_rig

CAMERA = four_camera_rig((96, 128), focal=50.0).cameras["right"]
SIZE = CAMERA.camera.size
# The wall n . p = d, in the camera's axes; the camera steps 0.4 m ahead, straight along its optical axis.
NORMAL = np.array([0.3, -0.1, 1.0])
DISTANCE = 6.0
STEP = np.array([0.0, 0.0, 0.4])


def wall_depth(pixels: FloatArray, distance: float) -> FloatArray:
    depth: FloatArray = distance / (CAMERA.camera.unproject(pixels, np.ones(len(pixels))) @ NORMAL)
    return depth


def wall_maps() -> tuple[Float32Array, RangeMap, RangeMap]:
    """Flow and both depth maps."""
    pixels = grid_pixels(SIZE, 1)
    depth = wall_depth(pixels, DISTANCE)
    after = CAMERA.camera.project(CAMERA.camera.unproject(pixels, depth) - STEP)
    shape = (SIZE[1], SIZE[0])
    return (
        (after - pixels).reshape(*shape, 2).astype(np.float32),
        RangeMap(depth.reshape(shape).astype(np.float32)),
        RangeMap(wall_depth(pixels, DISTANCE - STEP @ NORMAL).reshape(shape).astype(np.float32)),
    )


def no_labels() -> IntArray:
    return np.zeros((SIZE[1], SIZE[0]), dtype=np.int64)


def lift(
    pixels: FloatArray,
    maps: tuple[Float32Array, RangeMap, RangeMap],
    labels: tuple[IntArray, IntArray] | None = None,
    camera: RigCamera = CAMERA,
    max_depth_m: float = 40.0,
) -> PointPairs:
    return lift_matches(camera, pixels, *maps, *(labels or (no_labels(), no_labels())), max_depth_m=max_depth_m)


def test_both_ends_lie_on_the_wall_and_are_one_step_apart() -> None:
    pairs = lift(grid_pixels(SIZE, 5), wall_maps())
    assert len(pairs) > 200
    # Seen from the right camera the step is along the body's y axis. The depth is that of a pixel's centre, up to
    # half a pixel away.
    moved, depth_m = pairs.previous - pairs.current, np.linalg.norm(pairs.current, axis=1)
    assert (np.linalg.norm(moved - [0.0, 0.4, 0.0], axis=1) < 0.015 * depth_m).all()
    assert moved.mean(axis=0) == pytest.approx([0.0, 0.4, 0.0], abs=0.005)
    in_camera = CAMERA.T_body_camera.inverse().apply(pairs.previous)
    assert np.allclose(in_camera @ NORMAL, DISTANCE, atol=1e-5)
    assert set(pairs.camera_names.tolist()) == {"right"}
    assert np.allclose(CAMERA.pixels_of_points(pairs.current), pairs.pixels_current, atol=1e-6)
    assert np.allclose(CAMERA.pixels_of_points(pairs.previous), pairs.pixels_previous, atol=1e-6)


def test_a_match_with_an_end_on_a_drone_is_dropped() -> None:
    labels, labels_after = no_labels(), no_labels()
    labels[:, 48:], labels_after[:, 60:] = 2, 2
    everywhere, pairs = (lift(grid_pixels(SIZE, 3), wall_maps(), on) for on in (None, (labels, labels_after)))
    background = (everywhere.pixels_previous[:, 0] < 48) & (everywhere.pixels_current[:, 0] < 60)
    assert 0 < np.count_nonzero(background) < len(everywhere)
    assert np.array_equal(pairs.pixels_current, everywhere.pixels_current[background])


@pytest.mark.parametrize("which", ["before", "after"])
@pytest.mark.parametrize("depth", [np.nan, np.inf, 0.0, -1.0, 9.5])
def test_a_depth_that_says_nothing_drops_the_pair(which: str, depth: float) -> None:
    flow, before, after = wall_maps()
    {"before": before, "after": after}[which][:, :40] = depth
    pairs = lift(grid_pixels(SIZE, 3), (flow, before, after), max_depth_m=9.0)
    ends = pairs.pixels_previous if which == "before" else pairs.pixels_current
    assert len(pairs) > 100
    assert (ends[:, 0] >= 40.0).all()
    assert np.isfinite(pairs.current).all()


def test_between_two_surfaces_the_nearer_pixel_decides() -> None:
    # The second image's left part is at 3 m, its right part at 10 m, with the border at u = 50.
    shape = (SIZE[1], SIZE[0])
    after = RangeMap(np.where(np.arange(SIZE[0]) < 50, 3.0, 10.0).astype(np.float32) * np.ones(shape, np.float32))
    before = RangeMap(np.full(shape, 5.0, dtype=np.float32))
    for end, expected in ((49.8, 3.0), (50.2, 10.0)):
        flow = np.zeros((*shape, 2), dtype=np.float32)
        flow[..., 0] = end - 48.5
        pairs = lift(np.array([[48.5, 64.5]]), (flow, before, after))
        in_camera = CAMERA.T_body_camera.inverse().apply(pairs.current)
        assert np.linalg.norm(in_camera) == pytest.approx(expected)


def test_a_map_of_another_size_is_refused() -> None:
    flow, before, _ = wall_maps()
    with pytest.raises(ValueError, match="'right' is 96x128, but its depth map is 48x64"):
        lift(grid_pixels(SIZE, 8), (flow, before, RangeMap(np.ones((64, 48), dtype=np.float32))))
