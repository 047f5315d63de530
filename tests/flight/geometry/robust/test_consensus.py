"""The default estimator of rigid motions: outliers, a second motion, errors that grow, honest covariance, no answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import RansacResult, RigidTransform, ransac_rigid, rotation_angle_deg

TURN = Rotation.from_euler("ZYX", [10.0, -3.0, 2.0], degrees=True)
SHIFT = np.array([0.5, -0.1, 0.05])
MOTION = RigidTransform(TURN.as_matrix(), SHIFT)


def around(random: np.random.Generator, count: int, nearest_m: float = 2.0, farthest_m: float = 15.0) -> FloatArray:
    """Points all around, from near to far."""
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points: FloatArray = directions * random.uniform(nearest_m, farthest_m, (count, 1))
    return points


def disturbed(
    random: np.random.Generator, source: FloatArray, noise_m: float, outliers: float
) -> tuple[FloatArray, BoolArray]:
    """Where the motion takes the points, with noise, and a share of them anywhere within 3 m of it."""
    target = MOTION.apply(source) + random.normal(0.0, noise_m, source.shape)
    wrong = random.random(len(source)) < outliers
    target[wrong] += random.uniform(-3.0, 3.0, (int(wrong.sum()), 3))
    return target, wrong


def error(result: RansacResult) -> tuple[float, float]:
    """Degrees and metres."""
    off = result.transform.rotation @ MOTION.rotation.T
    return rotation_angle_deg(off), float(np.linalg.norm(result.transform.translation - SHIFT))


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6, 0.75])
def test_exact_pairs_among_outliers_are_all_found_and_nothing_else(outliers: float) -> None:
    for seed in range(5):
        random = np.random.default_rng(seed)
        source = random.uniform(-10.0, 10.0, (1000, 3))
        target, wrong = disturbed(random, source, 0.0, outliers)
        result = ransac_rigid(source, target, seed=seed)
        assert np.array_equal(result.inliers, ~wrong)
        assert np.allclose(result.transform.rotation, MOTION.rotation, atol=1e-9)
        assert np.allclose(result.transform.translation, SHIFT, atol=1e-8)


def test_nine_outliers_in_ten_are_no_failure() -> None:
    for seed in range(40):
        random = np.random.default_rng(seed)
        source = around(random, 5000)
        target, _ = disturbed(random, source, 0.05, 0.9)
        degrees, metres = error(ransac_rigid(source, target, seed=seed, min_inlier_ratio=0.05))
        assert degrees < 1.0
        assert metres < 0.05


@pytest.mark.parametrize("noise_m", [0.003, 0.03, 0.3])
def test_the_error_is_what_least_squares_on_the_true_pairs_leaves_at_any_size_of_noise(noise_m: float) -> None:
    # n pairs with noise sigma leave sigma sqrt(3 / n) of translation: 1.7 % of sigma for 2,000 x 0.5 of them at ranges
    # whose leverage is small; Tukey's weights cost 5 %, chance a factor of two.
    random = np.random.default_rng(1)
    source = around(random, 2000)
    target, _ = disturbed(random, source, noise_m, 0.5)
    degrees, metres = error(ransac_rigid(source, target))
    assert metres < 0.15 * noise_m
    assert degrees < np.degrees(0.15 * noise_m / 5.0)


def test_of_two_motions_the_one_with_more_pairs_is_found() -> None:
    for seed in range(10):
        random = np.random.default_rng(seed)
        source = around(random, 2000)
        target = MOTION.apply(source)
        other = random.random(2000) < 0.4
        second = RigidTransform(Rotation.from_rotvec([0.2, 0.1, -0.3]).as_matrix(), np.array([-1.0, 0.4, 0.2]))
        target[other] = second.apply(source[other])
        target += random.normal(0.0, 0.03, source.shape)
        result = ransac_rigid(source, target, seed=seed)
        assert error(result)[1] < 0.02
        assert result.inliers[~other].mean() > 0.97
        assert result.inliers[other].mean() < 0.05


def test_near_pairs_count_more_where_errors_grow_with_the_range() -> None:
    """As those of stereo, with its square: fitted with equal weights the far ones spoil the translation."""
    better = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        source = around(random, 3000, 2.0, 30.0)
        noise = 0.002 * np.linalg.norm(source, axis=1, keepdims=True) ** 2
        target = MOTION.apply(source) + random.normal(size=source.shape) * noise
        result = ransac_rigid(source, target, seed=seed)
        plain = ransac_rigid(source, target, seed=seed, method="paper")
        better.append(error(result)[1] / error(plain)[1])
    assert np.median(better) < 0.5


@pytest.mark.parametrize(("count", "outliers"), [(60, 0.0), (300, 0.3), (2000, 0.6)])
def test_the_covariance_is_honest(count: int, outliers: float) -> None:
    """The squared error in units of its covariance has the mean of a chi-square of six: 6, with 200 draws +-0.25."""
    squares = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        source = around(random, count)
        target, _ = disturbed(random, source, 0.05, outliers)
        result = ransac_rigid(source, target, seed=seed)
        assert result.covariance is not None
        turn = Rotation.from_matrix(result.transform.rotation @ MOTION.rotation.T).as_rotvec()
        shift = result.transform.translation - Rotation.from_rotvec(turn).apply(SHIFT)
        off = np.concatenate([turn, shift])
        squares.append(off @ np.linalg.solve(result.covariance, off))
    assert 0.5 < np.mean(squares) / 6.0 < 2.0


def test_moving_all_points_moves_the_answer_with_them() -> None:
    random = np.random.default_rng(3)
    source = around(random, 500)
    target, _ = disturbed(random, source, 0.02, 0.3)
    found = ransac_rigid(source, target).transform
    moved = RigidTransform(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([4.0, -2.0, 1.0]))
    after = ransac_rigid(source, moved.apply(target)).transform
    assert np.allclose((moved @ found).rotation, after.rotation, atol=1e-3)
    assert np.allclose((moved @ found).translation, after.translation, atol=5e-3)


def test_back_and_forth_are_inverse_to_each_other() -> None:
    random = np.random.default_rng(4)
    source = around(random, 500)
    target, _ = disturbed(random, source, 0.02, 0.3)
    there, back = ransac_rigid(source, target).transform, ransac_rigid(target, source).transform
    assert rotation_angle_deg(there.rotation @ back.rotation) < 0.1
    assert np.linalg.norm(there.apply(back.translation[None])) < 0.02


@pytest.mark.parametrize("half_turn", [False, True])
def test_large_rotations_and_points_on_a_plane(half_turn: bool) -> None:
    random = np.random.default_rng(5)
    motion = RigidTransform(Rotation.from_rotvec([0.0, 0.0, np.pi if half_turn else 2.0]).as_matrix(), SHIFT)
    source = random.uniform(-10.0, 10.0, (1000, 3)) * [1.0, 1.0, 0.0]
    target = motion.apply(source) + random.normal(0.0, 0.02, source.shape)
    found = ransac_rigid(source, target).transform
    assert rotation_angle_deg(found.rotation @ motion.rotation.T) < 0.1
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_one_seed_gives_one_result_and_leaves_its_input_alone() -> None:
    random = np.random.default_rng(7)
    source = around(random, 900)
    target, _ = disturbed(random, source, 0.1, 0.3)
    kept = source.copy(), target.copy()
    first, second = (ransac_rigid(source, target, seed=1) for _ in range(2))
    assert np.array_equal(first.transform.rotation, second.transform.rotation)
    assert np.array_equal(first.inliers, second.inliers)
    assert np.array_equal(source, kept[0])
    assert np.array_equal(target, kept[1])


def test_unrelated_points_get_no_motion_rather_than_a_junk_one() -> None:
    for seed in range(5):
        source, target = np.random.default_rng(seed).uniform(-20.0, 20.0, (2, 400, 3))
        with pytest.raises(ValueError, match="no motion"):
            ransac_rigid(source, target)


def test_a_small_cloud_of_few_pairs_is_enough() -> None:
    """A neighbour of half a metre, matched in a dozen places."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        source = np.array([6.0, 1.0, 0.0]) + random.uniform(-0.25, 0.25, (12, 3))
        target = MOTION.apply(source) + random.normal(0.0, 0.02, source.shape)
        found = ransac_rigid(source, target, seed=seed).transform
        middle = source.mean(axis=0)[None]
        assert np.linalg.norm(found.apply(middle) - MOTION.apply(middle)) < 0.03


LINE = np.outer(np.arange(40.0), [1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("source", "target", "reason"),
    [
        (np.zeros((50, 3)), np.zeros((50, 3)), "coincide"),
        (LINE, LINE, "collinear"),
        (LINE, LINE * [1.0, 1.0, 0.0], "collinear"),
        (np.full((50, 3), np.nan), np.ones((50, 3)), "not finite"),
        (np.zeros((50, 3)), np.zeros((49, 3)), "mismatched lengths"),
    ],
)
def test_degenerate_input_is_refused_with_its_reason(source: FloatArray, target: FloatArray, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        ransac_rigid(source, target)
