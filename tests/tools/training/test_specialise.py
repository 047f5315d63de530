"""The second stage is fine-tuned for one drone, by one command. Needs the extra `train`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import onnx
import pytest
import torch
import trimesh
import yaml

from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel
from flockd.flight.perception import OnnxNetworks
from flockd.flight.perception.requirements import check_roles
from flockd.sim.drone_models import drone_model
from tests.ground.pictures.photographs import LABELS, RENDERED
from tools.training.specialise import main

ROOT = Path(__file__).resolve().parents[3]
MODELS = data_path("models")
LITTLE = ("--minutes", "0.4", "--processes", "1", "--threads", "1")


def run(*options: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tools.training.specialise", *map(str, options)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=900)


def drone_file(folder: Path) -> Path:
    """A plus-shaped drone of the simulator, in millimetres."""
    model = drone_model(5, 0)
    path = folder / "plus.stl"
    trimesh.Trimesh(1000.0 * model.vertices * [1, -1, -1], model.triangles).export(path)
    return path


@pytest.mark.slow
def test_a_mesh_becomes_a_distance_network_that_a_configuration_can_name(tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in MODELS.iterdir() if path.is_file()}
    mesh, size_m, out = drone_file(tmp_path), drone_model(5, 0).size_m, tmp_path / "mine"
    options = ("--mesh", mesh, "--size-m", f"{size_m:.3f}", "--out", out, *LITTLE)
    done = run(*options)
    assert done.returncode == 0, done.stderr
    assert f"distance: {out / 'distance_int8.yaml'}" in done.stdout
    for name in ("distance", "distance_int8"):
        model = OnnxModel(out / f"{name}.yaml", threads=1, check=check_roles)
        assert "plus.stl" in model.manifest.data
        assert model.manifest.command.startswith("tools.training.specialise --mesh")
        told = {what.split(":")[0] for what in model.manifest.accuracy}
        assert {"before", "after"} <= told
    networks = OnnxNetworks(PerceptionConfig(distance=str(out / "distance_int8.yaml")), MODELS)
    assert networks.second_stage is not None
    ours, theirs = ((folder / "distance.onnx").read_bytes() for folder in (out, MODELS))
    assert ours != theirs, "it learnt"
    curve = (out / "work" / "run" / "curve.csv").read_text(encoding="utf-8")
    assert "forgotten" in curve.splitlines()[0], "the general network teaches along"
    begun, learnt = (
        torch.load(out / "work" / "run" / f"{name}.pt")["net"]["head.bias"] for name in ("start", "checkpoint")
    )
    (written,) = [one for one in onnx.load(str(out / "distance.onnx")).graph.initializer if one.name == "head.bias"]
    assert onnx.numpy_helper.to_array(written) == pytest.approx((0.65 * learnt + 0.35 * begun).numpy(), abs=1e-6)
    assert onnx.numpy_helper.to_array(written) != pytest.approx(learnt.numpy(), abs=1e-6), "drawn back"
    assert {path.name: path.read_bytes() for path in MODELS.iterdir() if path.is_file()} == before, (
        "the general networks stay"
    )
    again = run(*options)
    assert again.returncode == 2
    assert "holds a distance network already; name another folder" in again.stderr


@pytest.mark.slow
def test_photographs_become_a_verification_network(tmp_path: Path) -> None:
    out = tmp_path / "mine"
    done = run("--pictures", RENDERED, "--labels", LABELS, "--out", out, *LITTLE)
    assert done.returncode == 0, done.stderr
    assert f"verification: {out / 'verification_int8.yaml'}" in done.stdout
    figures = yaml.safe_load((out / "verification_int8.yaml").read_text(encoding="utf-8"))["accuracy"]
    found = float(figures["after: drones called a drone"].rstrip("%"))
    assert found > 50, "two photographs that it did not learn from"
    networks = OnnxNetworks(PerceptionConfig(verification=str(out / "verification_int8.yaml")), MODELS)
    assert networks.second_stage is not None


def test_too_few_photographs_and_anothers_folder_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    coco = json.loads(LABELS.read_text(encoding="utf-8"))
    coco["annotations"] = coco["annotations"][:3]
    few = tmp_path / "few.json"
    few.write_text(json.dumps(coco), encoding="utf-8")
    mesh = drone_file(tmp_path)
    work = tmp_path / "taken" / "work"
    work.mkdir(parents=True)
    (work / "drone.json").write_text(json.dumps({"mesh": "other.stl"}), encoding="utf-8")
    for options, said in (
        (("--pictures", RENDERED, "--labels", few), "few.json: has 3 pictures with a drone, and 8 are the fewest"),
        (("--pictures", RENDERED), "--pictures needs --labels"),
        (("--mesh", mesh), "--mesh needs --size-m"),
        (("--mesh", mesh, "--size-m", "0.2"), "--size-m 0.2 m fits none"),
        (("--mesh", mesh, "--size-m", "0.78"), "holds the work on another drone or size; name another folder"),
    ):
        with pytest.raises(SystemExit) as refused:
            main([*map(str, options), "--out", str(tmp_path / "taken")])
        assert refused.value.code == 2
        assert said in capsys.readouterr().err
    assert list(work.iterdir()) == [work / "drone.json"], "nothing was begun"
