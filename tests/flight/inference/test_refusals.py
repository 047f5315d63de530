"""What must never run: damaged models, weights that are no numbers, another provider than the one asked for."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from flockd.cli import main
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.flight.inference import OnnxModel
from flockd.flight.inference.providers import available
from flockd.flight.perception import OnnxNetworks
from tests.flight.inference.foreign import SIZE, image_input, map_output, write_model

MODELS = data_path("models")


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 4
    file.write_bytes(content)


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1000])


def put_in_a_nan(file: Path) -> None:
    model = onnx.load(str(file))
    weight = next(i for i in model.graph.initializer if i.data_type == TensorProto.FLOAT and len(i.dims) == 4)
    values = numpy_helper.to_array(weight).copy()
    values.flat[values.size // 2] = np.nan
    weight.CopyFrom(numpy_helper.from_array(values, weight.name))
    onnx.save(model, str(file))


@pytest.mark.fault("model-changed")
@pytest.mark.parametrize(
    ("damage", "signed", "expected"),
    [
        (flip_a_bit, False, "sha256: "),
        (truncate, False, "sha256: "),
        (truncate, True, "cannot be loaded"),
        (put_in_a_nan, True, "outputs?.* is not finite on the golden input"),
    ],
)
def test_a_damaged_model_is_refused_also_with_the_hash_of_whoever_exported_it_so(
    damage: Callable[[Path], None], signed: bool, expected: str, copies: Path
) -> None:
    manifest = copies / "neighbours_int8.yaml"
    damage(manifest.with_suffix(".onnx"))
    if signed:
        digest = hashlib.sha256(manifest.with_suffix(".onnx").read_bytes()).hexdigest()
        manifest.write_text(re.sub("sha256: .*", f"sha256: {digest}", manifest.read_text()))
    with pytest.raises(ModelError, match=f"^{manifest}.*{expected}"):
        OnnxModel(manifest, threads=1)


@pytest.mark.fault("model-changed")
def test_a_start_with_a_damaged_model_ends_with_one_sentence(
    copies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flip_a_bit(copies / "neighbours_int8.onnx")
    drone = tmp_path / "drone.yaml"
    shipped = (MODELS.parent / "config" / "px4_sitl.yaml").read_text()
    drone.write_text(shipped.replace("perception:\n", f"perception:\n  models_dir: {copies}\n"))
    room = tmp_path / "room"
    (room / "images").mkdir(parents=True)
    for index in range(2):
        noise = np.random.default_rng(index).integers(0, 255, (96, 128, 3), np.uint8)
        cv2.imwrite(str(room / "images" / f"{index}.png"), noise)
    (room / "K.txt").write_text("100 0 64\n0 100 48\n0 0 1\n")
    assert main(["replay", str(room), "--config", str(drone)]) == 78
    sentences = capsys.readouterr().err.splitlines()
    assert [line for line in sentences if "perception.scale" not in line] == [sentences[-1]]
    assert sentences[-1].startswith(str(copies / "neighbours_int8.yaml"))


@pytest.mark.skipif("cuda" in available(), reason="this computer can compute with CUDA")
def test_a_provider_that_is_not_there_is_refused_and_nothing_takes_its_place() -> None:
    with pytest.raises(ModelError, match=r"perception\.provider: .*; install onnxruntime-gpu"):
        OnnxNetworks(PerceptionConfig(provider="cuda", flow="flow"), MODELS)


@pytest.mark.parametrize("provider", ["cuda", "tensorrt"])
def test_a_network_in_8_bits_is_not_for_a_gpu(provider: str) -> None:
    """It would run it slower than the float one and without a warning."""
    config = PerceptionConfig.model_validate({"provider": provider})
    with pytest.raises(ModelError, match=f"flow_int8 .*{provider};"):
        OnnxNetworks(config, MODELS)


@pytest.mark.skipif("cuda" in available(), reason="this computer can compute with CUDA")
def test_a_provider_that_onnx_runtime_silently_replaces_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a computer with onnxruntime-gpu and no driver: it is listed, and does not start."""
    listed = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(ort, "get_available_providers", lambda: listed)
    with pytest.warns(UserWarning), pytest.raises(ModelError, match=r"CUDAExecution.*CPUExecution"):
        OnnxModel(MODELS / "flow.yaml", threads=1, provider="cuda")


def test_tensorrt_never_builds_in_flight(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"flow\.yaml:4: file: .*tensorrt.*; run `flockd models prepare`"):
        OnnxModel(MODELS / "flow.yaml", threads=1, provider="tensorrt", engines=tmp_path)


def test_a_provider_that_cannot_run_a_model_is_an_error_of_one_sentence(tmp_path: Path) -> None:
    """It loads, and fails with the golden input."""
    width, height = SIZE
    weights = {"shape": np.array([1, 3, height, width + 1], np.int64)}
    path = write_model(
        tmp_path, "broken", "flow", [helper.make_node("Reshape", ["a", "shape"], ["flow"])],
        inputs={"a": image_input(carries="first"), "second": image_input()},
        outputs={"flow": map_output([1, "c", height, "w"])},
        weights=weights, golden=False,
    )  # fmt: skip
    with pytest.raises(ModelError, match=r"broken\.yaml:4: file: CPUExecutionProvider .*;"):
        OnnxModel(path, threads=1)
