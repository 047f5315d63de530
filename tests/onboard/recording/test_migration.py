"""Recordings of 0.1.0 are read by later versions: their settings and their outputs are converted, and that is said.

`tests/review/replay/*.mcap` were recorded by 0.1.0 and stay as they are.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.messages import PilotOutput
from flockd.onboard.recording import RecordingError, reader
from flockd.onboard.recording.codec import from_json
from flockd.onboard.recording.mcap_file import Entry, read_records
from flockd.onboard.recording.migration import ADDED, DROPPED, Migrated, migrate_configuration, migrate_output
from flockd.onboard.recording.reader import Recording, head_of
from flockd.onboard.recording.streams import OUTPUT
from flockd.review.replay.fidelity import replay_warnings

FLIGHTS = sorted((Path(__file__).parents[2] / "review" / "replay").glob("*.mcap"))
IDS = [path.stem for path in FLIGHTS]


class Tracking(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gate_sigma: float


class Mission(BaseModel):
    model_config = ConfigDict(extra="forbid")
    speed_m_s: float
    trim_m_s: float = 0.0


class Later(BaseModel):
    """A configuration of some later version."""

    model_config = ConfigDict(extra="forbid")
    tracking: Tracking | None = None
    mission: Mission


def earlier() -> dict[str, Any]:
    return {
        "tracking": {"gate_sigma": 4.0, "size_memory": 3},
        "desired": {"speed_m_s": 1.0},
        "autopilot": {"trim_m_s": 0.5},
    }


def migrated(document: dict[str, Any]) -> Migrated:
    renamed = {"desired": "mission", "autopilot.trim_m_s": "mission.trim_m_s"}
    return migrate_configuration(document, Later, {"tracking.size_memory": "it was off", "autopilot": "gone"}, renamed)


def test_keys_that_are_gone_are_dropped_and_renamed_ones_move_with_their_values() -> None:
    document = earlier()
    result = migrated(document)
    later = Later.model_validate(result.document)
    assert (later.mission.speed_m_s, later.mission.trim_m_s) == (1.0, 0.5)
    assert result.notes == (
        "desired is now mission",
        "autopilot.trim_m_s is now mission.trim_m_s",
        "tracking.size_memory (3) was dropped: it was off",
        "autopilot ({}) was dropped: gone",
    )
    assert document == earlier(), "the argument is not changed"


def test_a_current_configuration_stays_as_it_is() -> None:
    current = {"tracking": {"gate_sigma": 4.0}, "mission": {"speed_m_s": 1.0}}
    assert migrated(current) == Migrated(current, ())
    document = json.loads(DroneConfig.model_validate(Recording(FLIGHTS[0]).config).model_dump_json())
    assert migrate_configuration(document) == Migrated(document, ())


def test_a_key_that_is_still_known_is_never_dropped() -> None:
    document = {"tracking": {"gate_sigma": 2.0}}
    assert migrate_configuration(document, Later, {"tracking.gate_sigma": "no reason"}, {}).document == document


@pytest.mark.parametrize("damaged", [0, "x", [], None])
def test_a_section_that_is_none_stays_for_the_checks_of_the_configuration(damaged: object) -> None:
    """Found by tools/checks/fuzz.py: what came later was put into it."""
    document = {"perception": damaged}
    assert migrate_configuration(document) == Migrated(document, ())
    document = {"mission": damaged, "autopilot": {"trim_m_s": 0.5}}
    assert migrated(document).document["mission"] == damaged


def test_unknown_keys_beyond_the_table_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = json.loads(head_of(FLIGHTS[0])[2].data)
    document["tracking"]["colour"] = "red"
    monkeypatch.setattr(reader, "migrate_configuration", lambda _: migrate_configuration(document))
    with pytest.raises(RecordingError, match=r"tracking\.colour"):
        Recording(FLIGHTS[0])


@pytest.mark.parametrize("path", FLIGHTS, ids=IDS)
def test_settings_of_0_1_0_are_read_and_what_is_dropped_is_said(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = json.loads(head_of(path)[2].data)
    assert set(DROPPED) <= {f"tracking.{key}" for key in document["tracking"]}
    recording = Recording(path)
    gone = [key for key in DROPPED if key.split(".")[1] not in type(recording.config.tracking).model_fields]
    assert [note.split(" ")[0] for note in recording.migrations] == ["desired", *gone, *ADDED]
    assert recording.config.perception.verification == "none", "it flew without"
    assert recording.config.mission.kind == "circle_then_tangent"
    flown = document["desired"]
    assert {key: getattr(recording.config.mission, key) for key in flown} == flown
    kept = document["tracking"].keys() & type(recording.config.tracking).model_fields.keys()
    assert {key: getattr(recording.config.tracking, key) for key in kept} == {
        key: document["tracking"][key] for key in kept
    }
    assert main(["record", "info", str(path)]) == 0
    told = capsys.readouterr().out
    assert all(key in told for key in gone)


def test_a_replay_says_what_was_changed_in_the_settings_it_flies_with() -> None:
    recording = Recording(FLIGHTS[0])
    recording.migrations = ("desired is now mission", "tracking.size_memory (0) was dropped: it was off")
    line, *_ = replay_warnings(recording, recording.config, recording.start_s)
    assert "version 0.1.0" in line
    assert "desired is now mission; tracking.size_memory (0) was dropped" in line
    assert line not in list(replay_warnings(recording, DroneConfig(rig=recording.config.rig), recording.start_s))


def outputs_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(r.data) for r in read_records(path) if isinstance(r, Entry) and r.stream.topic == OUTPUT.topic]


@pytest.mark.parametrize("path", FLIGHTS, ids=IDS)
def test_outputs_of_0_1_0_become_log_polar(path: Path) -> None:
    raw = outputs_of(path)
    assert any(output["sightings"] for output in raw), "recorded by 0.1.0, and never again"
    steps = list(Recording(path).steps())
    for before, step in zip(raw, steps, strict=True):
        output: PilotOutput = from_json(PilotOutput, step.output)
        assert len(output.detections) == len(before["sightings"])
        assert list(output.detection_tracks) == before["sighting_tracks"]
        assert output.command.yaw_rad == before["command"]["yaw_rad"]
        for detection, sighting in zip(output.detections, before["sightings"], strict=True):
            assert detection.position == pytest.approx(np.array(sighting["position"]), rel=1e-12)
            assert detection.range_sigma_m == pytest.approx(sighting["range_sigma_m"], rel=1e-9)
            across = np.cross(detection.bearing, [0.0, 0.0, 1.0])
            across /= np.linalg.norm(across)
            variance = float(across @ detection.covariance @ across)
            assert math.sqrt(variance) == pytest.approx(sighting["bearing_sigma_rad"], rel=1e-9)
            assert (detection.label, list(detection.cameras)) == (sighting["label"], sighting["cameras"])


def test_outputs_of_today_are_not_touched_and_broken_sightings_are_refused() -> None:
    output = {"detections": [], "detection_tracks": [], "reasons": ["none"]}
    assert migrate_output(output) is output
    good = {"position": [3.0, 0.0, 4.0], "range_sigma_m": 0.5, "bearing_sigma_rad": 0.01}
    for spoilt in ({**good, "position": [0.0, 0.0, 0.0]}, {"position": [1.0, 2.0, 3.0]}, {**good, "position": None}):
        with pytest.raises(ValueError, match=r"."):
            migrate_output({"sightings": [spoilt], "sighting_tracks": [1]})
    converted = migrate_output({"sightings": [good], "sighting_tracks": [1]})["detections"][0]
    assert converted["bearing"] == pytest.approx([0.6, 0.0, 0.8])
    assert converted["log_range"] == pytest.approx(math.log(5.0))
    assert np.trace(np.reshape(converted["covariance"], (3, 3))) == pytest.approx(0.1**2 + 2 * 0.01**2)
