"""Recordings of a whole fleet on one time line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flockd.fleet.page.recorded_fleet import RecordedFleet
from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.reader import Recording

FLOWN = Path(__file__).parents[2] / "review" / "replay"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings")
    shutil.copy(FLOWN / "crossing.mcap", path)
    return path


def test_a_recording_shows_what_its_drone_knew_at_each_time(folder: Path) -> None:
    fleet, recording = RecordedFleet(folder), Recording(folder / "crossing.mcap")
    steps = [step for step in recording.steps() if step.output is not None]
    assert fleet.span_s == (steps[0].frames.time_s, steps[-1].frames.time_s)
    for step in (steps[0], steps[-1]):
        ((key, row),) = fleet.rows(step.frames.time_s).items()
        assert key.endswith(f"/{recording.drone}")
        assert step.output is not None
        assert row["height_m"] == pytest.approx(step.vehicle.height_m, abs=0.01)
        places = [one["position"] for one in step.output["neighbours"]]
        assert [one["ned"] for one in row["sees"]] == [pytest.approx(place, abs=0.01) for place in places]
        assert set(row["cameras"]) == set(step.frames.frames)
        assert {camera for camera in row["cameras"] if fleet.image(key, camera, step.frames.time_s)} == set(
            row["cameras"]
        )
    assert fleet.image(key, "nothing", fleet.span_s[1]) is None
    assert fleet.rows(fleet.span_s[0] - 1.0) == {}, "before its recording begins there is no drone"
    (row,) = fleet.rows(fleet.span_s[1] + 60.0).values()
    assert row["state"] == "gone"
    assert not fleet.ask(key, "hold", None, "anna")["accepted"]


def test_the_history_reaches_over_the_whole_flight(folder: Path) -> None:
    fleet = RecordedFleet(folder)
    (rows,) = fleet.history().values()
    assert [row[0] for row in rows] == pytest.approx([fleet.span_s[0] + 0.5 * i for i in range(len(rows))])
    assert rows[-1][0] == pytest.approx(fleet.span_s[1], abs=0.51)


def test_a_folder_without_recordings_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="holds no recording; name a folder"):
        RecordedFleet(tmp_path)
