"""What a recorder deletes to stay within its quota, to the byte."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flockd.core.config.drone import RecordingConfig
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.reader import Recording
from tests.make import output
from tests.onboard.recording.made_up import MODELS, drone_config, inputs, record

SETTINGS = RecordingConfig(quota_mb=1.0)


def _recorded(folder: Path, name: str, size_bytes: int, number: int, *, drone: str = "drone1", **facts: str) -> Path:
    """A flight's file of this size, the higher its number the newer."""
    path = folder / f"{name}.mcap"
    with Recorder(path, drone=drone, config=drone_config(), models=MODELS, facts=facts) as recorder:
        for frames, vehicle in inputs(1):
            recorder.drain()
            recorder.step(frames, vehicle, output(frames.time_s))
    assert path.stat().st_size <= size_bytes
    os.truncate(path, size_bytes)
    os.utime(path, (-number, -number))  # a clock that is set back: order is by the flights' own numbers
    return path


def test_as_a_flight_grows_the_oldest_go_and_no_more_than_have_to(tmp_path: Path) -> None:
    """1 MB in all; the flight before this one neither counts nor goes."""
    files = [_recorded(tmp_path, f"flight{k}", 300_000, k) for k in (1, 2, 3, 4)]
    record(tmp_path / "now.mcap", 1, SETTINGS)
    assert [file.exists() for file in files] == [False, True, True, True]
    (tmp_path / "now.mcap").unlink()
    record(tmp_path / "now.mcap", 6, SETTINGS)
    assert [file.exists() for file in files] == [False, False, False, True]


def test_on_a_full_disk_the_oldest_go_and_the_flight_before_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever fills it: a disk of 2 MB, of which a twentieth stays free, that holds something else of 1 MB."""
    files = [_recorded(tmp_path, f"flight{k}", 300_000, k) for k in (1, 2)]

    def disk(folder: Path) -> Any:
        taken = 1_000_000 + sum(file.stat().st_size for file in folder.iterdir())
        return SimpleNamespace(total=2_000_000, free=2_000_000 - taken)

    monkeypatch.setattr(shutil, "disk_usage", disk)
    left = []
    for steps in (1, 3, 6):
        (tmp_path / "now.mcap").unlink(missing_ok=True)
        record(tmp_path / "now.mcap", steps)
        left.append([file.exists() for file in files])
    assert left == [[True, True], [False, True], [False, False]]
    assert len(list(Recording(tmp_path / "now.mcap").steps())) == 6


@pytest.mark.parametrize("made_of_another", ["replayed_from", "cut_from"])
def test_what_is_not_this_drones_flight_neither_counts_nor_goes(tmp_path: Path, made_of_another: str) -> None:
    others = [_recorded(tmp_path, f"other{k}", 900_000, k, drone="drone2") for k in (1, 2)]
    replayed = _recorded(tmp_path, "replayed", 900_000, 3, **{made_of_another: "x.mcap"})
    own = _recorded(tmp_path, "own", 500_000, 4)
    record(tmp_path / "now.mcap", 1, SETTINGS)
    assert all(file.exists() for file in (*others, replayed, own))


def test_a_flight_that_fills_the_quota_alone_is_recorded_so_far(tmp_path: Path) -> None:
    told: list[str] = []
    path = tmp_path / "now.mcap"
    record(path, 40, SETTINGS, told=told)
    assert told == [f"recording {path}: recording.quota_mb is reached; the recording ends here and the flight goes on"]
    assert 1e6 < path.stat().st_size < 5e6
    assert not Recording(path).contents.finished
