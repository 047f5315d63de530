"""A manifest says everything about a network's interface; what it says wrongly is refused at its line and key."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from onnx import helper

from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.flight.inference import Manifest, OnnxModel
from flockd.flight.inference.manifest_file import read_manifest
from tests.flight.inference.foreign import (
    SIZE,
    image_input,
    map_output,
    one_channel_depth,
    write_manifest,
    write_model,
)

WIDTH, HEIGHT = SIZE
MODELS = data_path("models")
CROP = {
    "fill": 0.5, "first_margin": 1.0, "cut_margin": 1.5, "mirror_scale": 0.9, "min_half_width_px": 4.0,
    "max_half_angle_deg": 30.0, "max_resize": 2.0, "max_crops": 3,
}  # fmt: skip
GONE = object()


def changed(path: Path, changes: dict[str, Any], into: Path | None = None) -> Path:
    """The manifest with other values at dotted keys, in place or as this file."""
    document = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        *way, last = (int(name) if name.isdigit() else name for name in key.split("."))
        section = document
        for name in way:
            section = section[name]
        if value is GONE:
            del section[last]
        else:
            section[last] = value
    write_manifest(into or path, document)
    return into or path


def crop_regressor(folder: Path, **keys: Any) -> Path:
    """Takes crops of 24 x 24 and gives two numbers of each: their mean brightness, and one less that."""
    document: dict[str, Any] = {"crop": CROP, "golden_size": [24, 24], **keys}
    weights: dict[str, np.ndarray] = {"axis": np.array([1], np.int64), "ends": np.array([0, 1], np.float32)}
    nodes = [
        helper.make_node("ReduceMean", ["patch"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Unsqueeze", ["mean", "axis"], ["column"]),
        helper.make_node("Sub", ["column", "ends"], ["difference"]),
        helper.make_node("Abs", ["difference"], ["numbers"]),
    ]
    return write_model(
        folder, "regressor", "verification", nodes,
        inputs={"patch": image_input(shape=["n", 3, 24, 24])},
        outputs={"numbers": map_output(["n", 2], columns=["brightness", "darkness"])},
        weights=weights,
        **document,
    )  # fmt: skip


def with_planes(folder: Path) -> Path:
    """A network with an image of free size and two planes beside it."""
    inputs = {
        "image": image_input(shape=[1, 3, "h", "w"]),
        "rays": {**map_output([1, 2, "h/4", "w/4"]), "kind": "planes"},
    }
    changes = {"inputs": inputs, "map_stride": 4, "size_multiple": 32, "golden_size": [64, 32]}
    return changed(one_channel_depth(folder, output={}), changes)


def depth(folder: Path) -> Path:
    return one_channel_depth(folder, output={})


def shipped(name: str) -> Callable[[Path], Path]:
    return lambda folder: changed(MODELS / f"{name}.yaml", {}, folder / f"{name}.yaml")


@pytest.mark.parametrize(
    ("model", "changes", "key"),
    [
        (depth, {"inputs.rgb.colour": "grey"}, "inputs.rgb.shape[1]"),
        (depth, {"inputs.rgb.mean": [0.5]}, "inputs.rgb.mean"),
        (depth, {"inputs.rgb.shape": [1, 3, 32]}, "inputs.rgb.shape"),
        (depth, {"inputs.rgb.colors": "rgb"}, "inputs.rgb.colors"),
        (depth, {"inputs.rgb.kind": "planes"}, "inputs"),
        # other than the model file
        (depth, {"inputs.rgb.shape": [1, 3, 32, 64]}, "inputs.rgb.shape"),
        (depth, {"inputs.rgb.shape": ["n", 3, 32, 48]}, "inputs.rgb.shape"),
        (depth, {"inputs.rgb.dtype": "float16"}, "inputs.rgb.dtype"),
        (depth, {"inputs.more": image_input()}, "inputs.more"),
        (depth, {"outputs.moved": map_output([1, 2]) | {"golden_mean": 0.0, "golden_deviation": 0.0}}, "outputs"),
        (crop_regressor, {"map_stride": 0}, "map_stride"),
        (crop_regressor, {"crop.fill": -1.0}, "crop.fill"),
        (crop_regressor, {"crop.cut_margin": GONE}, "crop.cut_margin"),
        (crop_regressor, {"sha256": "123"}, "sha256"),
        (crop_regressor, {"outputs": {}}, "outputs"),
        (crop_regressor, {"outputs.numbers.columns": ["a", "a"]}, "outputs.numbers.columns"),
        (crop_regressor, {"outputs.numbers.columns": ["a"]}, "outputs.numbers.columns"),
        (crop_regressor, {"inputs.patch.shape": ["n", 3, 24, 32]}, "crop"),
        (crop_regressor, {"inputs.patch.shape": ["n", 3, "h", "w"]}, "crop"),
        (with_planes, {"map_stride": GONE}, "map_stride"),
        (with_planes, {"inputs.rays.dtype": "uint8"}, "inputs.rays.dtype"),
        (with_planes, {"inputs.rays.shape": [1, "k", 8, 8]}, "inputs.rays.shape[1]"),
        (with_planes, {"inputs.rays.shape": [2, 8, 8]}, "inputs.rays.shape"),
        (with_planes, {"inputs.rays.carries": "image"}, "inputs.rays.kind"),
        # for the roles of shipped ones
        (shipped("flow"), {"roles": ["stereo"]}, "roles[0]"),
        (shipped("flow"), {"roles": ["depth"]}, "inputs"),
        (shipped("flow"), {"outputs.flow.gives": "motion"}, "outputs"),
        (shipped("distance"), {"crop": GONE}, "crop"),
        (shipped("distance"), {"thresholds.drone_probability": GONE}, "thresholds.drone_probability"),
        (shipped("distance"), {"thresholds.drone_probability": 80}, "thresholds.drone_probability"),
        (shipped("distance"), {"outputs.range.columns.2": "up_px"}, "outputs.range.columns"),
        (shipped("distance"), {"inputs.picture.carries": GONE}, "inputs"),
        (shipped("verification"), {"thresholds.distance_logit_limit": GONE}, "thresholds.distance_logit_limit"),
        (shipped("verification"), {"outputs.drone.columns": ["sure"]}, "outputs.drone.columns"),
        (shipped("neighbours"), {"map_stride": GONE}, "map_stride"),
        (shipped("neighbours"), {"inputs.geometry.kind": GONE}, "inputs.geometry.shape[3]"),
        (shipped("neighbours"), {"inputs.geometry.carries": "sound"}, "inputs.geometry"),
        (shipped("neighbours"), {"thresholds.proposal_logit": 51.0}, "thresholds.proposal_logit"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_with_file_line_and_key(
    tmp_path: Path, model: Callable[[Path], Path], changes: dict[str, Any], key: str
) -> None:
    path = changed(model(tmp_path), changes)
    with pytest.raises(ModelError) as refused:
        if model is depth:
            OnnxModel(path, threads=1)
        else:
            read_manifest(path)
    found = re.fullmatch(rf"{re.escape(str(path))}:(\d+): {re.escape(key)}: .*; .*", str(refused.value))
    assert found, refused.value
    line = path.read_text().splitlines()[int(found[1]) - 1].strip()
    names = re.split(r"[.\[]", key.removesuffix("]"))
    assert line.startswith(("- ", *(f"{name}:" for name in names[-2:]))) or (found[1] == "1" and len(names) == 1)


def test_an_output_is_read_by_the_names_of_its_columns(tmp_path: Path) -> None:
    for columns in (["brightness", "darkness"], ["darkness", "brightness"]):
        written = changed(crop_regressor(tmp_path), {"outputs.numbers.columns": columns}).read_text()
        numbers = Manifest.model_validate(yaml.safe_load(written), strict=False).outputs["numbers"]
        named = numbers.by_column(np.array([[0.2, 0.8], [0.8, 0.2]], np.float32))
        np.testing.assert_allclose(named[columns[0]], [0.2, 0.8], rtol=1e-5)
        np.testing.assert_allclose(named[columns[1]], [0.8, 0.2], rtol=1e-5)
    with pytest.raises(ValueError, match="columns darkness, brightness"):
        numbers.by_column(np.zeros((2, 3), np.float32))
