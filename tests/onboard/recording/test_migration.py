"""The recorded regressions, which 0.1.0 recorded, are read: their settings and outputs are converted."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import PilotOutput
from flockd.onboard.recording.codec import from_json
from flockd.onboard.recording.mcap_file import Entry, read_records
from flockd.onboard.recording.migration import migrate_configuration, migrate_output
from flockd.onboard.recording.reader import Recording, head_of
from flockd.onboard.recording.streams import OUTPUT

FLIGHTS = sorted((Path(__file__).parents[2] / "review" / "replay").glob("*.mcap"))
IDS = [path.stem for path in FLIGHTS]


@pytest.mark.parametrize("path", FLIGHTS, ids=IDS)
def test_settings_keep_their_values_and_what_came_later_is_off(path: Path) -> None:
    document = json.loads(head_of(path)[2].data)
    config = Recording(path).config
    assert config.perception.verification == "none", "it flew without"
    assert config.mission.kind == "circle_then_tangent"
    flown = document["desired"]
    assert {key: getattr(config.mission, key) for key in flown} == flown
    kept = document["tracking"].keys() & type(config.tracking).model_fields.keys()
    assert {key: getattr(config.tracking, key) for key in kept} == {key: document["tracking"][key] for key in kept}


@pytest.mark.parametrize("damaged", [0, "x", [], None])
def test_what_is_no_section_stays_for_the_checks_of_the_configuration(damaged: object) -> None:
    """Found by tools/checks/fuzz.py."""
    assert migrate_configuration(damaged) == damaged
    document = {"desired": damaged, "perception": damaged, "tracking": damaged}
    assert migrate_configuration(document) == {"mission": damaged, "perception": damaged, "tracking": damaged}


@pytest.mark.parametrize("path", FLIGHTS, ids=IDS)
def test_outputs_become_log_polar(path: Path) -> None:
    records = (record for record in read_records(path) if isinstance(record, Entry))
    raw: list[dict[str, Any]] = [json.loads(entry.data) for entry in records if entry.stream.topic == OUTPUT.topic]
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
