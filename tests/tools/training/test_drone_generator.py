"""Shapes of drones drawn from a seed. Needs the extra `train`."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.sim.renderer.airframe import DroneModel
from flockd.sim.renderer.drone_models import FAMILIES
from tools.training.drone_generator import FIRST_GENERATED, SIZES_M, generated_drone

SHAPES = range(24)


@pytest.fixture(scope="module")
def drones() -> list[DroneModel]:
    return [generated_drone(shape, 7) for shape in SHAPES]


def test_a_shape_is_its_own_whatever_its_paint() -> None:
    first, again, repainted = generated_drone(11, 1), generated_drone(11, 1), generated_drone(11, 2)
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(first.colours, again.colours)
    assert repainted.size_m == first.size_m
    assert np.allclose(repainted.hubs, first.hubs)
    assert np.allclose(repainted.extent[:, :2], first.extent[:, :2])
    assert not np.array_equal(repainted.colours[: len(first.colours)], first.colours[: len(repainted.colours)])
    assert first.family == FIRST_GENERATED + 11 > FAMILIES


def test_drones_have_four_to_eight_rotors_and_the_sizes_of_drones(drones: list[DroneModel]) -> None:
    assert {len(drone.hubs) for drone in drones} == {4, 6, 8}
    sizes = [drone.size_m for drone in drones]
    assert SIZES_M[0] <= min(sizes) < 0.25
    assert 0.9 < max(sizes) <= SIZES_M[1]
    assert len({round(size, 9) for size in sizes}) == len(drones), "no two alike"


def test_the_size_is_what_the_mesh_measures_from_tip_to_tip(drones: list[DroneModel]) -> None:
    for drone in drones:
        apart = np.linalg.norm(drone.hubs[:, None, :2] - drone.hubs[None, :, :2], axis=2).max()
        assert apart < drone.size_m
        angles = np.linspace(0, np.pi, 90)
        along = drone.vertices[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
        widest = float(np.ptp(along, axis=0).max())
        # Propellers may stand across the arms, and guards reach a little beyond them.
        assert apart <= widest + 1e-6
        assert widest < 1.12 * drone.size_m
