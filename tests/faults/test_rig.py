"""A rig that is not as its configuration says: flown in the simulator, told, compared, and corrected when asked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.core.messages import PilotOutput, ReasonKind
from flockd.flight.geometry import (
    Rig,
    RigCamera,
    RigidTransform,
    build_rig,
    rotation_angle_deg,
    rotation_from_vector,
)
from flockd.ground.calibration import from_flight
from flockd.ground.calibration.from_flight import found_rig
from flockd.ground.calibration.rig_calibration import CameraDeviation
from flockd.ground.doctor import Level, camera_checks
from flockd.ground.doctor.camera_checks import check_rig
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.reader import Recording
from flockd.sim.cameras import camera_simulator
from flockd.sim.cameras.camera_simulator import CameraSimulator, true_rigs
from flockd.sim.flock import swarm
from flockd.sim.scenario import ScenarioConfig, load_scenario
from tests.faults.stories import Reacted
from tests.flight.pilot.true_networks import TrueNetworks

pytestmark = pytest.mark.slow
CAMERAS = ("front", "right", "back", "left")
FAULTS = ("it is not turned as configured", "its time stamps are not as configured", "its focal length is not")
NAME = "drone1-20261124T120000000000Z.mcap"


class Told(Recorder):
    """A recorder that keeps the outputs too."""

    outputs: tuple[PilotOutput, ...] = ()

    def step(self, frames, vehicle, output, *others) -> None:  # type: ignore[no-untyped-def]
        self.outputs = (*self.outputs, output)
        super().step(frames, vehicle, output, *others)


def scenario(deg: float, late_s: float, focal: float, duration_s: float = 12.0) -> ScenarioConfig:
    """One drone in a light wind, its rig off by so much."""
    flight = load_scenario(
        data_path("config") / "paper_flight.yaml",
        {
            "duration_s": duration_s,
            "vehicle.gust_m_s": 0.3,
            "cameras.timing.delay_s": late_s,
            "cameras.rig.mounting_deg": deg,
            "cameras.rig.mounting_m": 0.02 if deg else 0.0,
            "cameras.rig.focal": focal,
        },
    )
    drone = flight.drone.model_copy(update={"name": "drone1"})
    return flight.model_copy(update={"drone": drone, "vehicles": flight.vehicles[:1]})


def flown(flight: ScenarioConfig, path: Path) -> tuple[PilotOutput, ...]:
    """With true maps, so that nothing but the rig is wrong; recorded."""
    cameras = CameraSimulator(flight, threads=0)
    with pytest.MonkeyPatch.context() as patch, Told(path, drone="drone1", config=flight.drone) as recorder:
        patch.setattr(swarm, "CameraSimulator", lambda *_, **__: cameras)
        patch.setattr(swarm, "load_networks", lambda _: TrueNetworks(cameras))
        swarm.fly(flight, recorders=[recorder], threads=0, pictured=False)
    return recorder.outputs


def found_once(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> tuple[CameraDeviation, ...]:
    """What the flight shows by the shipped networks; whoever asks for it from now on gets the same."""
    found = found_rig(recording)
    for module in (camera_checks, from_flight):
        monkeypatch.setattr(module, "found_rig", lambda *_, **__: found)
    return found


def apart_deg(found: Sequence[CameraDeviation], flight: ScenarioConfig, true: Rig) -> float:
    """How far what was found of one camera's mounting is off more than that of another: what the autopilot's velocity
    and attitude err by for half a minute turns all of them alike, by a degree and a half."""
    configured = build_rig(flight.drone.rig).cameras
    off = [
        true.cameras[one.camera].T_body_camera.rotation
        @ (rotation_from_vector(one.turn) @ configured[one.camera].T_body_camera.rotation).T
        for one in found
    ]
    return max(rotation_angle_deg(a.T @ b) for a in off for b in off)


def said_of_rig(outputs: Sequence[PilotOutput]) -> dict[str, float]:
    """Each sentence, and after how many seconds it was said."""
    told = dict[str, float]()
    for output in outputs:
        for reason in output.reasons:
            if reason.kind is ReasonKind.RIG:
                told.setdefault(reason.text, output.time_s - outputs[0].time_s)
    return told


@pytest.mark.fault("rig-off")
def test_a_rig_is_not_as_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two degrees, 2 cm, 30 ms and 2 %: flown on as configured; the next start says it with the correction."""
    flight = scenario(2.0, 0.03, 0.02, 30.0)
    outputs = flown(flight, tmp_path / NAME)
    assert not said_of_rig(outputs)
    assert outputs[-1].noisy_cameras == ()

    # Before the next flight the doctor compares them ...
    recording = Recording(tmp_path / NAME)
    assert recording.config.rig == flight.drone.rig
    found = found_once(recording, monkeypatch)
    findings = list(check_rig(recording.config, tmp_path))
    assert [(one.level, one.about) for one in findings] == [(Level.WARNING, f"camera {name}") for name in CAMERAS]
    assert all("--from-flight" in one.fix for one in findings)
    assert all(fault in one.measured for one in findings for fault in FAULTS[1:])
    assert any(FAULTS[0] in one.measured for one in findings)
    (true,) = true_rigs(flight)
    assert apart_deg(found, flight, true) < 0.5

    # ... and who asks for it gets the corrected rig.
    out = tmp_path / "rig.yaml"
    assert main(["calibrate", "rig", "--from-flight", str(tmp_path / NAME), "--out", str(out)]) == 0
    assert "taken: [mounting, focal length]" in capsys.readouterr().out
    corrected = load_drone(out).rig
    assert corrected.time_offset_s == pytest.approx(-0.03, abs=0.005)
    for name, one in build_rig(corrected).cameras.items():
        assert one.camera.focal_px == pytest.approx(true.cameras[name].camera.focal_px, rel=0.005)

    # With that rig there is nothing to compare the flight with any more.
    (finding,) = check_rig(recording.config.model_copy(update={"rig": corrected}), tmp_path)
    assert finding.level is Level.PASS
    assert "differs from that of the last flight" in finding.measured


