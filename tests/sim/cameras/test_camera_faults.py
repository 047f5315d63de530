"""What a scenario orders to go wrong with a camera does, then, and there."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import UInt8Array
from flockd.flight.geometry import build_rig, rotation_angle_deg
from flockd.flight.perception.image_noise import noise_shares
from flockd.sim.cameras.camera_simulator import CameraFaults, ImageNoise, true_rigs
from flockd.sim.scenario import CameraFaultConfig
from tests import make

GREY = np.full((128, 160, 3), 120, np.uint8)


def fault(**changes: object) -> CameraFaultConfig:
    values = {"drone": 2, "camera": "left", "begin_s": 1.0, "end_s": 2.0, **changes}
    return CameraFaultConfig.model_validate(values)


def shown(faults: CameraFaults, time_s: float, drone: int = 1, camera: str = "left") -> UInt8Array:
    return faults.applied(drone, camera, time_s, GREY)


def test_a_fault_is_of_one_camera_of_one_drone_from_its_begin_to_its_end() -> None:
    """Times count from the first image, which came at 500 s."""
    faults = CameraFaults([fault()], seed=3)
    changed = [not np.array_equal(shown(faults, 500.0 + passed_s), GREY) for passed_s in (0.0, 0.9, 1.0, 1.9, 2.0)]
    assert changed == [False, False, True, True, False]
    assert np.array_equal(shown(faults, 501.5, drone=0), GREY)
    assert np.array_equal(shown(faults, 501.5, camera="right"), GREY)


def test_the_same_seed_is_the_same_noise_and_enough_to_be_told() -> None:
    one, same, other = (CameraFaults([fault(begin_s=0.0)], seed=seed) for seed in (3, 3, 4))
    image = shown(one, 10.0)
    assert np.array_equal(image, shown(same, 10.0))
    assert not np.array_equal(image, shown(other, 10.0))
    assert noise_shares(image, NoiseParameters()).white > 0.08


@pytest.mark.parametrize("size", [(240, 320), (1280, 960), (1500, 1100)])
def test_images_of_any_size_get_the_noise_that_is_asked_for(size: tuple[int, int]) -> None:
    """Larger ones than the tile of noise, too: before, they ended the flight."""
    grey = np.full((*size, 3), 128, np.uint8)
    noisy = ImageNoise(4.0, seed=1).add(grey)
    assert noisy.shape == grey.shape
    assert (noisy.astype(float) - 128.0).std() == pytest.approx(4.0, rel=0.05)


NONE = {"cameras.rig.mounting_deg": 0.0}
OFF = {"cameras.rig.mounting_deg": 2.0, "cameras.rig.mounting_m": 0.02, "cameras.rig.focal": 0.03}


def test_each_camera_of_each_drone_is_off_by_as_much_and_in_a_direction_of_its_own() -> None:
    flight = make.scenario(OFF)
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


@pytest.mark.parametrize("overrides", [{}, NONE], ids=["no cameras", "no errors"])
def test_without_errors_rigs_are_as_configured(overrides: dict[str, float]) -> None:
    flight = make.scenario(overrides)
    for rig in true_rigs(flight):
        for name, one in build_rig(flight.drone.rig).cameras.items():
            assert (rig.cameras[name].T_body_camera.rotation == one.T_body_camera.rotation).all()
            assert (rig.cameras[name].camera.matrix == one.camera.matrix).all()
