"""`flockd models`: the networks, listed, verified, timed and prepared."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.flight.inference import load_manifest
from tests.flight.inference.foreign import one_channel_depth

FLOAT = ("detector", "distance", "flow", "neighbours", "verification")


def test_the_list_shows_hash_and_licence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", "list", "--json"]) == 0
    listed = {model["name"]: model for model in json.loads(capsys.readouterr().out)}
    assert sorted(listed) == sorted([*FLOAT, *(f"{name}_int8" for name in FLOAT if name != "detector")])
    assert {model["licence"] for model in listed.values()} == {"Apache-2.0"}
    assert listed["flow"]["sha256"] == load_manifest(data_path("models") / "flow.yaml")[0].sha256


def test_verify_names_the_damaged_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = one_channel_depth(tmp_path, output={})
    assert main(["models", "verify", "--dir", str(tmp_path)]) == 0
    path.with_suffix(".onnx").write_bytes(b"")
    assert main(["models", "verify", "--dir", str(tmp_path), "--json"]) == 1
    (verified,) = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert verified["model"] == "someones_depth"
    assert "sha256" in verified["fault"]


def test_bench_times_each_number_of_threads_and_says_what_entered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one_channel_depth(tmp_path, output={})
    command = ["models", "bench", "--dir", str(tmp_path), "--provider", "cpu", "--threads", "1,2", "--runs", "3"]
    assert main([*command, "--json"]) == 0
    timings = json.loads(capsys.readouterr().out)
    assert [(t["model"], t["provider"], t["threads"], t["input"]) for t in timings] == [
        ("someones_depth", "cpu", 1, "rgb 1x3x32x48"),
        ("someones_depth", "cpu", 2, "rgb 1x3x32x48"),
    ]
    assert all(0 < t["least_ms"] <= t["median_ms"] for t in timings)


def test_bench_does_not_time_one_provider_for_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from flockd.flight.inference.providers import available

    if "tensorrt" in available():
        pytest.skip("this computer has TensorRT")
    one_channel_depth(tmp_path, output={})
    command = ["models", "bench", "--dir", str(tmp_path), "--provider", "tensorrt", "--threads", "1", "--json"]
    assert main(command) == 1
    (timing,) = json.loads(capsys.readouterr().out)
    assert timing["median_ms"] is None
    assert "has no TensorrtExecutionProvider" in timing["fault"]


def test_on_the_cpu_there_is_nothing_to_prepare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drone = tmp_path / "drone.yaml"
    text = (data_path("config") / "px4_sitl.yaml").read_text()
    drone.write_text(text.replace("perception:\n", f"perception:\n  engines_dir: {tmp_path / 'engines'}\n"))
    assert load_drone(drone).perception.provider == "cpu"
    assert main(["models", "prepare", "--config", str(drone), "--json"]) == 0
    prepared = json.loads(capsys.readouterr().out)
    assert [one["model"] for one in prepared] == [
        *("flow_int8", "neighbours_int8", "detector", "distance_int8", "verification_int8")
    ]
    assert all(one["engines"] is None and one["start_s"] > 0 for one in prepared)
    assert not (tmp_path / "engines").exists()
