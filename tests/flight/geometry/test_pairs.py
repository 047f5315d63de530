"""Matches lifted to pairs of points: a camera moves towards a slanted wall whose every depth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import UNCLASSED, EgoMotion, Float32Array, FloatArray, IntArray
from flockd.flight.geometry import (
    PointPairs,
    RangeMap,
    RigCamera,
    RigidTransform,
    estimate_neighbour_motion,
    grid_pixels,
    label_pixels,
    lift_matches,
    rotation_from_euler,
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
    # Between the border and the outermost pixel centres the depth is held, so there it is a little off.
    u, v = pairs.pixels_current.T
    pairs = pairs.select((u > 0.5) & (u < SIZE[0] - 0.5) & (v > 0.5) & (v < SIZE[1] - 0.5))
    assert len(pairs) > 200
    # Seen from the right camera the step is along the body's y axis. Sub-pixel ends meet the slanted wall too.
    # With 50 px a radian a plane's inverse range bends by 6e-5 between two pixels: 0.5 mm at 10 m.
    assert np.allclose(pairs.previous - pairs.current, [0.0, 0.4, 0.0], atol=5e-4)
    in_camera = CAMERA.T_body_camera.inverse().apply(pairs.previous)
    assert np.allclose(in_camera @ NORMAL, DISTANCE, atol=1e-5)
    assert set(pairs.camera_names.tolist()) == {"right"}
    assert np.allclose(CAMERA.pixels_of_points(pairs.current), pairs.pixels_current, atol=1e-6)
    assert np.allclose(CAMERA.pixels_of_points(pairs.previous), pairs.pixels_previous, atol=1e-6)


def test_ends_outside_either_image_are_dropped() -> None:
    outward = lift(np.array([[0.5, 64.5], [95.5, 0.5], [-3.0, 5.0], [48.5, 64.5]]), wall_maps())
    # Moving ahead, the border's pixels leave the image; the one in the middle stays.
    assert outward.pixels_previous.tolist() == [[48.5, 64.5]]


def test_a_match_keeps_its_class_only_where_both_ends_agree() -> None:
    labels, labels_after = no_labels(), no_labels()
    labels[:, 48:] = 2
    labels_after[:, 60:] = 2
    pairs = lift(grid_pixels(SIZE, 3), wall_maps(), (labels, labels_after))
    left, right = pairs.pixels_previous[:, 0] < 48, pairs.pixels_current[:, 0] >= 60
    assert (left | right).all()
    assert set(pairs.labels[left].tolist()) == {0}
    assert set(pairs.labels[right].tolist()) == {2}
    assert pairs.labels.dtype == np.int64


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


def test_nothing_left_is_an_empty_set_and_not_an_error() -> None:
    pairs = lift(np.array([[48.5, 64.5]]), wall_maps(), max_depth_m=1.0)
    assert len(pairs) == 0
    assert pairs.previous.shape == (0, 3)


def test_a_map_of_another_size_is_refused() -> None:
    flow, before, _ = wall_maps()
    with pytest.raises(ValueError, match="'right' is 96x128, but its depth map is 48x64"):
        lift(grid_pixels(SIZE, 8), (flow, before, RangeMap(np.ones((64, 48), dtype=np.float32))))


def test_the_grid_is_of_pixel_centres_inside_the_image() -> None:
    assert grid_pixels((4, 3), 1)[:5].tolist() == [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [3.5, 0.5], [0.5, 1.5]]
    assert grid_pixels((10, 5), 4).tolist() == [[2.5, 2.5], [6.5, 2.5]]


def test_label_pixels_are_spread_over_the_whole_patch() -> None:
    labels = np.zeros((20, 30), dtype=np.int64)
    labels[5:15, 10:20] = 7
    labels[0, 0], labels[19, 28:] = 3, UNCLASSED
    assert {label: len(pixels) for label, pixels in label_pixels(labels, 1000).items()} == {3: 1, 7: 100}
    assert label_pixels(labels, 10)[3].tolist() == [[0.5, 0.5]]
    few = label_pixels(labels, 10)[7]
    assert len(few) == 10
    assert few.min(axis=0).tolist()[1] == 5.5
    assert few.max(axis=0).tolist()[1] == 14.5
    assert ((few - 0.5) % 1.0 == 0.0).all()


# A neighbour's motion (Eq. 22-37) where both drones' motions are known.


RIG = four_camera_rig()
OWN_STEP = RigidTransform(rotation_from_euler(0.01, -0.02, 0.05), np.array([0.45, 0.1, -0.02]))  # F to C
EGO = EgoMotion(OWN_STEP.rotation, OWN_STEP.translation, interval_s=0.5, pairs=100, inliers=100, threshold_m=0.01)
INTERVAL_S = 0.5


def neighbour_pairs(
    centre_c: FloatArray, turn: FloatArray, shift_c: FloatArray, random: np.random.Generator
) -> tuple[PointPairs, FloatArray]:
    """Points on a 0.6 m box that turns about its centre and is shifted, in C, and each camera's view of them; and the
    box's corners at the end, in F."""
    half = np.array([0.3, 0.3, 0.1])
    body = np.concatenate([random.uniform(-half, half, (300, 3)), [half, -half]])
    previous = body + centre_c
    current = OWN_STEP.inverse().apply(body @ turn.T + centre_c + shift_c)
    before, after = RIG.pixels_of(previous), RIG.pixels_of(current)
    several = []
    for name in RIG.cameras:
        seen = np.isfinite(before[name][:, 0]) & np.isfinite(after[name][:, 0])
        several.append(
            PointPairs(
                previous=previous[seen],
                current=current[seen],
                labels=np.full(int(seen.sum()), 1),
                camera_names=np.full(int(seen.sum()), name),
                pixels_previous=before[name][seen],
                pixels_current=after[name][seen],
            )
        )
    return PointPairs.concatenate(several), current


