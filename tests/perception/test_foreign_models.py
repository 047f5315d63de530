"""Models of others: whatever they take and say, their manifest tells how."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import helper

from flockd.config.perception import PerceptionConfig
from flockd.data import data_path
from flockd.errors import ModelError
from flockd.inference import OnnxModel
from flockd.inference.fitting import fit
from flockd.messages import Frame
from flockd.perception import OnnxFlow, OnnxNetworks
from tests.perception.cameras import camera_of
from tests.perception.foreign import SIZE, image_input, map_output, one_channel_depth, write_model

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
    seen = perception_with(path, scale="network").scene(front(plain((200, 100, 50))), camera_of(40.0, SIZE), None)
    np.testing.assert_allclose(seen.depth, expected, rtol=1e-5)


def constant_flow(folder: Path, flow: tuple[float, float], size: tuple[int | str, int | str] = SIZE) -> Path:
    """A flow network in NHWC, in grey, that says the same whatever it sees, and says it in NHWC."""
    width, height = size
    spec = image_input(shape=[1, height, width, 1], layout="nhwc", colour="grey", white=255.0)
    nodes = [
        helper.make_node("Sub", ["a", "b"], ["difference"]),
        helper.make_node("Mul", ["difference", "zeros"], ["nothing"]),
        helper.make_node("Add", ["nothing", "always"], ["motion"]),
    ]
    weights = {"zeros": np.zeros(2, np.float32), "always": np.array(flow, np.float32)}
    return write_model(
        folder, "someones_flow", "flow", nodes,
        inputs={"a": {**spec, "carries": "first"}, "b": {**spec, "carries": "second"}},
        outputs={"motion": map_output([1, height, width, 2], gives="flow", layout="nhwc")},
        weights=weights,
    )  # fmt: skip


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
    seen = perception_with(path, scale="network").scene(front(image), camera_of(40.0, (64, 64)), None)
    assert seen.depth.shape == (64, 64)
    np.testing.assert_allclose(seen.depth[:, :30], 0.0, atol=1e-6)
    np.testing.assert_allclose(seen.depth[:, 34:], 1.0, atol=1e-6)


def test_inverse_depth_in_a_unit_of_its_own_becomes_metres(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={"factor": 0.5, "depth": {"quantity": "inverse_depth"}})
    seen = perception_with(path, scale="network").scene(front(plain((51, 0, 0))), camera_of(40.0, SIZE), None)
    np.testing.assert_allclose(seen.depth, 10.0, rtol=1e-5)  # 0.2 of brightness is 0.1 1/m


def test_depth_for_one_focal_length_is_scaled_to_the_cameras(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={"depth": {"focal_px": 100.0}})
    size = (96, 64)  # enters at half its size, so that 300 px become 150 px
    seen = perception_with(path, scale="network").scene(front(plain((255, 0, 0), size)), camera_of(300.0, size), None)
    np.testing.assert_allclose(seen.depth, 1.5, rtol=1e-3)


def test_a_relative_network_is_refused_where_nothing_fixes_its_scale(tmp_path: Path) -> None:
    relative = {"depth": {"quantity": "inverse_depth", "unknown": "scale_and_shift"}}
    path = one_channel_depth(tmp_path, output=relative)
    with pytest.raises(ModelError, match=r"perception\.scale: .* knows no metres, .* write height or velocity"):
        perception_with(path, scale="network")
    for scale in ("height", "velocity"):
        seen = perception_with(path, scale=scale).scene(front(plain((51, 0, 0))), camera_of(40.0, SIZE), None)
        assert np.isnan(seen.depth).all()
        assert seen.open is not None
        assert seen.open.shift
        np.testing.assert_allclose(seen.open.inverse, 0.2, rtol=1e-5)


def test_a_metric_network_leaves_its_scale_to_the_autopilot_where_that_is_asked_for(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={})
    for scale in ("height", "velocity"):  # it takes no ground as an input, so height has to align what it says
        seen = perception_with(path, scale=scale).scene(front(plain((51, 0, 0))), camera_of(40.0, SIZE), None)
        assert seen.open is not None
        assert not seen.open.shift
        np.testing.assert_allclose(seen.open.inverse, 5.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"carries": "second"}, r"inputs: the role depth needs one that carries 'image'"),
        ({"colour": "grey"}, r"inputs: image: shape: a grey image in nchw has 1 where 3 is written"),
        ({"mean": [0.5]}, r"inputs: image: mean: has 1 numbers for 3 channels"),
        ({"layout": "whcn"}, r"inputs\.rgb\.layout: Input should be 'nhwc' or 'nchw'"),
        ({"shape": [1, 3, 32]}, r"inputs: image: shape: an image has 4 axes \(nchw\), and not 3"),
        (
            {"shape": [1, 3, 32, 64]},
            r"inputs\.rgb\.shape: the manifest says \[1, 3, 32, 64\] but the model file \[1, 3, 3",
        ),
        (
            {"shape": ["n", 3, 32, 48]},
            r"inputs\.rgb\.shape: the manifest says \[n, 3, 32, 48\] but the model file \[1, ",
        ),
        ({"dtype": "float16"}, r"inputs\.rgb\.dtype: the manifest says float16 but the model file float32"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused_in_one_sentence(
    tmp_path: Path, changes: dict[str, Any], complaint: str
) -> None:
    import yaml

    path = one_channel_depth(tmp_path, output={})
    document = yaml.safe_load(path.read_text())
    document["inputs"]["rgb"] |= changes
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ModelError, match=complaint) as refused:
        OnnxModel(path, threads=1)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_sizes_that_the_file_leaves_free_the_manifest_may_fix(tmp_path: Path) -> None:
    import yaml

    path = constant_flow(tmp_path, (1.0, 1.0), ("w", "h"))
    document = yaml.safe_load(path.read_text())
    for name in ("a", "b"):
        document["inputs"][name]["shape"] = [1, HEIGHT, WIDTH, 1]
    path.write_text(yaml.safe_dump(document))
    assert OnnxModel(path, threads=1).manifest.fixed_size == SIZE


def test_an_output_that_is_not_there_is_refused(tmp_path: Path) -> None:
    import yaml

    path = constant_flow(tmp_path, (3.0, -2.0))
    document = yaml.safe_load(path.read_text())
    document["outputs"] = {"moved": document["outputs"]["motion"]}
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(
        ModelError, match=r"outputs: the manifest names \['moved'\] but the model file has \['motion'\]"
    ):
        OnnxModel(path, threads=1)
