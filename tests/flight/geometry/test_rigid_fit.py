"""Kabsch's fit against scipy's, which solves the same problem by its own code."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray
from flockd.flight.geometry import fit_rigid

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
LINE = np.outer(np.arange(5.0), [1.0, 2.0, -1.0]) + np.array([3.0, 0.0, 1.0])


def test_a_known_motion_is_found_exactly() -> None:
    random = np.random.default_rng(0)
    for count in (3, 4, 50):
        rotation, translation = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
        source = random.normal(0.0, 5.0, (count, 3))
        found = fit_rigid(source, source @ rotation.T + translation)
        assert np.allclose(found.rotation, rotation, atol=1e-9)
        assert np.allclose(found.translation, translation, atol=1e-9)


@pytest.mark.parametrize("weighted", [False, True])
def test_noisy_points_give_scipys_least_squares_result(weighted: bool) -> None:
    random = np.random.default_rng(1)
    for _ in range(20):
        source = random.normal(0.0, 5.0, (30, 3))
        target = Rotation.random(rng=random).apply(source) + random.normal(size=3) + random.normal(0.0, 0.5, (30, 3))
        weights = random.uniform(0.0, 2.0, 30) if weighted else np.ones(30)
        source_mean, target_mean = (np.average(p, axis=0, weights=weights) for p in (source, target))
        expected, _ = Rotation.align_vectors(target - target_mean, source - source_mean, weights=weights)
        found = fit_rigid(source, target, weights if weighted else None)
        assert np.allclose(found.rotation, expected.as_matrix(), atol=1e-9)
        assert np.allclose(found.translation, target_mean - expected.apply(source_mean), atol=1e-9)


def test_a_mirror_image_is_answered_by_a_rotation_and_never_a_reflection() -> None:
    source = np.random.default_rng(2).normal(size=(20, 3))
    mirrored = source * [1.0, 1.0, -1.0]
    expected, _ = Rotation.align_vectors(mirrored - mirrored.mean(0), source - source.mean(0))
    found = fit_rigid(source, mirrored)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert np.allclose(found.rotation, expected.as_matrix())


@pytest.mark.parametrize(
    ("source", "target", "weights", "reason"),
    [
        (SQUARE[:2], SQUARE[:2], None, "fewer than three pairs"),
        (SQUARE[:0], SQUARE[:0], None, "fewer than three pairs"),
        (SQUARE, SQUARE[:3], None, "mismatched lengths: 4 source points, 3 target points"),
        (SQUARE[:, :2], SQUARE[:, :2], None, r"\(n, 3\)"),
        (np.where(SQUARE > 0.5, np.nan, SQUARE), SQUARE, None, "not finite"),
        (SQUARE, np.where(SQUARE > 0.5, np.inf, SQUARE), None, "not finite"),
        (LINE, LINE + 1.0, None, "source points are collinear"),
        (SQUARE, LINE[:4], None, "target points are collinear"),
        (np.full((4, 3), 2.5), SQUARE, None, "source points coincide"),
        (SQUARE, SQUARE, np.array([1.0, 1.0, 0.0, 0.0]), "collinear"),
        (SQUARE, SQUARE, np.array([1.0, 1.0, 1.0, -1.0]), "negative"),
        (SQUARE, SQUARE, np.array([1.0, 1.0, 1.0, np.nan]), "finite"),
        (SQUARE, SQUARE, np.zeros(4), "some must be positive"),
        (SQUARE, SQUARE, np.ones(3), "as many weights"),
    ],
)
def test_degenerate_input_is_refused_with_its_reason(
    source: FloatArray, target: FloatArray, weights: FloatArray | None, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        fit_rigid(source, target, weights)
