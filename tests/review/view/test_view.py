"""`flockd view`: Rerun is given what was recorded and what the networks make of it, and tells nobody."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.cli import installing, main
from flockd.onboard.recording.own_path import OwnPath
from flockd.onboard.recording.reader import RecordedStep, Recording
from tests.onboard.recording.made_up import record

NORMAL = Path(__file__).parents[2] / "review" / "replay" / "normal.mcap"
"""Ten steps of a simulated drone with small cameras."""
START_S, END_S = 2.0, 3.0

Capture = pytest.CaptureFixture[str]
Shown = dict[str, list[dict[str, Any]]]


def told(capsys: Capture, code: int, *arguments: object) -> tuple[str, str]:
    assert main(["view", *(str(argument) for argument in arguments)]) == code
    captured = capsys.readouterr()
    return captured.out, captured.err


def shown_in(path: Path) -> Shown:
    """Everything in a Rerun file: by entity, each row's values by name; times in nanoseconds."""
    from rerun.chunk import RrdReader

    found: Shown = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if not name.startswith("rerun.")]
        for row in range(batch.num_rows):
            cells = {name: batch.column(name)[row] for name in names}
            values = {name: cell.value if name == "time" else cell.as_py() for name, cell in cells.items()}
            found.setdefault(str(chunk.entity_path), []).append(values)
    return found


# -------------------------------------------------------------------------------------------- without Rerun or a screen


