"""Depth without metres: the height above ground says how far away things are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, RigConfig
from flockd.core.data import data_path
from flockd.core.messages import BoolArray, Float32Array, FloatArray, Frame, FrameSet, UInt8Array, VehicleState
from flockd.flight.geometry import Rig, RigCamera, build_rig, ground_inverse_depth, z_map
from flockd.flight.perception import Instance, OnnxNetworks, OpenDepth, Perception, SceneMaps
from flockd.flight.perception.metric_depth import metric_depth
from flockd.flight.pilot.ground import level_ground
from tests.flight.inference.foreign import SIZE, one_channel_depth

WIDTH, HEIGHT = 160, 120
FACTOR, SHIFT = 2.5, 0.03


def rig_of(size: tuple[int, int] = (WIDTH, HEIGHT)) -> Rig:
    focal = size[0] / 2
    intrinsics = IntrinsicsConfig(fx=focal, fy=focal, cx=size[0] / 2, cy=size[1] / 2)
    return build_rig(RigConfig(cameras=(CameraConfig(name="front", size_px=size, intrinsics=intrinsics),)))


def camera_of(rig: Rig) -> RigCamera:
    return rig.cameras["front"]


LENS = camera_of(rig_of()).camera
U, V = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
AXIAL_SHARE = 1.0 / np.sqrt(1.0 + (U**2 + V**2) / (WIDTH / 2) ** 2)
"""z over range in each pixel, by Pythagoras."""


def opened(depth: FloatArray, *, shift: bool, labels: UInt8Array | None = None) -> SceneMaps:
    """What a network says that knows this depth up to the factor and shift above."""
    inverse = (1.0 / depth - (SHIFT if shift else 0.0)) / FACTOR
    nothing: tuple[Instance, ...] = ()
    return SceneMaps(
        OpenDepth(inverse.astype(np.float32), shift=shift),
        np.zeros(depth.shape, np.uint8) if labels is None else labels,
        nothing,
    )


def depth_of_ground(height_m: float, seed: int = 0) -> tuple[FloatArray, Float32Array, BoolArray]:
    """Level ground under a camera that looks ahead, with things standing on 40 % of it; and where it is bare."""
    ground = ground_inverse_depth(camera_of(rig_of()), np.eye(3), height_m, stride=1)
    depth = 1.0 / np.maximum(ground, 1e-3)
    covered = np.random.default_rng(seed).random((HEIGHT // 8, WIDTH // 8)) < 0.4
    covered_px = np.kron(covered, np.ones((8, 8), np.bool_))
    scene = np.where(covered_px, depth * np.random.default_rng(1).uniform(0.3, 0.8, depth.shape), depth)
    return scene, ground_inverse_depth(camera_of(rig_of()), np.eye(3), height_m, stride=2), ~covered_px & (ground > 0)


@pytest.mark.parametrize("shift", [False, True])
def test_height_finds_the_ground_under_what_stands_on_it(shift: bool) -> None:
    scene, ground, bare = depth_of_ground(3.0)
    fixed = metric_depth(opened(scene, shift=shift), ground, LENS)
    true = scene / AXIAL_SHARE
    np.testing.assert_allclose(fixed[bare], true[bare], rtol=0.02)
    near = scene < 20.0
    np.testing.assert_allclose(fixed[near], true[near], rtol=0.02)


def test_drones_before_the_ground_do_not_count() -> None:
    scene, ground, bare = depth_of_ground(3.0)
    labels = np.zeros(scene.shape, np.uint8)
    labels[HEIGHT // 2 :, : WIDTH // 3] = 1
    seen = scene.copy()
    seen[labels > 0] *= 0.2
    fixed = metric_depth(opened(seen, shift=True, labels=labels), ground, LENS)
    kept = bare & (labels == 0)
    np.testing.assert_allclose(fixed[kept], (scene / AXIAL_SHARE)[kept], rtol=0.02)


def test_without_ground_in_view_height_says_nothing() -> None:
    wall = np.random.default_rng(0).uniform(1.0, 30.0, (HEIGHT, WIDTH))
    ground = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
    with pytest.raises(ValueError, match="too little flat ground is in view to fix the scale of depth"):
        metric_depth(opened(wall, shift=True), ground, LENS)
    _, level, _ = depth_of_ground(3.0)
    with pytest.raises(ValueError, match="too little flat ground"):
        metric_depth(opened(wall, shift=True), level, LENS)  # nothing in this picture looks like ground


def test_a_foreign_relative_network_sees_metres_by_height(tmp_path: Path) -> None:
    """Its image is painted so that it sees level ground, in a unit of its own."""
    rig = rig_of(SIZE)
    vehicle = VehicleState(0.0, np.eye(3), 2.0)
    inverse = ground_inverse_depth(camera_of(rig), np.eye(3), 2.0, stride=1)
    grey = np.round(20 + 200 * inverse / inverse.max()).astype(np.uint8)
    image = np.repeat(grey[:, :, None], 3, axis=2)
    path = one_channel_depth(tmp_path, output={"depth": {"quantity": "inverse_depth", "unknown": "scale_and_shift"}})
    config = PerceptionConfig(flow="dis", depth=str(path), distance="none", scale="height")
    perception = Perception(rig, OnnxNetworks(config, data_path("models")), config)
    observation = perception.observe(
        FrameSet(0.0, {"front": Frame("front", image, 0.0, 0)}), vehicle, level_ground(vehicle)
    )
    assert observation.reasons == ()
    rows = slice(SIZE[1] * 3 // 4, None)
    depth = observation.cameras["front"].depth
    assert depth is not None
    z = z_map(depth, camera_of(rig).camera)
    np.testing.assert_allclose(z[rows], 1.0 / inverse[rows], rtol=0.05)
