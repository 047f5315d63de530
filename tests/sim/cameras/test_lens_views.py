"""What lens views keep between images."""

from __future__ import annotations

import gc
import weakref

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import WideAngleCamera
from flockd.sim.cameras.lens_views import lens_view
from flockd.sim.renderer.renderer import View


def grey(matrix: FloatArray, size: tuple[int, int], R_lens_part: FloatArray) -> View:
    shape = size[::-1]
    return View(np.full((*shape, 3), 90, np.uint8), np.ones(shape, np.float32), np.zeros(shape, np.uint8))


def small_fisheye() -> WideAngleCamera:
    return WideAngleCamera(np.array([[8.0, 0.0, 8.0], [0.0, 8.0, 6.0], [0.0, 0.0, 1.0]]), (16, 12))


def test_cameras_of_flights_long_over_are_not_kept() -> None:
    """Before, each flight of a campaign left the 64 MB of its rig's four lenses in its worker."""
    cameras = [small_fisheye() for _ in range(60)]
    gone = [weakref.ref(camera) for camera in cameras]
    for camera in cameras:
        assert (lens_view(camera, grey).rgb == 90).all()
    del cameras, camera
    gc.collect()
    assert all(camera() is None for camera in gone[:20])
