"""The rig that a flight found, as a recording has it: taken over where it is known, compared by the doctor."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.messages import FloatArray, FrameSet, PilotOutput, Reason, ReasonKind, VehicleState
from flockd.flight.geometry import PointPairs, build_rig, rotation_from_vector
from flockd.flight.perception import Observation
from flockd.flight.pilot import StepTrace
from flockd.flight.pilot.camera_agreement import moves_otherwise
from flockd.ground.calibration import from_flight
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.calibration.from_flight import corrected_rig, found_rig
from flockd.ground.calibration.rig_calibration import PRIOR_TURN_RAD, CameraDeviation
from flockd.ground.doctor import Finding, Level, camera_checks
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.recording.reader import Recording
from tests.make import filled
from tests.onboard.recording.made_up import drone_config, inputs

NAME = "drone1-20261124T120000000000Z.mcap"
TURN = np.radians([0.3, -1.9, 0.5])
WELL = (math.radians(0.1), math.radians(0.1), math.radians(0.1), 0.001, 0.003)
"""Standard deviations."""


def seen(
    camera: str,
    turn: FloatArray = TURN,
    time_s: float = -0.03,
    focal: float = 1.02,
    sigmas: tuple[float, ...] = WELL,
) -> CameraDeviation:
    return CameraDeviation(camera, turn, time_s, focal, np.diag(np.array(sigmas) ** 2), np.zeros(2), np.ones(2))


def recorded(folder: Path, steps: int = 2, change: Callable[[PilotOutput], PilotOutput] = lambda one: one) -> Recording:
    """A flight of two cameras."""
    with Recorder(folder / NAME, drone="drone1", config=drone_config()) as recorder:
        for frames, vehicle in inputs(steps):
            output: PilotOutput = filled(PilotOutput, 0.5)
            recorder.step(frames, vehicle, change(replace(output, time_s=frames.time_s)))
            recorder.drain()
    return Recording(folder / NAME)


def examined(
    monkeypatch: pytest.MonkeyPatch, config: DroneConfig, folder: Path, *found: CameraDeviation
) -> list[Finding]:
    """What the doctor finds of drone1's last flight, in which this was found."""
    monkeypatch.setattr(camera_checks, "found_rig", lambda recording, last_s: found)
    return list(camera_checks.check_rig(config.model_copy(update={"name": "drone1"}), folder))


def test_what_was_found_is_taken_over(tmp_path: Path) -> None:
    recording, out = recorded(tmp_path), tmp_path / "rig.yaml"
    result = corrected_rig(recording, (seen("front"), seen("left")), "flight", out)
    assert result["cameras"]["front"]["taken"] == ["mounting", "focal length"]
    before, after = recording.config.rig, load_drone(out).rig
    assert after.time_offset_s == pytest.approx(before.time_offset_s - 0.03)
    for one, other in zip(before.cameras, after.cameras, strict=True):
        assert other.intrinsics.fx == pytest.approx(1.02 * one.intrinsics.fx)
        assert other.intrinsics.cx == one.intrinsics.cx
        assert other.extrinsics.position_m == one.extrinsics.position_m
    for name, mounted in build_rig(after).cameras.items():
        expected = rotation_from_vector(TURN) @ build_rig(before).cameras[name].T_body_camera.rotation
        assert mounted.T_body_camera.rotation == pytest.approx(expected, abs=1e-5)


def test_what_is_not_known_is_kept_and_named(tmp_path: Path) -> None:
    vague = (WELL[0], WELL[1], math.radians(1.2), 0.02, 0.02)
    recording, out = recorded(tmp_path), tmp_path / "rig.yaml"
    result = corrected_rig(recording, (seen("front", sigmas=vague), seen("left")), "flight", out)
    assert result["cameras"]["front"]["taken"] == []
    assert result["cameras"]["left"]["taken"] == ["mounting", "focal length"]
    assert len(result["notes"]) == 1 and "mounting of front is known to 1.2 degrees" in result["notes"][0]
    assert load_drone(out).rig.cameras[0] == recording.config.rig.cameras[0]
    assert result["time_offset_s"] == pytest.approx(-0.03)  # by the camera that knows it


def test_a_rolling_shutter_is_said(tmp_path: Path) -> None:
    def rolled(one: CameraDeviation) -> CameraDeviation:
        return replace(one, readout_s=np.array([-0.017, 0.001]), readout_sigma_s=np.array([0.002, 0.002]))

    turned, as_configured = rolled(seen("front")), rolled(seen("front", np.zeros(3), 0.0, 1.0))
    said = "rows are read over the images' width in -17 +- 2 ms: a rolling shutter"
    recording, found = recorded(tmp_path), (as_configured, replace(as_configured, camera="left"))
    assert corrected_rig(recording, (turned, seen("left")), "flight", tmp_path / "rig.yaml")["notes"] == [said]
    with pytest.raises(CalibrationError, match=rf"needs no correction: {re.escape(said)}; what is known agrees"):
        corrected_rig(recording, found, "flight", tmp_path / "again.yaml")


def test_of_a_camera_that_is_elsewhere_nothing_is_taken_and_the_doctor_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = replace(seen("front", time_s=-0.3), elsewhere=True), seen("left")
    recording, out = recorded(tmp_path), tmp_path / "rig.yaml"
    result = corrected_rig(recording, found, "flight", out)
    assert result["cameras"]["front"]["taken"] == []
    assert result["notes"][0].startswith("camera front: it moves otherwise than the drone")
    assert load_drone(out).rig.cameras[0] == recording.config.rig.cameras[0]
    assert result["time_offset_s"] == pytest.approx(-0.03)
    front, left = examined(monkeypatch, recording.config, tmp_path, *found)
    assert (front.level, front.about) == (Level.FAILURE, "camera front")
    assert (left.level, left.about) == (Level.WARNING, "camera left")


