"""The simulator is killed while its daemons fly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.calm import until
from tests.faults.stories import Reacted
from tests.sitl.test_fleet import _processes, _scenario

pytestmark = pytest.mark.slow
SECONDS_TO_START = 180.0


@pytest.mark.fault("simulator-killed", within_s=5.0)
def test_the_simulator_is_killed_in_flight(tmp_path: Path, reacted: Reacted) -> None:
    """SIGKILL: it can end nothing any more. Its two daemons end by themselves, and what they recorded is whole."""
    scenario = _scenario(tmp_path, drones=2)
    scenario.write_text(scenario.read_text(encoding="utf-8").replace('"duration_s": 3.0', '"duration_s": 60.0'))
    run = "from flockd.cli import program; program()"
    options = ["--autopilot", "fake", "--speed-factor", "1", "--out", str(tmp_path / "out"), "--record"]
    with subprocess.Popen(
        [sys.executable, "-c", run, "sim", str(scenario), *options], env={**os.environ, "TMPDIR": str(tmp_path)},
        stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2],
    ) as simulator:  # fmt: skip
        flights = tmp_path / "out" / "recordings"
        until(lambda: simulator.poll() is not None or len([*flights.glob("*.mcap")]) == 2, SECONDS_TO_START)
        assert simulator.poll() is None, simulator.communicate()
        daemons = [command for command in _processes(str(tmp_path)).values() if " run --config " in command]
        assert len(daemons) == 2
        killed_s = time.monotonic()
        simulator.send_signal(signal.SIGKILL)
        simulator.wait()
    until(lambda: not _processes(str(tmp_path)))
    reacted("simulator-killed", time.monotonic() - killed_s)