@pytest.mark.fault("camera-elsewhere", within_s=20.0)
@pytest.mark.parametrize(
    "axes",
    [{"front": (math.pi, 0.0, 0.0)}, {"left": (0.0, 0.0, math.pi), "right": (0.0, 0.0, math.pi)}],
    ids=["front upside down", "left and right swapped"],
)
def test_a_camera_is_upside_down_or_two_are_swapped(
    axes: dict[str, tuple[float, float, float]],
    tmp_path: Path,
    reacted: Reacted,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = scenario(0.0, 0.0, 0.0)
    cameras = dict(build_rig(flight.drone.rig).cameras)
    for name, axis in axes.items():
        mount = cameras[name].T_body_camera
        turned = RigidTransform(rotation_from_vector(np.array(axis)) @ mount.rotation, mount.translation)
        cameras[name] = RigCamera(name, cameras[name].camera, turned)
    monkeypatch.setattr(camera_simulator, "true_rigs", lambda scenario: [Rig(cameras)])
    outputs = flown(flight, tmp_path / NAME)
    told = said_of_rig(outputs)
    assert len(told) == len(axes)
    for name in axes:
        (text,) = [text for text in told if text.startswith(f"camera {name}: it moves otherwise than the drone")]
        assert text.endswith("turned as configured? The drone flies without it.")
        reacted("camera-elsewhere", told[text])
    assert set(outputs[-1].noisy_cameras) == set(axes)
    found = [one for one in check_rig(flight.drone, tmp_path) if one.level is Level.FAILURE]
    assert [one.about for one in found] == [f"camera {name}" for name in CAMERAS if name in axes]
    assert all("flockd cameras --picture" in one.fix for one in found)


@pytest.mark.fault("rig-off")
def test_a_rig_as_configured_is_flown_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = scenario(0.0, 0.0, 0.0)
    assert not said_of_rig(flown(flight, tmp_path / NAME))
    found = found_once(Recording(tmp_path / NAME), monkeypatch)
    assert [one.camera for one in found] == list(CAMERAS)
    assert apart_deg(found, flight, build_rig(flight.drone.rig)) < 0.5
    (finding,) = check_rig(flight.drone, tmp_path)
    assert finding.level is Level.PASS
    assert "4 cameras were as configured" in finding.measured
    assert main(["calibrate", "rig", "--from-flight", str(tmp_path / NAME), "--out", str(tmp_path / "rig.yaml")]) == 1
    assert "the rig needs no correction" in capsys.readouterr().err
