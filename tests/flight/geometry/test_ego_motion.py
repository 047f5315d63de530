"""The own motion in a world of ground and boxes: Algorithm 1, and what the polish makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import EgoMotion
from flockd.flight.geometry import (
    PointPairs,
    RigidTransform,
    ego_motion,
    estimate_ego_motion,
    rotation_angle_deg,
    rotation_from_euler,
)

from .synthetic_world import EXACT, Flaws, boxes_around, four_camera_rig, seen_twice

RIG = four_camera_rig()
POLISHED = GeometryParameters()
UNPOLISHED = GeometryParameters(refine=False)


def flight(seed: int, flaws: Flaws) -> tuple[PointPairs, RigidTransform]:
    """Half a metre ahead and three degrees of yaw at 3-5 m, with some roll and pitch; the true F to C."""
    random = np.random.default_rng(seed)
    attitude = rotation_from_euler(random.normal(0.0, 0.05), random.normal(0.0, 0.05), random.uniform(-3.0, 3.0))
    pose = RigidTransform(attitude, np.array([0.0, 0.0, -random.uniform(3.0, 5.0)]))
    turn = rotation_from_euler(random.normal(0.0, 0.02), random.normal(0.0, 0.02), np.radians(3.0))
    step = RigidTransform(turn, np.array([0.5, 0.0, 0.0]))
    return seen_twice(boxes_around(random), RIG, (pose, pose @ step), flaws, random), step


def errors(found: EgoMotion | RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    """Degrees and metres."""
    return (
        rotation_angle_deg(found.rotation @ truth.rotation.T),
        float(np.linalg.norm(found.translation - truth.translation)),
    )


@pytest.mark.parametrize("parameters", [POLISHED, UNPOLISHED])
def test_a_flawless_view_gives_the_exact_motion(parameters: GeometryParameters) -> None:
    pairs, truth = flight(0, EXACT)
    motion = estimate_ego_motion(pairs, RIG, 0.5, parameters)
    assert np.allclose(motion.rotation, truth.rotation, atol=1e-6)
    assert np.allclose(motion.translation, truth.translation, atol=1e-5)
    assert np.allclose(motion.velocity, [1.0, 0.0, 0.0], atol=1e-4)  # 0.5 m in 0.5 s (Eq. 21)
    assert motion.pairs == len(pairs)
    assert motion.threshold_m <= 0.01


@pytest.mark.parametrize(
    ("flaws", "limit_deg", "limit_m"),
    [
        (Flaws(), 0.03, 0.006),
        (Flaws(depth_sigma=0.03), 0.03, 0.006),
        (Flaws(outliers=0.3), 0.03, 0.006),
        (Flaws(object_bias=0.15), 0.04, 0.01),
        (Flaws(object_bias=0.15, outliers=0.3), 0.05, 0.015),
    ],
)
def test_the_polish_is_several_times_closer_than_algorithm_1(flaws: Flaws, limit_deg: float, limit_m: float) -> None:
    raw, polished = [], []
    for seed in range(6):
        pairs, truth = flight(seed, flaws)
        raw.append(errors(estimate_ego_motion(pairs, RIG, 0.5, UNPOLISHED), truth))
        polished.append(errors(estimate_ego_motion(pairs, RIG, 0.5, POLISHED), truth))
    assert np.max(polished, axis=0)[0] < limit_deg
    assert np.max(polished, axis=0)[1] < limit_m
    assert np.all(np.median(polished, axis=0) < np.median(raw, axis=0) / 1.5)


def test_a_polish_that_leaves_the_matches_behind_leaves_algorithm_1s_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its robust cost falls where most matches are false, and it explains the others."""
    pairs, truth = flight(6, EXACT)
    astray = RigidTransform(rotation_from_euler(0.0, 0.0, 0.03), np.zeros(3)) @ truth
    monkeypatch.setattr(ego_motion, "refine_ego_motion", lambda *_: astray)
    raw, kept = (estimate_ego_motion(pairs, RIG, 0.5, parameters) for parameters in (UNPOLISHED, POLISHED))
    assert np.array_equal(raw.rotation, kept.rotation)
    assert np.array_equal(raw.translation, kept.translation)


def with_false_matches(pairs: PointPairs, share: float) -> PointPairs:
    """So many of the matches lead tens of pixels astray, each to its own place, on surfaces of the same depth."""
    random = np.random.default_rng(8)
    false = random.permutation(len(pairs)) < share * len(pairs)
    pixels, points = pairs.pixels_current.copy(), pairs.current.copy()
    for name, camera in RIG.cameras.items():
        mine = np.flatnonzero(false & (pairs.camera_names == name))
        pixels[mine] += random.uniform(20.0, 40.0, (len(mine), 2)) * random.choice([-1.0, 1.0], (len(mine), 2))
        depth = camera.T_body_camera.inverse().apply(points[mine])[:, 2]
        points[mine] = camera.T_body_camera.apply(camera.camera.unproject(pixels[mine], depth))
    return replace(pairs, current=points, pixels_current=pixels)


@pytest.mark.parametrize("parameters", [POLISHED, UNPOLISHED])
def test_a_motion_that_explains_none_of_its_matches_is_no_estimate(parameters: GeometryParameters) -> None:
    """Within metres there are always some that agree: false matches on nearby surfaces are not far apart in space."""
    pairs, _ = flight(6, EXACT)
    with pytest.raises(ValueError, match=r"explains only|no motion|better than chance"):
        estimate_ego_motion(with_false_matches(pairs, 0.99), RIG, 0.5, parameters)


@pytest.mark.parametrize("parameters", [POLISHED, UNPOLISHED])
def test_one_true_match_in_three_is_enough(parameters: GeometryParameters) -> None:
    pairs, truth = flight(6, EXACT)
    degrees, metres = errors(estimate_ego_motion(with_false_matches(pairs, 0.66), RIG, 0.5, parameters), truth)
    assert degrees < 0.1
    assert metres < 0.01
