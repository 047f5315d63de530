"""A manifest says everything about a network's interface; what it says wrongly is refused in one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from onnx import helper

from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.flight.inference import OnnxModel, read_manifest
from flockd.flight.inference.feeds import feeds_for, golden_feeds
from flockd.flight.inference.fitting import fit
from flockd.flight.inference.manifest import Manifest
from tests.flight.inference.foreign import (
    SIZE,
    constant_flow,
    image_input,
    map_output,
    one_channel_depth,
    write_manifest,
)
from tests.flight.inference.foreign import write_model as write

WIDTH, HEIGHT = SIZE
CROP = {
    "fill": 0.5, "first_margin": 1.0, "cut_margin": 1.5, "mirror_scale": 0.9, "min_half_width_px": 4.0,
    "max_half_angle_deg": 30.0, "max_resize": 2.0, "max_crops": 3,
}  # fmt: skip


def changed(path: Path, section: str, key: str, changes: dict[str, Any]) -> None:
    document = yaml.safe_load(path.read_text())
    document[section][key] |= changes
    write_manifest(path, document)


def set_key(path: Path, **keys: Any) -> None:
    write_manifest(path, yaml.safe_load(path.read_text()) | keys)


def line_of(path: Path, start: str) -> int:
    return next(n for n, line in enumerate(path.read_text().splitlines(), 1) if line.strip().startswith(start))


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
    return write(
        folder, "regressor", "anything", nodes,
        inputs={"patch": image_input(shape=["n", 3, 24, 24])},
        outputs={"numbers": map_output(["n", 2], columns=["brightness", "darkness"])},
        weights=weights,
        **document,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "at", "complaint"),
    [
        ({"colour": "grey"}, "shape:", r"inputs\.rgb\.shape\[1\]: 3 is not the 1 of a grey image in nchw; correct"),
        ({"mean": [0.5]}, "mean:", r"inputs\.rgb\.mean: has 1 numbers for 3 channels; write one for each channel"),
        ({"layout": "nhcw"}, "layout:", r"inputs\.rgb\.layout: nhcw is not known; did you mean `nhwc`\?"),
        ({"shape": [1, 3, 32]}, "shape:", r"inputs\.rgb\.shape: has 3 axes; write the 4"),
        ({"white": 0}, "white:", r"inputs\.rgb\.white: 0 is not greater than 0; write a positive number"),
        ({"colors": "rgb"}, "colors:", r"inputs\.rgb\.colors: is not a known key; did you mean `colour`\?"),
        ({"kind": "planes"}, "rgb:", r"inputs: has no image; give one input `kind: image`"),
        (
            {"shape": [1, 3, 32, 64]}, "shape:",
            r"inputs\.rgb\.shape: the manifest says \[1, 3, 32, 64\] but the model file \[1, 3, 32, 48\]; make them",
        ),
        (
            {"shape": ["n", 3, 32, 48]}, "shape:",
            r"inputs\.rgb\.shape: the manifest says \[n, 3, 32, 48\] but the model file \[1, 3, 32, 48\]; make them",
        ),
        ({"dtype": "float16"}, "dtype:", r"inputs\.rgb\.dtype: the manifest says float16 but the model file float32"),
    ],
)  # fmt: skip
def test_an_input_that_cannot_be_is_refused_with_file_line_key_and_what_to_do(
    tmp_path: Path, changes: dict[str, Any], at: str, complaint: str
) -> None:
    path = one_channel_depth(tmp_path, output={})
    changed(path, "inputs", "rgb", changes)
    with pytest.raises(ModelError, match=complaint) as refused:
        OnnxModel(path, threads=1)
    line = line_of(path, at) + (2 if "shape[1]" in str(refused.value) else -1 if at == "rgb:" else 0)
    assert str(refused.value).startswith(f"{path}:{line}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ({"map_stride": 0}, r":\d+: map_stride: 0 is not at least 1; write a whole number from 1 to 64"),
        ({"crop": {**CROP, "fill": -1.0}}, r":\d+: crop\.fill: -1\.0 is not greater than 0; write a positive number"),
        ({"crop": {**CROP, "size": 24}}, r":\d+: crop\.size: is not a known key; the keys here are cut_margin, fill"),
        ({"crop": {"fill": 0.5}}, r":\d+: crop\.cut_margin: is missing; add it with a positive number"),
        ({"thresholds": {"p": float("nan")}}, r":\d+: thresholds\.p: \.nan is not finite; write a number"),
        ({"sha256": "123"}, r":\d+: sha256: '123' is not a SHA-256; write a SHA-256, 64 hex"),
        ({"outputs": {}}, r":\d+: outputs: a section; write a section"),
    ],
)
def test_a_key_that_cannot_be_is_refused_with_file_line_key_and_what_to_do(
    tmp_path: Path, keys: dict[str, Any], complaint: str
) -> None:
    path = crop_regressor(tmp_path)
    set_key(path, **keys)
    with pytest.raises(ModelError, match=complaint) as refused:
        read_manifest(path)
    assert str(refused.value).startswith(f"{path}:")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("columns", "complaint"),
    [
        (["a", "a"], r"outputs\.numbers\.columns: names 'a' twice; give each column its own name"),
        (["a"], r"outputs\.numbers\.columns: has 1 names for the shape \[n, 2\]; name each column of \(n, k\)"),
        (["a", "b", "c"], r"outputs\.numbers\.columns: has 3 names for the shape \[n, 2\]; name each"),
    ],
)
def test_columns_that_do_not_name_each_number_once_are_refused(
    tmp_path: Path, columns: list[str], complaint: str
) -> None:
    path = crop_regressor(tmp_path)
    changed(path, "outputs", "numbers", {"columns": columns})
    with pytest.raises(ModelError, match=complaint):
        read_manifest(path)


def test_an_output_is_read_by_the_names_of_its_columns(tmp_path: Path) -> None:
    for columns in (["brightness", "darkness"], ["darkness", "brightness"]):
        path = crop_regressor(tmp_path)
        changed(path, "outputs", "numbers", {"columns": columns})
        model = OnnxModel(path, threads=1)
        crops = [np.full((24, 24, 3), grey, np.uint8) for grey in (51, 204)]
        values = model.infer({"patch": crops})["numbers"]
        named = model.manifest.outputs["numbers"].by_column(values)
        np.testing.assert_allclose(named[columns[0]], [0.2, 0.8], rtol=1e-5)
        np.testing.assert_allclose(named[columns[1]], [0.8, 0.2], rtol=1e-5)
    with pytest.raises(ValueError, match=r"shape \(2, 3\) has not the columns darkness, brightness"):
        model.manifest.outputs["numbers"].by_column(np.zeros((2, 3), np.float32))


def test_crop_size_and_thresholds_come_from_the_manifest(tmp_path: Path) -> None:
    manifest = read_manifest(crop_regressor(tmp_path, thresholds={"probability": 0.25})).manifest
    assert manifest.crop_size_px == 24
    assert manifest.crop is not None
    assert (manifest.crop.fill, manifest.crop.max_crops) == (0.5, 3)
    assert manifest.threshold("probability") == 0.25
    with pytest.raises(ModelError, match=r"model regressor has no thresholds\.p; add it to its manifest"):
        manifest.threshold("p")
    whole = read_manifest(one_channel_depth(tmp_path, output={})).manifest
    with pytest.raises(ModelError, match="model someones_depth takes no crops"):
        _ = whole.crop_size_px


def test_crops_that_are_not_square_or_of_free_size_are_refused(tmp_path: Path) -> None:
    for shape in (["n", 3, 24, 32], ["n", 3, "h", "w"]):
        path = crop_regressor(tmp_path)
        changed(path, "inputs", "patch", {"shape": shape})
        with pytest.raises(ModelError, match="crop: is for models whose image input is square and of a fixed size"):
            read_manifest(path)


def test_a_batch_of_crops_enters_at_the_models_own_size(tmp_path: Path) -> None:
    manifest = read_manifest(crop_regressor(tmp_path)).manifest
    assert feeds_for(manifest, (640, 480), 5)["patch"].shape == (5, 3, 24, 24)


def planes_document(tmp_path: Path) -> dict[str, Any]:
    """The manifest of a network with an image of free size and two planes beside it."""
    document: dict[str, Any] = yaml.safe_load(one_channel_depth(tmp_path, output={}).read_text())
    document["inputs"] = {
        "image": image_input(shape=[1, 3, "h", "w"]),
        "rays": {**map_output([1, 2, "h/4", "w/4"]), "kind": "planes"},
    }
    return document | {"map_stride": 4, "size_multiple": 32, "golden_size": [64, 32]}


def test_planes_enter_at_the_stride_of_the_manifest(tmp_path: Path) -> None:
    manifest = Manifest.model_validate(planes_document(tmp_path), strict=False)
    assert not list(manifest.faults())
    assert golden_feeds(manifest)["rays"].shape == (1, 2, 8, 16)
    assert feeds_for(manifest, (100, 40))["rays"].shape == (1, 2, 16, 32)  # padded to 128 x 64


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda d: d.pop("map_stride"), r"map_stride: is missing; write how many image pixels one number"),
        (lambda d: d["inputs"]["rays"].update(dtype="uint8"), r"inputs\.rays\.dtype: uint8 is for images; write float"),
        (
            lambda d: d["inputs"]["rays"].update(shape=[1, "k", 8, 8]),
            r"inputs\.rays\.shape\[1\]: k is not fixed",
        ),
        (
            lambda d: d["inputs"]["rays"].update(shape=[2, 8, 8]),
            r"inputs\.rays\.shape: has 3 axes; write the 4",
        ),
        (lambda d: d["inputs"]["rays"].update(carries="image"), r"inputs: has two of which each carries 'image'; corr"),
    ],
)
def test_planes_that_nothing_can_fill_are_refused(tmp_path: Path, spoil: Any, complaint: str) -> None:
    document = planes_document(tmp_path)
    spoil(document)
    write_manifest(tmp_path / "planes.yaml", document)
    with pytest.raises(ModelError, match=complaint):
        read_manifest(tmp_path / "planes.yaml")


def test_sizes_that_the_file_leaves_free_the_manifest_may_fix(tmp_path: Path) -> None:
    path = constant_flow(tmp_path, (1.0, 1.0), ("w", "h"))
    for name in ("a", "b"):
        changed(path, "inputs", name, {"shape": [1, HEIGHT, WIDTH, 1]})
    assert OnnxModel(path, threads=1).manifest.fixed_size == SIZE


def test_an_output_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = constant_flow(tmp_path, (3.0, -2.0))
    document = yaml.safe_load(path.read_text())
    document["outputs"] = {"moved": document["outputs"]["motion"]}
    write_manifest(path, document)
    with pytest.raises(
        ModelError, match=r"outputs: the manifest names \['moved'\] but the model file has \['motion'\]"
    ):
        OnnxModel(path, threads=1)


@pytest.mark.parametrize(
    ("image", "enters"),
    [
        ((640, 480), (80, 60)),
        ((1280, 960), (160, 120)),
        ((320, 240), (80, 60)),
        ((480, 640), (60, 80)),
        ((64, 48), (64, 48)),
    ],
)
def test_a_small_image_enters_no_smaller_than_the_manifest_says(
    image: tuple[int, int], enters: tuple[int, int]
) -> None:
    """The shipped flow sees images of an eighth of the size, and of 60 pixels at least along the shorter side."""
    manifest = read_manifest(data_path("models") / "flow.yaml").manifest
    assert fit(manifest, image).inner == enters
