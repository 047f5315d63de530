"""Models of other people: their manifest says what they take and what their outputs mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.core.messages import Frame
from flockd.flight.inference import OnnxModel
from flockd.flight.inference.fitting import fit
from flockd.flight.perception import OnnxFlow, OnnxNetworks, OpenDepth
from tests.flight.inference.foreign import SIZE, constant_flow, one_channel_depth
from tests.make import rig_camera

WIDTH, HEIGHT = SIZE


def perception_with(depth: Path, **config: Any) -> OnnxNetworks:
    return OnnxNetworks(PerceptionConfig(flow="dis", depth=str(depth), distance="none", **config), data_path("models"))


def plain(colour: tuple[int, int, int], size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.full((size[1], size[0], 3), colour, np.uint8)


def front(image: np.ndarray) -> Frame:
    return Frame("front", image, 0.0, 0)


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
    seen = perception_with(path, scale="network").scene(front(plain((200, 100, 50))), rig_camera(40.0, SIZE), None)
    assert isinstance(seen.depth, np.ndarray)
    np.testing.assert_allclose(seen.depth, expected, rtol=1e-5)


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


def test_what_lies_right_in_the_image_lies_right_in_the_map_although_its_input_was_padded(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={})
    image = plain((0, 0, 0), (64, 64))  # half as wide again is black border in an input of 48 x 32
    image[:, 32:] = 255
    seen = perception_with(path, scale="network").scene(front(image), rig_camera(40.0, (64, 64)), None)
    assert isinstance(seen.depth, np.ndarray)
    assert seen.depth.shape == (64, 64)
    np.testing.assert_allclose(seen.depth[:, :30], 0.0, atol=1e-6)
    np.testing.assert_allclose(seen.depth[:, 34:], 1.0, atol=1e-6)


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
    image = plain((red, 0, 0), size)
    seen = perception_with(path, scale="network").scene(front(image), rig_camera(focal_px, size), None)
    assert isinstance(seen.depth, np.ndarray)
    np.testing.assert_allclose(seen.depth, expected, rtol=1e-3)


def test_a_relative_network_is_refused_where_nothing_fixes_its_scale(tmp_path: Path) -> None:
    relative = {"depth": {"quantity": "inverse_depth", "unknown": "scale_and_shift"}}
    path = one_channel_depth(tmp_path, output=relative)
    with pytest.raises(ModelError, match=r"perception\.scale: .* has no metric scale .* write height, or choose"):
        perception_with(path, scale="network")
    seen = perception_with(path, scale="height").scene(front(plain((51, 0, 0))), rig_camera(40.0, SIZE), None)
    assert isinstance(seen.depth, OpenDepth)
    assert seen.depth.shift
    np.testing.assert_allclose(seen.depth.inverse, 0.2, rtol=1e-5)


def test_a_metric_network_leaves_its_scale_to_the_autopilot_where_that_is_asked_for(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={})
    # it takes no ground as an input, so height has to align what it says
    seen = perception_with(path, scale="height").scene(front(plain((51, 0, 0))), rig_camera(40.0, SIZE), None)
    assert isinstance(seen.depth, OpenDepth)
    assert not seen.depth.shift
    np.testing.assert_allclose(seen.depth.inverse, 5.0, rtol=1e-5)
