"""The rig that a flight found, as a recording has it: taken over where it is known, compared by the doctor."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.messages import CameraDeviation, FloatArray, PilotOutput, Reason, ReasonKind
from flockd.flight.geometry import build_rig, rotation_from_vector
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.calibration.from_flight import corrected_rig, found_rig
from flockd.ground.doctor import Level
from flockd.ground.doctor.camera_checks import check_rig
from flockd.onboard.daemon.pilot_loop import Reports
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
    return CameraDeviation(camera, turn, time_s, focal, np.diag(np.array(sigmas) ** 2))


def recorded(folder: Path, rigs: Sequence[Sequence[CameraDeviation]], name: str = NAME) -> Recording:
    """A flight whose outputs say this, one after the other."""
    config = drone_config()
    with Recorder(folder / name, drone="drone1", config=config) as recorder:
        for (frames, vehicle), rig in zip(inputs(len(rigs)), rigs, strict=True):
            output: PilotOutput = filled(PilotOutput, 0.5)
            recorder.step(frames, vehicle, replace(output, time_s=frames.time_s, rig=tuple(rig)))
            recorder.drain()
    return Recording(folder / name)


def examined(config: DroneConfig, folder: Path) -> list[tuple[Level, str]]:
    """What the doctor finds of drone1's last flight: its levels, and of what."""
    return [(one.level, one.about) for one in check_rig(config.model_copy(update={"name": "drone1"}), folder)]


def test_the_last_that_was_said_is_taken_over(tmp_path: Path) -> None:
    worse = seen("front", -TURN), seen("left", -TURN)
    recording = recorded(tmp_path, [worse, (seen("front"), seen("left")), ()])
    out = tmp_path / "rig.yaml"
    result = corrected_rig(recording, "flight", out)
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
    recording = recorded(tmp_path, [(seen("front", sigmas=vague), seen("left"))])
    out = tmp_path / "rig.yaml"
    result = corrected_rig(recording, "flight", out)
    assert result["cameras"]["front"]["taken"] == []
    assert result["cameras"]["left"]["taken"] == ["mounting", "focal length"]
    assert result["notes"] == [
        "the mounting of camera 'front' is known to 1.2 degrees only, and kept: this flight turned too little about "
        "some axis"
    ]
    assert load_drone(out).rig.cameras[0] == recording.config.rig.cameras[0]
    assert result["time_offset_s"] == pytest.approx(-0.03)  # by the camera that knows it


def test_a_rolling_shutter_is_said(tmp_path: Path) -> None:
    def rolled(one: CameraDeviation) -> CameraDeviation:
        return replace(one, readout_s=np.array([-0.017, 0.001]), readout_sigma_s=np.array([0.002, 0.002]))

    turned, as_configured = rolled(seen("front")), rolled(seen("front", np.zeros(3), 0.0, 1.0))
    said = "rows are read over the images' width in -17 +- 2 ms: a rolling shutter"
    recording = recorded(tmp_path, [(turned, seen("left"))])
    assert corrected_rig(recording, "flight", tmp_path / "rig.yaml")["notes"] == [said]
    other = recorded(tmp_path, [(as_configured, replace(as_configured, camera="left"))], NAME.replace("12", "13"))
    with pytest.raises(CalibrationError, match=rf"to be corrected: {re.escape(said)}; what is known agrees"):
        corrected_rig(other, "flight", tmp_path / "again.yaml")


def test_of_a_camera_that_is_elsewhere_nothing_is_taken_and_the_doctor_names_it(tmp_path: Path) -> None:
    lost = replace(seen("front", time_s=-0.3), elsewhere=True)
    recording = recorded(tmp_path, [(lost, seen("left"))])
    out = tmp_path / "rig.yaml"
    result = corrected_rig(recording, "flight", out)
    assert result["cameras"]["front"]["taken"] == []
    assert result["notes"][0].startswith("camera front: it moves otherwise than the drone")
    assert load_drone(out).rig.cameras[0] == recording.config.rig.cameras[0]
    assert result["time_offset_s"] == pytest.approx(-0.03)
    found = examined(recording.config, tmp_path)
    assert found == [(Level.FAILURE, "camera front"), (Level.WARNING, "camera left")]


