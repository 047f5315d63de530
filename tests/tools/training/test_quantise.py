"""What quantising does besides ONNX Runtime's own. Needs the extra `train`."""

from __future__ import annotations

import onnx
import pytest

from flockd.core.data import data_path


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
