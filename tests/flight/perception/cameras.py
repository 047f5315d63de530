"""Plain cameras, crops of them, and what they see of the simulator's drones."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flockd.core.data import data_path
from flockd.core.messages import FloatArray, UInt8Array
from flockd.flight.inference import load_manifest
from flockd.flight.perception import Crops
from flockd.flight.perception.interface import SecondStage
from flockd.sim.renderer.drone_models import drone_model
from flockd.sim.renderer.renderer import Renderer, View
from flockd.sim.world.world import World
from tests.make import pinhole

SECOND_STAGE = SecondStage.of(load_manifest(data_path("models") / "distance_int8.yaml")[0])
"""The interface of the shipped second stage, for fakes that stand in its place."""


def crops_of(images: Sequence[UInt8Array], focal_px: float) -> Crops:
    n = len(images)
    turns, no = np.tile(np.eye(3), (n, 1, 1)), np.zeros(n)
    return Crops(np.array(images), np.full(n, focal_px), turns, np.zeros((n, 3)), no > 0, no)


def rendered(
    focal_px: float,
    size: tuple[int, int],
    *drones: tuple[float, float, float],
    turned: FloatArray | None = None,
) -> View:
    """World 11 from 4 m above ground to the north, or ``turned`` (3, 3) from there, with drones at places in NED."""
    level = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    attitude, _ = cv2.Rodrigues(np.array([0.2, -0.4, 0.3]))
    models = [drone_model(6 * number, number) for number in range(len(drones))]
    return Renderer(World.generate(11), models).render(
        pinhole(focal_px, size).matrix, size, level if turned is None else turned @ level, np.array([0.0, 0.0, -4.0]),
        drone_rotations=np.tile(attitude, (len(drones), 1, 1)), drone_positions=np.reshape(drones, (-1, 3)),
        shown=[True] * len(drones),
    )  # fmt: skip
