"""Models of other people: their manifest says what they take and mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.core.messages import Frame, UInt8Array
from flockd.flight.inference import OnnxModel
from flockd.flight.inference.fitting import fit
from flockd.flight.perception import OnnxNetworks
from flockd.flight.perception.flow import OnnxFlow
from tests.flight.inference.foreign import SIZE, constant_flow, one_channel_depth
from tests.make import rig_camera


def perception_with(depth: Path, **config: Any) -> OnnxNetworks:
    return OnnxNetworks(PerceptionConfig(flow="dis", depth=str(depth), **config), data_path("models"))


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


def test_a_relative_network_is_refused_with_what_to_take_instead(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={"depth": {"quantity": "inverse_depth"}})
    path.write_text(path.read_text().replace("inverse_depth", "inverse_depth\n      unknown: scale_and_shift"))
    with pytest.raises(ModelError, match=r"someones_depth\.yaml:\d+: .*depth\.unknown: is gone; .*metric"):
        perception_with(path)


def test_a_network_that_takes_no_height_is_refused_for_a_scale_by_height(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={})
    with pytest.raises(ModelError, match=r"perception\.scale: .*someones_depth.*no input `geometry`; write network"):
        perception_with(path)
