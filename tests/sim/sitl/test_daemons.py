"""How a simulated fleet's daemons are started."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.sim.sitl.daemons import Daemons


def test_recordings_go_where_the_simulator_was_told_though_daemons_run_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--out out/flight` is relative to where the person is; a daemon's folder is deleted after the flight."""
    config = load_drone(data_path("config") / "px4_sitl.yaml")
    folder = tmp_path / "f"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flockd.sim.sitl.daemons._RUN", "import sys; print(sys.argv[sys.argv.index('--record') + 1])")
    with Daemons([config], folder=folder, recordings=Path("recordings"), environment=os.environ) as daemons:
        daemons.start()
        (program,) = daemons.programs()
        end_s = time.monotonic() + 60.0
        while program.ended is None:
            assert time.monotonic() < end_s
            time.sleep(0.05)
        assert Path(program.log.read_text(encoding="utf-8").strip()) == tmp_path / "recordings"
