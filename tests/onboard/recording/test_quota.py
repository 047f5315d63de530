"""What a recorder deletes to stay within its quota, to the byte."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flockd.core.config.drone import RecordingConfig
from flockd.onboard.recording import Recorder
from tests.make import output
from tests.onboard.recording.made_up import MODELS, drone_config, inputs, record

SETTINGS = RecordingConfig(file_mb=0.5, quota_mb=1.0)


def _recorded(folder: Path, name: str, size_bytes: int, number: int, drone: str = "drone1") -> Path:
    """A flight's file of this size, the higher its number the newer."""
    path = folder / f"{name}.mcap"
    with Recorder(path, drone=drone, config=drone_config(), settings=None, models=MODELS) as recorder:
        for frames, vehicle in inputs(1):
            recorder.drain()
            recorder.step(frames, vehicle, output(frames.time_s))
    assert path.stat().st_size <= size_bytes
    os.truncate(path, size_bytes)
    os.utime(path, (number, number))
    return path


@pytest.mark.parametrize(("size_bytes", "stays"), [(500_000, True), (500_001, False)])
def test_what_leaves_room_for_one_whole_file_stays(size_bytes: int, stays: bool, tmp_path: Path) -> None:
    """1 MB, of which the file being written may take half; the flight before this one does not count."""
    older, last = _recorded(tmp_path, "older", size_bytes, 1), _recorded(tmp_path, "last", 900_000, 2)
    record(tmp_path / "now.mcap", steps=1, settings=SETTINGS)
    assert (older.exists(), last.exists()) == (stays, True)


def test_only_as_many_go_as_have_to_and_the_oldest_first(tmp_path: Path) -> None:
    files = [_recorded(tmp_path, f"flight{k}", 300_000, k) for k in (3, 1, 2, 4)]
    record(tmp_path / "now.mcap", steps=1, settings=SETTINGS)
    assert [file.exists() for file in files] == [True, False, False, True]


def test_another_drones_recordings_neither_count_nor_go(tmp_path: Path) -> None:
    others = [_recorded(tmp_path, f"other{k}", 900_000, k, drone="drone2") for k in (1, 2)]
    own = _recorded(tmp_path, "own", 500_000, 3)
    record(tmp_path / "now.mcap", steps=1, settings=SETTINGS)
    assert all(file.exists() for file in (*others, own))
