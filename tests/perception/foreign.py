"""Tiny models as others might export them, with their manifests."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import yaml
from onnx import TensorProto, helper, numpy_helper

from flockd.inference.manifest import Manifest
from flockd.inference.session import golden_feeds

SIZE = (48, 32)


def image_input(**changes: Any) -> dict[str, Any]:
    """Of a network that takes what torch users feed: NCHW, 0 to 1."""
    width, height = SIZE
    plain = {"shape": [1, 3, height, width], "dtype": "float32", "layout": "nchw", "white": 1.0}
    return {**plain, "meaning": "image", "unit": "0-1", **changes}


def map_output(shape: Sequence[int | str], **changes: Any) -> dict[str, Any]:
    """Of any map."""
    return {"shape": list(shape), "dtype": "float32", "meaning": "map", "unit": "1", **changes}


def write_model(
    folder: Path,
    name: str,
    role: str,
    nodes: Sequence[onnx.NodeProto],
    *,
    inputs: dict[str, dict[str, Any]],
    outputs: dict[str, dict[str, Any]],
    weights: dict[str, np.ndarray] | None = None,
    golden: bool = True,
    **keys: Any,
) -> Path:
    """Writes model and manifest; ``golden=False`` leaves the golden answer 0. Returns the manifest's path."""

    def info(tensor: str, spec: dict[str, Any]) -> onnx.ValueInfoProto:
        kinds = {"float32": TensorProto.FLOAT, "float16": TensorProto.FLOAT16, "uint8": TensorProto.UINT8}
        return helper.make_tensor_value_info(tensor, kinds[spec["dtype"]], spec["shape"])

    graph = helper.make_graph(
        list(nodes), name,
        [info(tensor, spec) for tensor, spec in inputs.items()],
        [info(tensor, spec) for tensor, spec in outputs.items()],
        [numpy_helper.from_array(value, key) for key, value in (weights or {}).items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    file = folder / f"{name}.onnx"
    onnx.save(model, str(file))
    document: dict[str, Any] = {
        "name": name,
        "roles": [role],
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "description": "made in a test",
        "inputs": inputs,
        "outputs": {key: {**spec, "golden_mean": 0.0, "golden_deviation": 0.0} for key, spec in outputs.items()},
        "golden_size": list(SIZE),
        "licence": "Apache-2.0",
        "data": "none",
        "accuracy": {},
        "command": "pytest",
        **keys,
    }
    if golden:
        feeds = golden_feeds(Manifest.model_validate(document, strict=False))
        session = ort.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        for key, value in zip(outputs, session.run(list(outputs), feeds), strict=True):
            document["outputs"][key] |= {"golden_mean": float(value.mean()), "golden_deviation": float(value.std())}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def one_channel_depth(folder: Path, *, channel: int = 0, output: dict[str, Any], **changes: Any) -> Path:
    """A depth network that says what one channel of its image holds."""
    width, height = SIZE
    weights = {"which": np.array([channel], np.int64), "axis": np.array([1], np.int64)}
    nodes = [
        helper.make_node("Gather", ["rgb", "which"], ["kept"], axis=1),
        helper.make_node("Squeeze", ["kept", "axis"], ["disparity"]),
    ]
    return write_model(
        folder, "someones_depth", "depth", nodes,
        inputs={"rgb": image_input(carries="image", **changes)},
        outputs={"disparity": map_output([1, height, width], gives="depth", **output)},
        weights=weights,
    )  # fmt: skip
