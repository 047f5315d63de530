"""Two drones in one mask are told apart by the centres that their pixels vote for."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.messages import Float32Array
from flockd.flight.perception import group_instances


def painted(
    shape: tuple[int, int], discs: list[tuple[float, float, float]], error_px: float = 0.0
) -> tuple[Float32Array, Float32Array]:
    """Logit and offset maps of discs (u, v, radius); the later covers the earlier."""
    rng = np.random.default_rng(1)
    logit = np.full(shape, -5.0, np.float32)
    offset = np.zeros((2, *shape), np.float32)
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    for cu, cv, radius in discs:
        inside = (u - cu) ** 2 + (v - cv) ** 2 < radius**2
        logit[inside] = 5.0
        offset[0][inside] = (cu - u)[inside]
        offset[1][inside] = (cv - v)[inside]
    offset += rng.normal(0, error_px, offset.shape).astype(np.float32)
    return logit, offset


@pytest.mark.parametrize("discs", [[], [(30.5, 30.5, 0.6)]], ids=["nothing", "a speck"])
def test_an_empty_mask_and_specks_are_no_drones(discs: list[tuple[float, float, float]]) -> None:
    labels, instances = group_instances(*painted((60, 80), discs), scale=2)
    assert instances == ()
    assert not labels.any()


def test_overlapping_drones_are_two() -> None:
    logit, offset = painted((120, 160), [(60.0, 60.0, 20.0), (84.0, 64.0, 14.0)], error_px=0.7)
    labels, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 2
    assert np.allclose(instances[0].centre, [120.0, 120.0], atol=2.0)
    assert np.allclose(instances[1].centre, [168.0, 128.0], atol=2.0)
    assert labels[60, 45] == instances[0].label
    assert labels[64, 90] == instances[1].label


def test_one_large_drone_stays_one_though_its_votes_scatter() -> None:
    logit, offset = painted((240, 320), [(150.0, 120.0, 60.0)], error_px=4.0)
    _, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 1


def test_a_drone_cut_by_the_border_points_outside() -> None:
    logit, offset = painted((100, 100), [(-6.0, 50.0, 15.0)])
    _, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 1
    assert np.allclose(instances[0].centre, [-12.0, 100.0], atol=2.0)
    assert instances[0].box[0] == 0.0


def test_a_dozen_drones_keep_their_own_pixels() -> None:
    discs = [(30.0 + 50 * (i % 4), 30.0 + 50 * (i // 4), 6.0 + i) for i in range(12)]
    logit, offset = painted((160, 220), discs)
    v, u = np.mgrid[:160, :220] + 0.5
    labels, instances = group_instances(logit, offset, scale=2)
    assert len(instances) == 12
    for instance, (cu, cv, radius) in zip(instances, reversed(discs), strict=True):  # the largest first
        own = (u - cu) ** 2 + (v - cv) ** 2 < radius**2
        assert np.array_equal(labels == instance.label, own)
        assert instance.area_px == 4 * own.sum()
        assert instance.centre.tolist() == [2 * cu, 2 * cv]
        rows, columns = np.nonzero(own)
        assert instance.box.tolist() == [2 * columns.min(), 2 * rows.min(), 2 * columns.max() + 2, 2 * rows.max() + 2]
