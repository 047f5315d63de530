"""The depth of pixels that are a drone's."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import Detection, FloatArray
from flockd.flight.geometry import RangeMap, Rig, RigCamera, build_rig
from flockd.flight.perception.detection.masks import depth_of_drones
from tests import make

RIG: Rig = build_rig(make.scenario().drone.rig)
FRONT: RigCamera = RIG.cameras["front"]
WIDTH, HEIGHT = FRONT.camera.size


def detection(label: int, position: FloatArray) -> Detection:
    sigma = 0.1 / float(np.linalg.norm(position))
    return make.detection(position, sigma, 0.004, cameras=("front",), label=label)


def test_a_detected_drone_stands_at_its_range_in_the_map_whichever_way_it_is() -> None:
    place = FRONT.T_body_camera.translation + 5.0 * np.array([math.cos(0.8), 0.0, math.sin(0.8)])
    column, row = FRONT.pixels_of_points(place[None])[0].astype(int)
    labels, flat = np.zeros((HEIGHT, WIDTH), np.uint8), RangeMap(np.full((HEIGHT, WIDTH), 5.0, np.float32))
    labels[row - 3 : row + 4, column - 3 : column + 4] = 1
    moved = depth_of_drones(flat, labels, FRONT, [detection(1, place)])
    lifted = FRONT.camera.unproject(np.array([[column + 0.5, row + 0.5]]), moved[row, [column]].astype(np.float64))
    np.testing.assert_allclose(FRONT.T_body_camera.apply(lifted)[0], place, atol=0.02)
