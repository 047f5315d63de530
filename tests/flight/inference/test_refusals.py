"""What must never run: damaged models, weights that are no numbers, another provider than the one asked for."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from flockd.cli import main
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.flight.inference import OnnxModel, load_manifest
from flockd.flight.inference.providers import Prepared, available
from flockd.flight.perception import OnnxNetworks
from flockd.flight.perception.requirements import check_roles
from tests.flight.inference.foreign import SIZE, image_input, map_output, write_model

MODELS = data_path("models")
ROOT = Path(__file__).parents[3]


def sign_again(manifest: Path) -> None:
    """As somebody would who exported a broken model: its hash is right."""
    old, file = hash_of(manifest), manifest.with_suffix(".onnx")
    manifest.write_text(manifest.read_text().replace(old, hashlib.sha256(file.read_bytes()).hexdigest()))


def hash_of(manifest: Path) -> str:
    return next(line.split()[1] for line in manifest.read_text().splitlines() if line.startswith("sha256"))


def flip_a_bit(manifest: Path) -> None:
    file = manifest.with_suffix(".onnx")
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 4
    file.write_bytes(content)


def truncate(manifest: Path) -> None:
    file = manifest.with_suffix(".onnx")
    file.write_bytes(file.read_bytes()[:-1000])


def truncate_and_sign(manifest: Path) -> None:
    truncate(manifest)
    sign_again(manifest)


def rename_an_input(manifest: Path) -> None:
    manifest.write_text(manifest.read_text().replace("  geometry:", "  rays:\n    carries: geometry"))


def change_a_dtype(manifest: Path) -> None:
    manifest.write_text(manifest.read_text().replace("dtype: uint8", "dtype: float32"))


def change_a_shape(manifest: Path) -> None:
    manifest.write_text(manifest.read_text().replace("    - 1\n    - 3\n", "    - 1\n    - 4\n"))


def put_in_a_nan(manifest: Path) -> None:
    file = manifest.with_suffix(".onnx")
    model = onnx.load(str(file))
    weight = next(i for i in model.graph.initializer if i.data_type == TensorProto.FLOAT and len(i.dims) == 4)
    values = numpy_helper.to_array(weight).copy()
    values.flat[values.size // 2] = np.nan
    weight.CopyFrom(numpy_helper.from_array(values, weight.name))
    onnx.save(model, str(file))
    sign_again(manifest)


@pytest.mark.fault("model-changed")
@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (flip_a_bit, "sha256: "),
        (truncate, "sha256: "),
        (truncate_and_sign, "cannot be loaded"),
        (rename_an_input, "inputs: the manifest names ['image', 'rays'] but the model file has ['geometry', 'image']"),
        (change_a_dtype, "inputs.image.dtype: the manifest says float32 but the model file uint8; make them agree"),
        (change_a_shape, "inputs.geometry.shape: the manifest says [1, 4, h/2, w/2] but the model file [1, 3, h2, w2]"),
        (put_in_a_nan, "output offset is not finite on the golden input; restore the model file"),
    ],
)
def test_a_start_with_a_damaged_model_ends_with_one_sentence(
    damage: Callable[[Path], None], expected: str, copies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copies / "neighbours_int8.yaml")
    drone = tmp_path / "drone.yaml"
    drone.write_text(
        (ROOT / "config" / "px4_sitl.yaml")
        .read_text()
        .replace("perception:\n", f"perception:\n  models_dir: {copies}\n")
    )
    images = tmp_path / "room" / "images"
    images.mkdir(parents=True)
    import cv2

    for index in range(2):
        noise = np.random.default_rng(index).integers(0, 255, (96, 128, 3), np.uint8)
        cv2.imwrite(str(images / f"{index}.png"), noise)
    (tmp_path / "room" / "K.txt").write_text("100 0 64\n0 100 48\n0 0 1\n")
    (tmp_path / "room" / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2)
    assert main(["replay", str(tmp_path / "room"), "--config", str(drone)]) == 78
    sentences = capsys.readouterr().err.splitlines()
    assert [line for line in sentences if "perception.scale" not in line] == [sentences[-1]]
    assert sentences[-1].startswith(str(copies / "neighbours_int8.yaml"))
    assert expected in sentences[-1]


@pytest.mark.skipif("cuda" in available(), reason="this computer can compute with CUDA")
def test_a_provider_that_is_not_there_is_refused_and_nothing_takes_its_place() -> None:
    with pytest.raises(
        ModelError,
        match=r"perception\.provider: this ONNX Runtime has no CUDAE.*; install onnxruntime-gpu in its place, or",
    ):
        OnnxNetworks(PerceptionConfig(provider="cuda", flow="flow"), MODELS)


@pytest.mark.parametrize("provider", ["cuda", "tensorrt"])
def test_a_network_in_8_bits_is_not_for_a_gpu(provider: str) -> None:
    """It would run it slower than the float one and without a warning."""
    config = PerceptionConfig.model_validate({"provider": provider})
    with pytest.raises(ModelError, match=rf"flow_int8 is made for cpu and openvino, not for {provider}; name another"):
        OnnxNetworks(config, MODELS)


@pytest.mark.skipif("cuda" in available(), reason="this computer can compute with CUDA")
def test_a_provider_that_onnx_runtime_silently_replaces_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a computer with onnxruntime-gpu and no driver: it is listed, and does not start."""
    listed = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(ort, "get_available_providers", lambda: listed)
    expected = r"CUDAExecutionProvider does not start here, and .* took CPUExecutionProvider"
    with pytest.warns(UserWarning, match="not in available"), pytest.raises(ModelError, match=expected):
        OnnxModel(MODELS / "flow.yaml", threads=1, provider="cuda")


