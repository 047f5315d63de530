"""Noise of any image, and rigs that are not as configured."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.flight.geometry import build_rig, rotation_angle_deg
from flockd.sim.cameras.camera_simulator import ImageNoise, true_rigs
from tests import make


@pytest.mark.parametrize("size", [(240, 320), (1280, 960), (1500, 1100)])
def test_images_of_any_size_get_the_noise_that_is_asked_for(size: tuple[int, int]) -> None:
    """Larger ones than the tile of noise, too: before, they ended the flight."""
    grey = np.full((*size, 3), 128, np.uint8)
    noisy = ImageNoise(4.0, seed=1).drawn((size[1], size[0]))(grey)
    assert noisy.shape == grey.shape
    assert (noisy.astype(float) - 128.0).std() == pytest.approx(4.0, rel=0.05)


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
