"""The ground's inverse depth against geometry done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.flight.geometry import ground_inverse_depth

from .synthetic_world import four_camera_rig

RIG = four_camera_rig()
LEVEL = np.eye(3)


def test_a_level_camera_sees_the_ground_under_45_degrees_as_far_ahead_as_it_is_high() -> None:
    inverse = ground_inverse_depth(RIG.cameras["front"], LEVEL, 4.0)
    assert inverse.shape == (640, 480)
    assert inverse.dtype == np.float32
    # Row 541 has its centre 221.5 px below the principal point: z = 4 m * 222 / 221.5, in every column.
    assert np.allclose(inverse[541], 221.5 / 222.0 / 4.0, rtol=1e-5)
    assert (inverse[:320] == 0.0).all()  # the sky
    assert (inverse[320:] > 0.0).all()


@pytest.mark.fault("ground-reached")
def test_a_camera_on_the_ground_and_a_stride_that_does_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'front'.*ground"):
        ground_inverse_depth(RIG.cameras["front"], LEVEL, 0.0)
    with pytest.raises(ValueError, match=r"7.*480x640"):
        ground_inverse_depth(RIG.cameras["front"], LEVEL, 4.0, stride=7)


def test_a_slope_is_ground_that_rises_by_so_much_for_each_metre() -> None:
    """Against points of a hillside 4 m below the drone that rises by 10 % to the north and falls by 5 % to the east."""
    attitude = Rotation.from_euler("ZYX", [50.0, 4.0, -7.0], degrees=True)
    random, slope = np.random.default_rng(2), (0.1, -0.05)
    for camera in RIG.cameras.values():
        inverse = ground_inverse_depth(camera, attitude.as_matrix(), 4.0, slope=slope)
        level = random.uniform(-12.0, 12.0, (300, 2))
        points = np.column_stack([level, 4.0 - level @ np.array(slope)])  # NED, from the drone
        seen = camera.T_body_camera.inverse().apply(attitude.inv().apply(points))
        pixels = 222.0 * seen[:, :2] / seen[:, 2:] + np.array([240.0, 320.0])
        shown = (seen[:, 2] > 0.5) & (pixels >= 1.0).all(axis=1) & (pixels < [479.0, 639.0]).all(axis=1)
        assert shown.sum() > 10
        column, row = pixels[shown].astype(int).T
        np.testing.assert_allclose(inverse[row, column], 1.0 / seen[shown, 2], atol=0.003)  # half a pixel off