def test_tensorrt_never_builds_in_flight(tmp_path: Path) -> None:
    with pytest.raises(
        ModelError,
        match=r"flow\.yaml:4: file: flow\.onnx is not prepared for tensorrt, .*; run `flockd models prepare`",
    ):
        OnnxModel(MODELS / "flow.yaml", threads=1, provider="tensorrt", engines=tmp_path)


def test_what_was_prepared_covers_what_lies_between(tmp_path: Path) -> None:
    shapes = [{"first": (1, 120, 160, 3)}, {"first": (1, 96, 216, 3)}, {"first": (16, 96, 160, 3)}]
    Prepared.over(shapes).save(tmp_path)
    prepared = Prepared.load(tmp_path)
    assert prepared is not None
    assert prepared.covers({"first": (4, 100, 200, 3)})
    assert not prepared.covers({"first": (17, 100, 200, 3)})
    assert not prepared.covers({"first": (1, 88, 200, 3)})
    assert not prepared.covers({"first": (1, 100, 200)})
    assert not prepared.covers({"second": (1, 100, 200, 3)})
    assert Prepared.load(tmp_path / "elsewhere") is None


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
    with pytest.raises(ModelError, match=r"broken\.yaml:4: file: CPUExecutionProvider cannot run broken\.onnx \(.*;"):
        OnnxModel(path, threads=1)


def test_a_mask_of_another_size_than_its_crop_is_refused(tmp_path: Path) -> None:
    for suffix in ("yaml", "onnx"):
        (tmp_path / f"distance.{suffix}").write_bytes((MODELS / f"distance.{suffix}").read_bytes())
    manifest = tmp_path / "distance.yaml"
    inputs, outputs = manifest.read_text(encoding="utf-8").split("outputs:")
    before, mask = outputs.split("  mask:")
    manifest.write_text(f"{inputs}outputs:{before}  mask:{mask.replace('- 96', '- 48')}", encoding="utf-8")
    with pytest.raises(ModelError, match=r"outputs\.mask\.shape: has to be as high and wide as the crop"):
        load_manifest(manifest, check_roles)
