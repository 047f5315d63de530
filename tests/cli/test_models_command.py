"""`flockd models`: the networks, listed, verified and prepared."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.flight.inference import OnnxModel, load_manifest
from flockd.flight.inference.providers import available
from tests.conftest import Told
from tests.flight.inference.foreign import one_channel_depth

FLOAT = ("detector", "distance", "flow", "neighbours", "verification")


def test_the_list_shows_hash_and_licence(told: Told) -> None:
    listed = {model["name"]: model for model in json.loads(told(0, "models", "list", "--json"))}
    assert sorted(listed) == sorted([*FLOAT, *(f"{name}_int8" for name in FLOAT if name != "detector")])
    assert {model["licence"] for model in listed.values()} == {"Apache-2.0"}
    assert listed["flow"]["sha256"] == load_manifest(data_path("models") / "flow.yaml")[0].sha256


@pytest.mark.parametrize("command", ["list", "verify"])
def test_models_in_an_empty_folder_are_unavailable(command: str, tmp_path: Path, told: Told) -> None:
    assert told(69, "models", command, "--dir", tmp_path).startswith(f"{tmp_path} holds no model manifests; ")


def test_verify_names_the_damaged_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = one_channel_depth(tmp_path, output={})
    assert main(["models", "verify", "--dir", str(tmp_path)]) == 0
    path.with_suffix(".onnx").write_bytes(b"")
    assert main(["models", "verify", "--dir", str(tmp_path), "--json"]) == 1
    (verified,) = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert verified["model"] == "someones_depth"
    assert "sha256" in verified["fault"]
    path.write_text("name: someones_depth\n", encoding="utf-8")
    assert main(["models", "verify", "--dir", str(tmp_path), "--json"]) == 1
    (verified,) = json.loads(capsys.readouterr().out)
    assert (verified["model"], verified["ok"]) == ("someones_depth", False)
    assert verified["fault"].startswith(f"{path}:1: accuracy: is missing")
    assert main(["models", "list", "--dir", str(tmp_path)]) == 78


def test_a_provider_that_is_not_installed_is_named(tmp_path: Path) -> None:
    if "tensorrt" in available():
        pytest.skip("this computer has TensorRT")
    with pytest.raises(ModelError, match="has no TensorrtExecutionProvider"):
        OnnxModel(one_channel_depth(tmp_path, output={}), threads=1, provider="tensorrt", preparing=True)


def test_on_the_cpu_there_is_nothing_to_prepare(tmp_path: Path, told: Told) -> None:
    drone = tmp_path / "drone.yaml"
    text = (data_path("config") / "px4_sitl.yaml").read_text()
    drone.write_text(text.replace("perception:\n", f"perception:\n  engines_dir: {tmp_path / 'engines'}\n"))
    assert load_drone(drone).perception.provider == "cpu"
    prepared = json.loads(told(0, "models", "prepare", "--config", drone, "--json"))
    assert [one["model"] for one in prepared] == [
        *("flow_int8", "neighbours_int8", "detector", "distance_int8", "verification_int8")
    ]
    assert all(one["engines"] is None and one["start_s"] > 0 for one in prepared)
    assert not (tmp_path / "engines").exists()
