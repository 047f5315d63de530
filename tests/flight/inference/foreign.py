"""Tiny models as other people might export them, with their manifests."""

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

from flockd.flight.inference.feeds import golden_feeds
from flockd.flight.inference.manifest import Manifest

SIZE = (48, 32)


def image_input(**changes: Any) -> dict[str, Any]:
    """The image input of a network that takes what torch users feed: NCHW, 0 to 1."""
    width, height = SIZE
    plain = {"shape": [1, 3, height, width], "dtype": "float32", "layout": "nchw", "white": 1.0}
    return {**plain, "meaning": "image", "unit": "0-1", **changes}


def map_output(shape: Sequence[int | str], **changes: Any) -> dict[str, Any]:
    """The output that is a map."""
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
    """Writes model and manifest; ``golden=False`` leaves the golden output 0. Returns the manifest's path."""

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
    write_manifest(path, document)
    return path


def write_manifest(path: Path, document: dict[str, Any]) -> None:
    """Without anchors: lists that two keys share are written twice."""
    dumper = type("Dumper", (yaml.SafeDumper,), {"ignore_aliases": lambda self, data: True})
    path.write_text(yaml.dump(document, Dumper=dumper, sort_keys=False))


def one_channel_depth(folder: Path, *, channel: int = 0, output: dict[str, Any], **changes: Any) -> Path:
    """A depth network whose output is one channel of its image."""
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


def constant_flow(folder: Path, flow: tuple[float, float], size: tuple[int | str, int | str] = SIZE) -> Path:
    """A flow network in NHWC, in grey, whose output, in NHWC too, is the same for all images."""
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
