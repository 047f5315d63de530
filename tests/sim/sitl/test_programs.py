"""Programs beside the simulator: none outlives it, even one that was killed, and where they write."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.sim.scenario import load_scenario
from flockd.sim.sitl.autopilots import Ports
from flockd.sim.sitl.daemons import Daemons, fleet_configs
from flockd.sim.sitl.ground_station import GroundStation

PARENT = """\
import os, sys, time
from pathlib import Path
from flockd.sim.sitl.processes import Programs
folder = Path(sys.argv[1])
programs = Programs()
for name in ("one", "two"):
    programs.start(name, ["sleep", "60"], os.environ, folder, folder / f"{name}.log")
print(*(program.process.pid for program in programs), flush=True)
time.sleep(60)
"""


def _runs(pid: int) -> bool:
    """It is no zombie either: who should wait for it is gone, and not every init waits for others' children."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _until_gone(pids: list[int], timeout_s: float = 20.0) -> None:
    until_s = time.monotonic() + timeout_s
    while (left := [pid for pid in pids if _runs(pid)]) and time.monotonic() < until_s:
        time.sleep(0.02)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


@pytest.mark.fault("simulator-killed")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_killed_simulator_has_started_ends_with_it(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-c", PARENT, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        until_s = time.monotonic() + 20.0
        while not all(Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"sleep") for pid in pids):
            assert time.monotonic() < until_s
            time.sleep(0.02)
        assert [_runs(pid) for pid in pids] == [True, True]
        parent.send_signal(number)
    _until_gone(pids)


def test_a_port_that_is_used_is_named_with_what_to_do() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(UnavailableError, match=rf"^UDP port {port} .* end the other program .*sport = :{port}`"):
            GroundStation([port], time.monotonic)


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


def test_the_images_of_a_fleet_come_for_each_step() -> None:
    scenario = load_scenario(data_path("config") / "px4_flight.yaml", {"drone.step_s": 0.2})
    sitl = load_drone(data_path("config") / "px4_sitl.yaml")
    ports = [Ports(14540 + i, 15540 + i) for i, _ in enumerate(scenario.vehicles)]
    configs = fleet_configs(scenario, sitl, ports=ports, endpoint="tcp/127.0.0.1:7448", speed_factor=1.0)
    assert {(one.step_s, one.source and one.source.shared_memory.rate_hz) for one in configs} == {(0.2, 5.0)}