LITTLE = (np.radians([0.1, -0.2, 0.1]), 0.002, 1.004)


@pytest.mark.parametrize(
    ("found", "told"),
    [
        ((seen("front", *LITTLE), seen("left", *LITTLE)), "the rig needs no correction"),
        ((), "does not show the rig"),
    ],
    ids=["agrees", "silent"],
)
def test_what_agrees_or_is_not_said_is_not_replaced(
    found: tuple[CameraDeviation, ...], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = recorded(tmp_path)
    with pytest.raises(CalibrationError, match=told):
        corrected_rig(recording, found, "flight", tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()
    (finding,) = examined(monkeypatch, recording.config, tmp_path, *found)
    assert (finding.level, finding.about) == (Level.PASS, "rig")


def test_times_of_cameras_that_do_not_agree_are_named(tmp_path: Path) -> None:
    found = seen("front", time_s=-0.01), seen("left", time_s=-0.05)
    result = corrected_rig(recorded(tmp_path), found, "flight", tmp_path / "rig.yaml")
    assert result["time_offset_s"] == pytest.approx(-0.03)
    assert "20 ms off the others'" in result["notes"][0]


class StubPilot:
    """Sees two cameras that show nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        self._before: Observation | None = None

    def step(self, frames: FrameSet, vehicle: VehicleState, trace: StepTrace, _: object) -> PilotOutput:
        trace.observation = self._before = Observation(frames.time_s, vehicle, {}, (), self._before)
        output: PilotOutput = filled(PilotOutput, 0.5)
        return output


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(from_flight, "FlockPilot", StubPilot)
    monkeypatch.setattr(from_flight, "load_side_by_side", lambda config: None)
    points, pixels = np.zeros((0, 3)), np.zeros((0, 2))
    nothing = PointPairs(points, points, np.zeros(0, np.str_), pixels, pixels)
    monkeypatch.setattr(from_flight, "background_pairs", lambda *_: nothing)


@pytest.mark.usefixtures("stubbed")
def test_a_camera_that_was_flown_without_is_elsewhere_and_a_short_flight_says_nothing(tmp_path: Path) -> None:
    def told(output: PilotOutput) -> PilotOutput:
        text = f"{moves_otherwise('left')} The drone flies without it."
        return replace(output, reasons=(Reason(ReasonKind.RIG, text),) if output.time_s > 1005.9 else ())

    recording, done = recorded(tmp_path, 61, told), list[tuple[int, int]]()
    front, left = found_rig(recording, progress=lambda steps, total: done.append((steps, total)))
    assert (front.camera, front.elsewhere) == ("front", False)
    assert (left.camera, left.elsewhere) == ("left", True)
    assert done[-1] == (61, 61)
    assert found_rig(recording, last_s=4.0) == ()


def test_a_recording_without_images_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Recorder(tmp_path / NAME, drone="drone1", config=drone_config()) as recorder:
        for frames, vehicle in inputs(2):
            recorder.step(replace(frames, frames={}), vehicle, filled(PilotOutput, 0.5))
    recording = Recording(tmp_path / NAME)
    with pytest.raises(RecordingError, match="holds no images"):
        found_rig(recording)
    config = recording.config.model_copy(update={"name": "drone1"})
    (finding,) = camera_checks.check_rig(config, tmp_path)
    assert (finding.level, finding.about) == (Level.WARNING, "rig")


def test_the_doctor_names_a_camera_of_which_the_flight_showed_nothing_though_it_showed_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path)
    right = np.zeros(3), 0.0, 1.0
    unseen = seen("left", *right, sigmas=(PRIOR_TURN_RAD,) * 3 + WELL[3:])
    left, rig = examined(monkeypatch, drone_config(), tmp_path, seen("front", *right), unseen)
    assert (left.level, left.about) == (Level.WARNING, "camera left")
    assert rig.level is Level.PASS
    assert rig.measured.endswith("1 cameras were as configured")
    (left,) = examined(monkeypatch, drone_config(), tmp_path, seen("front", *right), replace(unseen, elsewhere=True))
    assert (left.level, left.about) == (Level.FAILURE, "camera left"), "once"
    still = [replace(unseen, camera=name) for name in ("front", "left")]
    (rig,) = examined(monkeypatch, drone_config(), tmp_path, *still)
    assert (rig.level, rig.about) == (Level.PASS, "rig")


def test_the_doctor_compares_the_newest_recording_with_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = drone_config()
    (finding,) = examined(monkeypatch, config, tmp_path)
    assert (finding.level, finding.about) == (Level.PASS, "rig"), "there is no flight yet"
    recorded(tmp_path)
    found = seen("front", np.zeros(3), 0.0, 1.0), seen("left")
    (finding,) = examined(monkeypatch, config, tmp_path, *found)
    assert (finding.level, finding.about) == (Level.WARNING, "camera left")
    assert "roll +0.30 +- 0.10, pitch -1.90 +- 0.10, yaw +0.50 +- 0.10 degrees, time -30 +- 1 ms" in finding.measured
    assert "flockd calibrate rig --from-flight" in finding.fix
    other = config.model_copy(update={"rig": config.rig.model_copy(update={"time_offset_s": 0.01})})
    (finding,) = examined(monkeypatch, other, tmp_path, *found)
    assert "differs from that of the last flight" in finding.measured
