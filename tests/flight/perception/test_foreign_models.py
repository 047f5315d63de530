"""Models of other people: their manifest says what they take and mean; height says how far, where they do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.rig import RigConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.core.messages import BoolArray, Float32Array, FloatArray, Frame, UInt8Array
from flockd.flight.geometry import Rig, build_rig, ground_inverse_depth, z_map
from flockd.flight.inference import OnnxModel
from flockd.flight.inference.fitting import fit
from flockd.flight.perception import OnnxFlow, OnnxNetworks, OpenDepth, Perception, SceneMaps
from flockd.flight.perception.metric_depth import metric_depth
from flockd.flight.pilot.ground import level_ground
from tests.flight.inference.foreign import SIZE, constant_flow, one_channel_depth
from tests.make import camera, frames, rig_camera, vehicle

RELATIVE = {"depth": {"quantity": "inverse_depth", "unknown": "scale_and_shift"}}


def perception_with(depth: Path, **config: Any) -> OnnxNetworks:
    return OnnxNetworks(PerceptionConfig(flow="dis", depth=str(depth), distance="none", **config), data_path("models"))


def plain(colour: tuple[int, int, int], size: tuple[int, int] = SIZE) -> UInt8Array:
    return np.full((size[1], size[0], 3), colour, np.uint8)


def depth_of(path: Path, image: UInt8Array, focal_px: float = 40.0, scale: str = "network") -> Any:
    """What a network says of one image of a camera."""
    front = rig_camera(focal_px, (image.shape[1], image.shape[0]))
    return perception_with(path, scale=scale).scene(Frame("front", image, 0.0, 0), front, None).depth


@pytest.mark.parametrize(
    ("colour", "channel", "expected"),
    [
        ("rgb", 0, (200 / 255 - 0.485) / 0.229),
        ("bgr", 0, (50 / 255 - 0.485) / 0.229),
        ("rgb", 2, (50 / 255 - 0.406) / 0.225),
    ],
)
def test_an_image_enters_in_the_order_range_and_normalisation_of_the_manifest(
    tmp_path: Path, colour: str, channel: int, expected: float
) -> None:
    imagenet = {"mean": [0.485, 0.456, 0.406], "deviation": [0.229, 0.224, 0.225]}
    path = one_channel_depth(tmp_path, channel=channel, output={}, colour=colour, **imagenet)
    np.testing.assert_allclose(depth_of(path, plain((200, 100, 50))), expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("size", "inner"),
    [((96, 64), (48, 32)), ((540, 360), (48, 32)), ((640, 480), (43, 32)), ((24, 16), (48, 32))],
)
def test_flow_of_a_network_of_fixed_size_comes_back_in_pixels_of_the_image(
    tmp_path: Path, size: tuple[int, int], inner: tuple[int, int]
) -> None:
    model = OnnxModel(constant_flow(tmp_path, (3.0, -2.0)), threads=1)
    assert fit(model.manifest, size).inner == inner
    flow = OnnxFlow(model).flow(plain((0, 0, 0), size), plain((9, 9, 9), size))
    assert flow.shape == (size[1], size[0], 2)
    np.testing.assert_allclose(flow[..., 0], 3.0 * size[0] / inner[0], rtol=1e-5)
    np.testing.assert_allclose(flow[..., 1], -2.0 * size[1] / inner[1], rtol=1e-5)


@pytest.mark.parametrize(
    ("output", "focal_px", "red", "size", "expected"),
    [
        ({"factor": 0.5, "depth": {"quantity": "inverse_depth"}}, 40.0, 51, SIZE, 10.0),  # 0.2 of brightness: 0.1 1/m
        ({"depth": {"focal_px": 100.0}}, 300.0, 255, (96, 64), 1.5),  # enters at half its size: 300 px become 150 px
    ],
    ids=["inverse depth in a unit of its own", "depth for one focal length"],
)
def test_depth_becomes_metres_of_the_camera(
    tmp_path: Path, output: dict[str, Any], focal_px: float, red: int, size: tuple[int, int], expected: float
) -> None:
    path = one_channel_depth(tmp_path, output=output)
    np.testing.assert_allclose(depth_of(path, plain((red, 0, 0), size), focal_px), expected, rtol=1e-3)


def test_a_relative_network_is_refused_where_nothing_fixes_its_scale(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"perception\.scale: "):
        perception_with(one_channel_depth(tmp_path, output=RELATIVE), scale="network")


# Depth without metres: the height above ground says how far away things are.

WIDTH, HEIGHT = 160, 120
FACTOR, SHIFT = 2.5, 0.03


def rig_of(size: tuple[int, int] = (WIDTH, HEIGHT)) -> Rig:
    return build_rig(RigConfig(cameras=(camera("front", size, size[0] / 2),)))


FRONT = rig_of().cameras["front"]
U, V = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
AXIAL_SHARE = 1.0 / np.sqrt(1.0 + (U**2 + V**2) / (WIDTH / 2) ** 2)
"""z over range in each pixel, by Pythagoras."""


def opened(depth: FloatArray, *, shift: bool, labels: UInt8Array | None = None) -> SceneMaps:
    """What a network says that knows this depth up to the factor and shift above."""
    inverse = (1.0 / depth - (SHIFT if shift else 0.0)) / FACTOR
    nothing = np.zeros(depth.shape, np.uint8)
    return SceneMaps(OpenDepth(inverse.astype(np.float32), shift=shift), nothing if labels is None else labels, ())


def depth_of_ground(height_m: float) -> tuple[FloatArray, Float32Array, BoolArray]:
    """Level ground under a camera that looks ahead, with things standing on 40 % of it; and where it is bare."""
    ground = ground_inverse_depth(FRONT, np.eye(3), height_m, stride=1)
    depth = 1.0 / np.maximum(ground, 1e-3)
    covered = np.random.default_rng(0).random((HEIGHT // 8, WIDTH // 8)) < 0.4
    covered_px = np.kron(covered, np.ones((8, 8), np.bool_))
    scene = np.where(covered_px, depth * np.random.default_rng(1).uniform(0.3, 0.8, depth.shape), depth)
    return scene, ground_inverse_depth(FRONT, np.eye(3), height_m, stride=2), ~covered_px & (ground > 0)


@pytest.mark.parametrize("shift", [False, True])
@pytest.mark.parametrize("drones", [False, True])
def test_height_finds_the_ground_under_what_stands_on_it_and_drones_before_it_do_not_count(
    shift: bool, drones: bool
) -> None:
    scene, ground, bare = depth_of_ground(3.0)
    labels, seen = np.zeros(scene.shape, np.uint8), scene.copy()
    if drones:
        labels[HEIGHT // 2 :, : WIDTH // 3] = 1
        seen[labels > 0] *= 0.2
    fixed = metric_depth(opened(seen, shift=shift, labels=labels), ground, FRONT.camera)
    right = (labels == 0) & (bare | (scene < 20.0))
    np.testing.assert_allclose(fixed[right], (scene / AXIAL_SHARE)[right], rtol=0.02)


def test_a_foreign_relative_network_sees_metres_by_height(tmp_path: Path) -> None:
    """Its image is painted so that it sees level ground, in a unit of its own."""
    rig, state = rig_of(SIZE), vehicle(height_m=2.0)
    inverse = ground_inverse_depth(rig.cameras["front"], np.eye(3), 2.0, stride=1)
    grey = np.round(20 + 200 * inverse / inverse.max()).astype(np.uint8)
    networks = perception_with(one_channel_depth(tmp_path, output=RELATIVE), scale="height")
    config = PerceptionConfig(flow="dis", distance="none", scale="height")
    shown = frames(0.0, {"front": np.repeat(grey[:, :, None], 3, axis=2)})
    observation = Perception(rig, networks, config).observe(shown, state, level_ground(state))
    assert observation.reasons == ()
    rows = slice(SIZE[1] * 3 // 4, None)
    depth = observation.cameras["front"].depth
    assert depth is not None
    np.testing.assert_allclose(z_map(depth, rig.cameras["front"].camera)[rows], 1.0 / inverse[rows], rtol=0.05)
