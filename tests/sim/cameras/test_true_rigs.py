"""Rigs that are not as configured, in scenarios."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.data import data_path
from flockd.flight.geometry import build_rig, rotation_angle_deg
from flockd.sim.cameras.camera_simulator import true_rigs
from flockd.sim.scenario import ScenarioConfig, load_scenario

NONE = {"cameras.rig.mounting_deg": 0.0}
OFF = {"cameras.rig.mounting_deg": 2.0, "cameras.rig.mounting_m": 0.02, "cameras.rig.focal": 0.03}


def scenario(overrides: dict[str, float], seed: int = 0) -> ScenarioConfig:
    return load_scenario(data_path("config") / "paper_flight.yaml", {"seed": seed, **overrides})


def test_each_camera_of_each_drone_is_off_by_as_much_and_in_a_direction_of_its_own() -> None:
    flight = scenario(OFF)
    configured = build_rig(flight.drone.rig)
    rigs, directions = true_rigs(flight), []
    assert len(rigs) == len(flight.vehicles)
    for rig in rigs:
        assert list(rig.cameras) == list(configured.cameras)
        for name, one in rig.cameras.items():
            before = configured.cameras[name]
            turn = one.T_body_camera.rotation @ before.T_body_camera.rotation.T
            way = one.T_body_camera.translation - before.T_body_camera.translation
            assert rotation_angle_deg(turn) == pytest.approx(2.0)
            assert np.linalg.norm(way) == pytest.approx(0.02)
            assert abs(one.camera.focal_px / before.camera.focal_px - 1.0) == pytest.approx(0.03)
            assert (one.camera.matrix[:2, 2] == before.camera.matrix[:2, 2]).all()
            directions.append(tuple(np.round(way, 6)))
    assert len(set(directions)) == len(directions)


def test_a_seed_gives_the_same_rigs_and_another_seed_others() -> None:
    one, same, other = (true_rigs(scenario(OFF, seed))[1].cameras["left"].T_body_camera.rotation for seed in (0, 0, 1))
    assert (one == same).all()
    assert not np.allclose(one, other)


@pytest.mark.parametrize("overrides", [{}, NONE], ids=["no cameras", "no errors"])
def test_without_errors_rigs_are_as_configured(overrides: dict[str, float]) -> None:
    flight = scenario(overrides)
    for rig in true_rigs(flight):
        for name, one in build_rig(flight.drone.rig).cameras.items():
            assert (rig.cameras[name].T_body_camera.rotation == one.T_body_camera.rotation).all()
            assert (rig.cameras[name].camera.matrix == one.camera.matrix).all()
