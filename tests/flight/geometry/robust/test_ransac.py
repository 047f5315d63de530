"""Algorithm 1: outliers, the threshold that doubles, and what must not be answered."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray
from flockd.flight.geometry import fit_rigid, rotation_angle_deg
from flockd.flight.geometry import ransac_rigid as any_ransac

ransac_rigid = partial(any_ransac, method="paper")

TURN = Rotation.from_euler("ZYX", [10.0, -3.0, 2.0], degrees=True)
SHIFT = np.array([0.5, -0.1, 0.05])


def moved(points: FloatArray) -> FloatArray:
    result: FloatArray = TURN.apply(points) + SHIFT
    return result


def unit_vectors(random: np.random.Generator, count: int) -> FloatArray:
    vectors = random.normal(size=(count, 3))
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


@pytest.mark.parametrize("outlier_share", [0.0, 0.3, 0.6, 0.75])
def test_exact_pairs_among_outliers_are_all_found_and_nothing_else(outlier_share: float) -> None:
    for seed in range(5):
        random = np.random.default_rng(seed)
        source = random.uniform(-10.0, 10.0, (1000, 3))
        target = moved(source)
        wrong = random.random(1000) < outlier_share
        target[wrong] += unit_vectors(random, int(wrong.sum())) * random.uniform(0.5, 3.0, (int(wrong.sum()), 1))
        result = ransac_rigid(source, target, seed=seed)
        assert result.threshold == 0.01
        assert np.array_equal(result.inliers, ~wrong)
        assert np.allclose(result.transform.rotation, TURN.as_matrix(), atol=1e-9)
        assert np.allclose(result.transform.translation, SHIFT, atol=1e-8)


@pytest.mark.parametrize("outlier_share", [0.3, 0.6])
def test_noisy_pairs_among_outliers_give_the_motion_to_a_centimetre(outlier_share: float) -> None:
    for seed in range(5):
        random = np.random.default_rng(seed)
        source = random.uniform(-10.0, 10.0, (5000, 3))
        target = moved(source) + random.normal(0.0, 0.05, source.shape)
        wrong = random.random(5000) < outlier_share
        target[wrong] += random.uniform(-3.0, 3.0, (int(wrong.sum()), 3))
        transform = ransac_rigid(source, target, seed=seed).transform
        assert rotation_angle_deg(transform.rotation @ TURN.as_matrix().T) < 0.05
        assert np.linalg.norm(transform.translation - SHIFT) < 0.01


def test_the_threshold_doubles_until_enough_pairs_agree_and_no_further() -> None:
    # Every target is 0.06 m off in some direction. A ball of radius r < 0.06 holds at most the share
    # (1 - sqrt(1 - (r / 0.06)^2)) / 2 of that sphere: 13 % for r = 0.04, not the 20 % asked for. One of 0.08 holds all.
    random = np.random.default_rng(4)
    source = random.uniform(-3.0, 3.0, (4000, 3))
    target = moved(source) + 0.06 * unit_vectors(random, 4000)
    result = ransac_rigid(source, target)
    assert result.threshold == 0.08
    assert result.inliers.mean() > 0.95
    with pytest.raises(ValueError, match=r"no motion has more than 20% of 4000 pairs within 0\.04 m"):
        ransac_rigid(source, target, max_threshold=0.07)


def test_fitting_again_widens_the_agreement() -> None:
    # Three noisy points make a poor motion. The fit to those who agree with it is better and has more of them: with
    # noise of 0.02 m on each axis 0.04 m holds 74 % of the pairs (chi-square, 3 degrees of freedom).
    random = np.random.default_rng(5)
    source = random.uniform(-5.0, 5.0, (2000, 3))
    target = moved(source) + random.normal(0.0, 0.02, source.shape)
    result = ransac_rigid(source, target, hypotheses=3, threshold=0.04)
    assert result.inliers.mean() == pytest.approx(0.74, abs=0.03)


def test_the_motion_is_the_least_squares_fit_to_its_inliers() -> None:
    random = np.random.default_rng(6)
    source = random.uniform(-5.0, 5.0, (500, 3))
    target = moved(source) + random.normal(0.0, 0.02, source.shape)
    result = ransac_rigid(source, target)
    refit = fit_rigid(source[result.inliers], target[result.inliers])
    assert np.array_equal(refit.rotation, result.transform.rotation)
    assert result.inliers.sum() > 0.2 * 500


def test_one_seed_gives_one_result_and_leaves_its_input_alone() -> None:
    random = np.random.default_rng(7)
    source = random.uniform(-5.0, 5.0, (300, 3))
    target = moved(source) + random.normal(0.0, 0.1, source.shape)
    kept = source.copy(), target.copy()
    first, second, other = (ransac_rigid(source, target, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.transform.rotation, second.transform.rotation)
    assert np.array_equal(first.inliers, second.inliers)
    assert not np.array_equal(first.transform.rotation, other.transform.rotation)
    assert np.array_equal(source, kept[0])
    assert np.array_equal(target, kept[1])


def test_three_pairs_are_enough_when_they_are_exact() -> None:
    # The one hypothesis of each seed must draw all three: a pair drawn twice would be collinear and refused.
    source = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for seed in range(20):
        result = ransac_rigid(source, moved(source), hypotheses=1, seed=seed)
        assert np.allclose(result.transform.translation, SHIFT)
        assert result.inliers.all()


def test_unrelated_points_get_no_motion_rather_than_a_junk_one() -> None:
    random = np.random.default_rng(8)
    source, target = random.uniform(-20.0, 20.0, (2, 400, 3))
    with pytest.raises(ValueError, match="no motion has more than 20%"):
        ransac_rigid(source, target)


@pytest.mark.parametrize(
    ("source", "target", "reason"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "fewer than three pairs"),
        (np.zeros((5, 3)), np.zeros((4, 3)), "mismatched lengths"),
        (np.zeros((5, 3)), np.zeros((5, 3)), "collinear"),
        (np.outer(np.arange(9.0), [1.0, 1.0, 1.0]), np.outer(np.arange(9.0), [1.0, 1.0, 1.0]), "collinear"),
        (np.full((5, 3), np.nan), np.eye(5, 3), "not finite"),
    ],
)
def test_degenerate_input_is_refused_with_its_reason(source: FloatArray, target: FloatArray, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        ransac_rigid(source, target)


@pytest.mark.parametrize("threshold", [0.0, -1.0, 3.0])
def test_a_threshold_that_cannot_double_up_to_its_maximum_is_refused(threshold: float) -> None:
    with pytest.raises(ValueError, match="threshold"):
        ransac_rigid(np.eye(3), np.eye(3), threshold=threshold)
