"""What quantising does besides ONNX Runtime's own. Needs the extra `train`."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from flockd.core.data import data_path
from tools.training.quantise import _drop_unused, _enter_as_it_is, _entries, _spread_in_8_bits

SCALE, ZERO = np.array(1.0, np.float32), np.array(128, np.uint8)


def model_of(nodes: list[onnx.NodeProto], output: str, shape: list[int]) -> onnx.ModelProto:
    """A model of an 8-bit image (1, 3, 4, 4) and planes (1, 1, 4, 4)."""
    inputs = [
        helper.make_tensor_value_info("image", TensorProto.UINT8, [1, 3, 4, 4]),
        helper.make_tensor_value_info("planes", TensorProto.FLOAT, [1, 1, 4, 4]),
    ]
    constants: dict[str, NDArray[Any]] = {
        "grey": np.array(128.0, np.float32),
        "scale": SCALE,
        "zero": ZERO,
        "step": np.array(0.5, np.float32),
    }
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    told = helper.make_tensor_value_info(output, TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "g", inputs, [told], weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def answer_of(model: onnx.ModelProto) -> NDArray[Any]:
    rng = np.random.default_rng(3)
    feeds = {
        "image": rng.integers(0, 256, (1, 3, 4, 4), dtype=np.uint8),
        "planes": rng.uniform(-200, 200, (1, 1, 4, 4)).astype(np.float32),
    }
    return np.asarray(ort.InferenceSession(model.SerializeToString()).run(None, feeds)[0])


def test_an_image_of_8_bits_enters_as_it_is_and_planes_beside_it_in_8_bits() -> None:
    nodes = [
        helper.make_node("Cast", ["image"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("Sub", ["numbers", "grey"], ["less"]),
        helper.make_node("Concat", ["less", "planes"], ["entry"], axis=1),
        helper.make_node("QuantizeLinear", ["entry", "scale", "zero"], ["entry_8"]),
        helper.make_node("DequantizeLinear", ["entry_8", "scale", "zero"], ["out"]),
    ]
    model = model_of(nodes, "out", [1, 4, 4, 4])
    assert _entries(model.graph.node) == ["entry"]
    before = answer_of(model)
    _enter_as_it_is(model.graph, "entry")
    _drop_unused(model.graph)
    onnx.checker.check_model(model)
    assert (answer_of(model) == before).all()
    (back,) = (node for node in model.graph.node if node.op_type == "DequantizeLinear")
    (together,) = (node for node in model.graph.node if list(node.output) == [back.input[0]])
    assert together.input[0] == "image"
    assert len(model.graph.node) == 3


def test_channels_become_pixels_in_8_bits_and_the_same_numbers_as_before() -> None:
    nodes = [
        helper.make_node("Concat", ["planes"] * 4, ["four"], axis=1),
        helper.make_node("QuantizeLinear", ["four", "step", "zero"], ["four_8"]),
        helper.make_node("DequantizeLinear", ["four_8", "step", "zero"], ["four_back"]),
        helper.make_node("DepthToSpace", ["four_back"], ["out"], blocksize=2, mode="CRD"),
    ]
    model = model_of(nodes, "out", [1, 1, 8, 8])
    before = answer_of(model)
    _spread_in_8_bits(model.graph)
    onnx.checker.check_model(model)
    assert (answer_of(model) == before).all()
    (spread,) = (node for node in model.graph.node if node.op_type == "DepthToSpace")
    assert spread.input[0] == "four_8"


@pytest.mark.parametrize("name", ["neighbours_int8", "distance_int8"])
def test_the_shipped_twins_make_no_32_bit_numbers_of_their_image(name: str) -> None:
    graph = onnx.load(str(data_path("models") / f"{name}.onnx")).graph
    as_it_is = {graph.input[0].name}
    for node in graph.node:
        if node.op_type in ("Reshape", "Transpose", "Concat") and as_it_is & set(node.input):
            as_it_is |= set(node.output)
    used = [node for node in graph.node if node.op_type != "Shape" and as_it_is & set(node.input)]
    assert {"Reshape", "Transpose"} < {node.op_type for node in used} <= {
        "Reshape", "Transpose", "Concat", "DequantizeLinear",
    }  # fmt: skip
