"""Figures of a flock against small flocks worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.flight.flocking import FlockingParameters
from flockd.flight.flocking.metrics import connectivity, min_distance, obj1, obj2, order, safety, union

ROW_OF_FOUR = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])


def test_obj1_on_the_circle_is_minus_a_half_where_a_uav_flies_as_desired() -> None:
    velocities = np.array([[0.0, 2.0], [2.0, 0.0], [0.0, -1.0]])
    # -(V . efv) / (2 |efv|^2) with efv = (0, 2)
    np.testing.assert_allclose(obj1(velocities, np.array([0.0, 2.0]), circling=True), [-0.5, 0.0, 0.25])


def test_obj1_after_the_circle_is_the_l1_distance() -> None:
    velocities = np.array([[1.0, 0.0], [0.7, -0.2]])
    np.testing.assert_allclose(obj1(velocities, np.array([1.0, 0.0]), circling=False), [0.0, 0.5])


def test_obj2_counts_distance_and_velocity_of_all_within_sight() -> None:
    positions = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0], [100.0, 0.0]])
    velocities = np.array([[1.0, 0.0], [1.0, 0.2], [0.5, 0.0], [9.0, 9.0]])
    # Pairs: 01: |3.5-3| + 0.2 = 0.7; 02: |3.5-5| + 0.5 = 2.0; 12: |3.5-4| + 0.5 + 0.2 = 1.2; 3 is out of sight.
    np.testing.assert_allclose(obj2(positions, velocities, FlockingParameters()), [2.7, 1.9, 3.2, 0.0])


def test_order_is_the_mean_cosine_over_pairs() -> None:
    assert order(np.array([[1.0, 0.0], [3.0, 0.0]])) == pytest.approx(1.0)
    assert order(np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])) == pytest.approx(-1 / 3)  # cosines 0, -1, 0
    assert order(np.array([[1.0, 0.0], [0.0, 0.0]])) == 0.0
    assert order(np.array([[1.0, 0.0]])) == 1.0


def test_union_counts_components() -> None:
    assert union(ROW_OF_FOUR, 1.0) == 1.0
    assert union(ROW_OF_FOUR, 0.9) == 0.0
    two_pairs = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 1.0], [50.0, 1.0]])
    assert union(two_pairs, 5.0) == pytest.approx(2 / 3)
    assert union(ROW_OF_FOUR[:1], 1.0) == 1.0
    long_row = np.column_stack([np.arange(33.0), np.zeros(33)])
    assert union(long_row, 1.0) == 1.0


def test_connectivity_of_known_graphs() -> None:
    rng = np.random.default_rng(0)
    for n in (2, 5, 9):  # complete graph: every eigenvalue but the first is n
        assert connectivity(rng.uniform(0, 1, (n, 2)), 10.0) == pytest.approx(1.0)
    for n in (3, 4, 7):  # path: 2 - 2 cos(pi / n)
        row = np.column_stack([np.arange(float(n)), np.zeros(n)])
        assert connectivity(row, 1.0) == pytest.approx((2 - 2 * math.cos(math.pi / n)) / n)
    assert connectivity(ROW_OF_FOUR, 0.5) == pytest.approx(0.0, abs=1e-12)
    assert connectivity(ROW_OF_FOUR[:1], 0.5) == 1.0


def test_safety_and_nearest_pair() -> None:
    row = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9], [5.0, 0.0, 0.0]])
    assert safety(row) == pytest.approx(2 / 3)  # 0.9 m < 2 * 0.5 m
    assert safety(row, collision_radius_m=0.45) == 1.0
    assert safety(row[:1]) == 1.0
    assert min_distance(row) == pytest.approx(0.9)
    assert min_distance(row[:1]) == math.inf