def test_a_neighbours_motion_is_freed_of_the_own_one() -> None:
    shift = np.array([0.3, -0.2, 0.05])
    turn = Rotation.from_euler("ZYX", [8.0, 3.0, -2.0], degrees=True).as_matrix()
    pairs, current = neighbour_pairs(np.array([5.0, 0.5, -0.4]), turn, shift, np.random.default_rng(0))
    motion = estimate_neighbour_motion(pairs, EGO, GeometryParameters())
    assert np.allclose(motion.rotation, turn, atol=1e-6)
    # The mean of the points moves by the shift and by what the turn does to the mean's small offset from the centre.
    mean_offset = pairs.previous.mean(axis=0) - [5.0, 0.5, -0.4]
    assert np.allclose(motion.translation, shift + turn @ mean_offset - mean_offset, atol=1e-9)
    assert np.allclose(motion.velocity, motion.translation / INTERVAL_S)
    assert np.allclose(motion.centre, (current.min(axis=0) + current.max(axis=0)) / 2.0)
    assert motion.pairs == motion.inliers == len(pairs)


@pytest.mark.parametrize("outlier_share", [0.3, 0.6])
def test_background_behind_the_neighbour_neither_drags_nor_widens_it(outlier_share: float) -> None:
    random = np.random.default_rng(3)
    shift = np.array([0.3, 0.1, 0.0])
    pairs, current = neighbour_pairs(np.array([6.0, 0.0, 0.0]), np.eye(3), shift, random)
    wrong = random.random(len(pairs)) < outlier_share
    behind = pairs.previous * random.uniform(1.3, 2.0, (len(pairs), 1))
    stands = OWN_STEP.inverse().apply(behind)
    spoilt = replace(
        pairs,
        previous=np.where(wrong[:, None], behind, pairs.previous),
        current=np.where(wrong[:, None], stands, pairs.current),
    )
    motion = estimate_neighbour_motion(spoilt, EGO, GeometryParameters())
    if outlier_share < 0.5:
        assert motion.inliers == np.count_nonzero(~wrong)
        assert np.allclose(motion.velocity, shift / INTERVAL_S, atol=1e-6)
        assert np.allclose(motion.centre, (current[~wrong].min(axis=0) + current[~wrong].max(axis=0)) / 2.0)
    else:
        # The larger set that moves as one wins, and it is the background.
        assert np.allclose(motion.velocity, 0.0, atol=1e-6)


def test_too_few_points_are_no_estimate() -> None:
    pairs, _ = neighbour_pairs(np.array([5.0, 0.0, 0.0]), np.eye(3), np.zeros(3), np.random.default_rng(4))
    with pytest.raises(ValueError, match="fewer than three pairs"):
        estimate_neighbour_motion(pairs.select(np.array([0, 1])), EGO, GeometryParameters())