LITTLE = (np.radians([0.1, -0.2, 0.1]), 0.002, 1.004)


@pytest.mark.parametrize(
    ("rigs", "told"),
    [
        ([(seen("front", *LITTLE), seen("left", *LITTLE))], "nothing of the rig is to be corrected"),
        ([(), ()], "says nothing of the rig"),
    ],
    ids=["agrees", "silent"],
)
def test_what_agrees_or_is_not_said_is_not_replaced(
    rigs: Sequence[Sequence[CameraDeviation]], told: str, tmp_path: Path
) -> None:
    recording = recorded(tmp_path, rigs)
    with pytest.raises(CalibrationError, match=told):
        corrected_rig(recording, "flight", tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()
    assert examined(recording.config, tmp_path) == [(Level.PASS, "rig")]


def test_times_of_cameras_that_do_not_agree_are_named(tmp_path: Path) -> None:
    recording = recorded(tmp_path, [(seen("front", time_s=-0.01), seen("left", time_s=-0.05))])
    result = corrected_rig(recording, "flight", tmp_path / "rig.yaml")
    assert result["time_offset_s"] == pytest.approx(-0.03)
    assert "20 ms off the others'" in result["notes"][0]
    fault = Reason(ReasonKind.RIG, "camera left: it is not turned as configured")
    output: PilotOutput = replace(filled(PilotOutput, 0.5), reasons=(fault,), rig=(seen("front"), seen("left")))
    reports = Reports()
    (text,) = reports.update(output)
    assert text.startswith("camera left: it is not turned as configured: by what it saw, turned by roll +0.30")
    assert reports.update(output) == [], "each fault is said once a flight"


@pytest.mark.parametrize(
    "wrong",
    [
        seen("top"),
        seen("front", np.array([math.nan, 0.0, 0.0])),
        seen("front", focal=0.0),
        seen("front", focal=-1.0),
        seen("front", sigmas=(0.0,) * 5),
        replace(seen("front"), covariance=np.full((5, 5), 1e300)),
        replace(seen("front"), covariance=-np.eye(5)),
        replace(seen("front"), readout_s=np.array([math.nan, 0.0]), readout_sigma_s=np.full(2, 0.001)),
    ],
    ids=["stranger", "nan", "no focal length", "negative", "certain", "absurd", "negative variances", "nan readout"],
)
def test_what_cannot_be_is_refused_in_one_sentence(wrong: CameraDeviation, tmp_path: Path) -> None:
    recording = recorded(tmp_path, [(wrong,)])
    with pytest.raises(RecordingError, match="cannot be"):
        found_rig(recording)
    assert examined(recording.config, tmp_path) == [(Level.WARNING, "rig")]


def test_the_doctor_compares_the_newest_recording_with_the_configuration(tmp_path: Path) -> None:
    config = drone_config().model_copy(update={"name": "drone1"})
    assert examined(config, tmp_path) == [(Level.PASS, "rig")], "there is no flight yet"
    recorded(tmp_path, [(seen("front", np.zeros(3), 0.0, 1.0), seen("left"))])
    (finding,) = check_rig(config, tmp_path)
    assert (finding.level, finding.about) == (Level.WARNING, "camera left")
    assert "roll +0.30 +- 0.10, pitch -1.90 +- 0.10, yaw +0.50 +- 0.10 degrees, time -30 +- 1 ms" in finding.measured
    assert "flockd calibrate rig --from-flight" in finding.fix
    other = config.model_copy(update={"rig": config.rig.model_copy(update={"time_offset_s": 0.01})})
    assert examined(other, tmp_path) == [(Level.PASS, "rig")], "another rig than in the last flight"
