"""Rigid motions among outliers: the default estimator and Algorithm 1; honest covariance, and what has no answer."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import RansacResult, RigidTransform, fit_rigid, ransac_rigid, rotation_angle_deg
from flockd.flight.geometry.robust.ransac import Method

paper = partial(ransac_rigid, method="paper")
"""Algorithm 1."""
BOTH = pytest.mark.parametrize("method", ["consensus", "paper"])
TURN = Rotation.from_euler("ZYX", [10.0, -3.0, 2.0], degrees=True)
SHIFT = np.array([0.5, -0.1, 0.05])
MOTION = RigidTransform(TURN.as_matrix(), SHIFT)


def unit_vectors(random: np.random.Generator, count: int) -> FloatArray:
    vectors = random.normal(size=(count, 3))
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


def around(random: np.random.Generator, count: int, nearest_m: float = 2.0, farthest_m: float = 15.0) -> FloatArray:
    """Points all around, from near to far."""
    points: FloatArray = unit_vectors(random, count) * random.uniform(nearest_m, farthest_m, (count, 1))
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


@BOTH
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6, 0.75])
def test_exact_pairs_among_outliers_are_all_found_and_nothing_else(method: Method, outliers: float) -> None:
    for seed in range(5):
        random = np.random.default_rng(seed)
        source = random.uniform(-10.0, 10.0, (1000, 3))
        target, wrong = disturbed(random, source, 0.0, outliers)
        result = ransac_rigid(source, target, seed=seed, method=method)
        assert np.array_equal(result.inliers, ~wrong)
        assert np.allclose(result.transform.rotation, MOTION.rotation, atol=1e-9)
        assert np.allclose(result.transform.translation, SHIFT, atol=1e-8)
        assert method == "consensus" or result.threshold == 0.01


@pytest.mark.parametrize(
    ("method", "outliers", "seeds", "limit_deg", "limit_m"),
    [("consensus", 0.9, 40, 1.0, 0.05), ("paper", 0.3, 5, 0.05, 0.01), ("paper", 0.6, 5, 0.05, 0.01)],
)
def test_noisy_pairs_among_outliers_give_the_motion(
    method: Method, outliers: float, seeds: int, limit_deg: float, limit_m: float
) -> None:
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        source = around(random, 5000)
        target, _ = disturbed(random, source, 0.05, outliers)
        found = ransac_rigid(
            source, target, seed=seed, method=method, min_inlier_ratio=0.05 if outliers == 0.9 else 0.2
        )
        degrees, metres = error(found)
        assert degrees < limit_deg
        assert metres < limit_m


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
        better.append(error(ransac_rigid(source, target, seed=seed))[1] / error(paper(source, target, seed=seed))[1])
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


@pytest.mark.parametrize("half_turn", [False, True])
def test_large_rotations_and_points_on_a_plane(half_turn: bool) -> None:
    random = np.random.default_rng(5)
    motion = RigidTransform(Rotation.from_rotvec([0.0, 0.0, np.pi if half_turn else 2.0]).as_matrix(), SHIFT)
    source = random.uniform(-10.0, 10.0, (1000, 3)) * [1.0, 1.0, 0.0]
    target = motion.apply(source) + random.normal(0.0, 0.02, source.shape)
    found = ransac_rigid(source, target).transform
    assert rotation_angle_deg(found.rotation @ motion.rotation.T) < 0.1
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@BOTH
def test_one_seed_gives_one_result_and_leaves_its_input_alone(method: Method) -> None:
    random = np.random.default_rng(7)
    source = random.uniform(-5.0, 5.0, (300, 3))
    target = MOTION.apply(source) + random.normal(0.0, 0.1, source.shape)
    kept = source.copy(), target.copy()
    first, second, other = (ransac_rigid(source, target, seed=seed, method=method) for seed in (1, 1, 2))
    assert np.array_equal(first.transform.rotation, second.transform.rotation)
    assert np.array_equal(first.inliers, second.inliers)
    assert method == "consensus" or not np.array_equal(first.transform.rotation, other.transform.rotation)
    assert np.array_equal(source, kept[0])
    assert np.array_equal(target, kept[1])


@BOTH
def test_unrelated_points_get_no_motion_rather_than_a_junk_one(method: Method) -> None:
    for seed in range(5):
        source, target = np.random.default_rng(seed).uniform(-20.0, 20.0, (2, 400, 3))
        with pytest.raises(ValueError, match="no motion"):
            ransac_rigid(source, target, method=method)


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


@BOTH
@pytest.mark.parametrize(
    ("source", "target", "reason"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "fewer than three pairs"),
        (np.zeros((50, 3)), np.zeros((50, 3)), "coincide|collinear"),
        (LINE, LINE, "collinear"),
        (np.full((50, 3), np.nan), np.ones((50, 3)), "not finite"),
        (np.zeros((50, 3)), np.zeros((49, 3)), "mismatched lengths"),
    ],
)
def test_degenerate_input_is_refused_with_its_reason(
    source: FloatArray, target: FloatArray, reason: str, method: Method
) -> None:
    with pytest.raises(ValueError, match=reason):
        ransac_rigid(source, target, method=method)


# Algorithm 1.


def test_the_threshold_doubles_until_enough_pairs_agree_and_no_further() -> None:
    # Every target is 0.06 m off in some direction. A ball of radius r < 0.06 holds at most the share
    # (1 - sqrt(1 - (r / 0.06)^2)) / 2 of that sphere: 13 % for r = 0.04, not the 20 % asked for. One of 0.08 holds all.
    random = np.random.default_rng(4)
    source = random.uniform(-3.0, 3.0, (4000, 3))
    target = MOTION.apply(source) + 0.06 * unit_vectors(random, 4000)
    result = paper(source, target)
    assert result.threshold == 0.08
    assert result.inliers.mean() > 0.95
    with pytest.raises(ValueError, match=r"no motion has more than 20% of 4000 pairs within 0\.04 m"):
        paper(source, target, max_threshold=0.07)


def test_fitting_again_widens_the_agreement_and_gives_the_least_squares_fit() -> None:
    # Three noisy points make a poor motion. The fit to those who agree with it is better and has more of them: with
    # noise of 0.02 m on each axis 0.04 m holds 74 % of the pairs (chi-square, 3 degrees of freedom).
    random = np.random.default_rng(5)
    source = random.uniform(-5.0, 5.0, (2000, 3))
    target = MOTION.apply(source) + random.normal(0.0, 0.02, source.shape)
    result = paper(source, target, hypotheses=3, threshold=0.04)
    assert result.inliers.mean() == pytest.approx(0.74, abs=0.03)
    refit = fit_rigid(source[result.inliers], target[result.inliers])
    assert np.array_equal(refit.rotation, result.transform.rotation)


def test_three_pairs_are_enough_when_they_are_exact() -> None:
    # The one hypothesis of each seed must draw all three: a pair drawn twice would be collinear and refused.
    source = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for seed in range(20):
        result = paper(source, MOTION.apply(source), hypotheses=1, seed=seed)
        assert np.allclose(result.transform.translation, SHIFT)
        assert result.inliers.all()


@pytest.mark.parametrize("threshold", [0.0, -1.0, 3.0])
def test_a_threshold_that_cannot_double_up_to_its_maximum_is_refused(threshold: float) -> None:
    with pytest.raises(ValueError, match="threshold"):
        paper(np.eye(3), np.eye(3), threshold=threshold)