def test_without_rerun_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.delitem(sys.modules, "flockd.review.view.rerun_file", raising=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    out, err = told(capsys, 69, NORMAL, "--save", tmp_path / "x.rrd")
    assert (out, err) == ("", f"rerun is not installed; run: {installing('view')}\n")
    assert list(tmp_path.iterdir()) == []


def test_without_a_screen_it_offers_a_file(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    _, err = told(capsys, 69, NORMAL)
    assert err == "there is no screen here to open Rerun on; write a file for it with --save FILE.rrd\n"


@pytest.mark.parametrize("content", [None, b"not a recording", b"\x89MCAP0\r\n"])
def test_what_cannot_be_read_leaves_nothing(content: bytes | None, tmp_path: Path, capsys: Capture) -> None:
    bad = tmp_path / "bad.mcap"
    if content is not None:
        bad.write_bytes(content)
    before = set(tmp_path.iterdir())
    _, err = told(capsys, 1, bad, "--save", tmp_path / "bad.rrd")
    assert err.startswith(f"{bad}: ")
    assert err.count("\n") == 1
    assert set(tmp_path.iterdir()) == before


def test_a_spoilt_recording_leaves_nothing_half_written(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "drone1.mcap"
    record(path)
    content = bytearray(path.read_bytes())
    at = len(content) // 2
    content[at : at + 2000] = bytes(2000)
    path.write_bytes(content)
    _, err = told(capsys, 1, path, "--save", tmp_path / "x.rrd", "--as-recorded")
    assert "lost its message" in err.splitlines()[-1]
    assert [one.name for one in tmp_path.iterdir()] == ["drone1.mcap"]


# ------------------------------------------------------------------------------------------------------ what is shown


@pytest.fixture(scope="module")
def steps() -> list[RecordedStep]:
    recording = Recording(NORMAL)
    return list(recording.steps(recording.start_s + START_S - 1e-6, recording.start_s + END_S + 1e-6))


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """Three steps with the shipped networks."""
    path = tmp_path_factory.mktemp("view") / "normal.rrd"
    assert main(["view", str(NORMAL), "--start", str(START_S), "--end", str(END_S), "--save", str(path)]) == 0
    return shown_in(path)


def test_images_come_with_drones_and_depth(shown: Shown, steps: list[RecordedStep]) -> None:
    intrinsics = {camera.name: camera.intrinsics for camera in Recording(NORMAL).config.rig.cameras}
    for camera in ("front", "right", "back", "left"):
        entity = f"/world/drone/{camera}"
        images = shown[f"{entity}/image"]
        assert [row["step"] for row in images] == [step.number for step in steps]
        last = np.frombuffer(bytes(images[-1]["EncodedImage:blob"][0]), np.uint8)
        decoded = cv2.imdecode(last, cv2.IMREAD_COLOR)
        assert decoded is not None
        picture = decoded[..., ::-1].astype(float)
        assert np.abs(picture - steps[-1].frames.frames[camera].image).mean() < 5.0
        assert len(shown[f"{entity}/labels"]) == len(shown[f"{entity}/depth"]) == 3
        stored = np.frombuffer(bytes(shown[f"{entity}/depth"][-1]["EncodedDepthImage:blob"][0]), np.uint8)
        depth_cm = cv2.imdecode(stored, cv2.IMREAD_UNCHANGED)
        assert depth_cm is not None
        assert depth_cm.shape == picture.shape[:2]
        lens = intrinsics[camera]
        ground_m = (
            steps[-1].vehicle.height_m * lens.fy / (len(depth_cm) - lens.cy)
        )  # at the lower edge of a level image
        below = depth_cm[-1][depth_cm[-1] > 0] / 100
        assert np.median(below) == pytest.approx(ground_m, rel=0.2)


def test_neighbours_stand_where_they_were_tracked(shown: Shown, steps: list[RecordedStep]) -> None:
    path = OwnPath()
    for step, row, place in zip(steps, shown["/world/neighbours"], shown["/world/drone"][-3:], strict=True):
        assert step.output is not None
        velocity = step.output.get("velocity")
        own = path.go_on(step.frames.time_s, None if velocity is None else np.array(velocity), step.vehicle.height_m)
        np.testing.assert_allclose(place["Transform3D:translation"][0], own, atol=1e-5)
        expected = [own + neighbour["position"] for neighbour in step.output["neighbours"]]
        np.testing.assert_allclose(row["Points3D:positions"], expected, atol=1e-5)
        numbers = [label.split()[0] for label in row["Points3D:labels"]]
        assert numbers == [f"#{neighbour['track']}" for neighbour in step.output["neighbours"]]


def test_point_pairs_that_stand_still_stay_where_they_are(shown: Shown) -> None:
    """Both ends of a background pair that Algorithm 1 kept are one place: the own motion is what moved it."""
    none, *found = (row["LineStrips3D:strips"] for row in shown["/world/pairs/still"])
    assert none == []  # there is nothing before the first step
    for pairs in found:
        ends = np.array(pairs)
        assert len(ends) > 100
        assert np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)) < 0.3
        assert ends[..., 2].max() < 1.0  # nothing is below the ground


def test_commands_and_curves_are_the_recorded_ones(shown: Shown, steps: list[RecordedStep]) -> None:
    outputs = [step.output for step in steps if step.output is not None]
    arrows = [row["Arrows3D:vectors"][0] for row in shown["/world/command/velocity"]]
    np.testing.assert_allclose(arrows, [[*output["command"]["velocity"], 0.0] for output in outputs], atol=1e-6)
    speeds = [row["Scalars:scalars"][0] for row in shown["/curves/speed_m_s/commanded"]]
    np.testing.assert_allclose(speeds, [np.linalg.norm(output["command"]["velocity"]) for output in outputs])
    assert [row["time"] / 1e9 for row in shown["/curves/height_m"]] == [step.frames.time_s for step in steps]
    assert [row["Scalars:scalars"] for row in shown["/curves/height_m"]] == [[s.vehicle.height_m] for s in steps]


def test_as_recorded_nothing_is_computed(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "drone1.mcap"
    record(path, steps=3)
    out, err = told(capsys, 0, path, "--as-recorded", "--save", tmp_path / "x.rrd", "--json")
    assert err == ""
    assert {**json.loads(out), "recording": "", "file": ""} == {
        "recording": "", "file": "", "drone": "drone1", "steps": 3, "flown_again": 0, "as_recorded": 0,
    }  # fmt: skip
    entities = shown_in(tmp_path / "x.rrd")
    assert len(entities["/world/drone/front/image"]) == 3
    assert not [entity for entity in entities if entity.endswith(("/labels", "/depth")) or "pairs" in entity]


# -------------------------------------------------------------------------------------------------- nothing goes out


def test_the_viewer_is_started_deaf_and_dumb(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It listens to this computer alone, and what it would ask the web goes where nobody answers."""
    from flockd.review.view import rerun_file

    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    started: list[tuple[list[str], dict[str, str]]] = []

    def run(command: list[str], *, env: dict[str, str], check: bool) -> subprocess.CompletedProcess[bytes]:
        started.append((command, env))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr("subprocess.run", run)
    assert rerun_file.open_viewer(tmp_path / "x.rrd") == 0
    ((command, environment),) = started
    assert command[-4:] == ["--bind", "127.0.0.1", "--port", "auto"]
    assert "FORCE_RERUN_ANALYTICS" not in environment
    assert {environment[name] for name in ("HTTP_PROXY", "https_proxy", "ALL_PROXY")} == {"http://127.0.0.1:9"}


def test_no_statistics_are_collected(tmp_path: Path) -> None:
    """Where Rerun collects them, it opens a file for them in its user's folder: with us there is none."""
    from flockd.review.view.rerun_file import viewer_environment

    path = tmp_path / "drone1.mcap"
    record(path, steps=1)

    def written_by(environment: dict[str, str], home: Path) -> list[str]:
        home.mkdir()
        places = {"HOME": str(home), "XDG_DATA_HOME": str(home / "data"), "XDG_CONFIG_HOME": str(home / "config")}
        command = [sys.executable, "-m", "rerun_cli", "mcap", "info", str(path)]
        subprocess.run(command, env=environment | places, check=True, capture_output=True)
        return [one.name for one in home.rglob("*") if one.is_file() and one.parent.name == "analytics"]

    talkative = {name: value for name, value in os.environ.items() if name != "CI"}
    assert written_by(talkative, tmp_path / "theirs") != []
    assert written_by(viewer_environment(), tmp_path / "ours") == []
