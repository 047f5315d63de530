"""A fleet of real daemons: two with fake autopilots, from rendered frames, over real MAVLink; PX4 where it is."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.review.flight_log.log import FlightLog
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.autopilots import px4_folder
from flockd.sim.sitl.ground_station import FULL_STICK_M_S, GroundStation, home_deg
from flockd.sim.sitl.processes import free_port
from tests.calm import until
from tests.sitl.sitl_run import PX4

SECONDS_TO_START = 120.0


def _scenario(folder: Path, drones: int, **drone: object) -> Path:
    """A flight low above the ground with tiny pictures; the own velocity comes from the autopilot."""
    lens = {"fx": 32.0, "fy": 32.0, "cx": 32.0, "cy": 24.0}
    cameras = [
        {"name": name, "size_px": [64, 48], "intrinsics": lens, "extrinsics": {"yaw_deg": yaw}}
        for name, yaw in (("front", 0.0), ("back", 180.0))
    ]
    values = {"rig": {"cameras": cameras}, "own_velocity": "autopilot", "perception": {"flow": "dis"}, **drone}
    (folder / "tiny.yaml").write_text(json.dumps(values), encoding="utf-8")
    vehicles = [{"position_m": [0.0, 6.0 * i, -1.5]} for i in range(drones)]
    flight = {"scenario": "tiny", "duration_s": 3.0, "drone": "tiny.yaml", "vehicles": vehicles}
    path = folder / "flight.yaml"
    path.write_text(json.dumps(flight), encoding="utf-8")
    return path


def _processes(mark: str) -> dict[int, str]:
    """Numbers and command lines of other processes that know of a folder."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes()
            known = (entry / "environ").read_bytes() + command
        except OSError:
            continue
        if mark.encode() in known and int(entry.name) != os.getpid():
            found[int(entry.name)] = command.replace(b"\0", b" ").decode()
    return found


@pytest.mark.slow
@pytest.mark.whole_flight
def test_two_daemons_fly_from_rendered_frames_and_the_report_is_the_simulators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    out = tmp_path / "out"
    scenario = _scenario(tmp_path, drones=2)
    options = ["--autopilot", "fake", "--speed-factor", "0.5", "--out", str(out), "--json"]
    code = main(["sim", str(scenario), *options])
    told = capsys.readouterr()
    assert code == 0, told.err
    summary = json.loads(told.out)
    assert summary == json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert (summary["autopilot"], summary["drones"], summary["perception"]) == ("fake autopilot", 2, "learned")
    assert summary["fleet"]["handed_over"] == {}
    assert summary["fleet"]["exit_codes"] == {"drone1": 0, "drone2": 0}
    assert 0.0 < summary["realtime_factor"] <= 0.5 + 0.01, "never faster than asked"
    assert "fake autopilot" in (out / "report.html").read_text(encoding="utf-8")

    log = FlightLog.load(out / "flight.npz")
    assert len(log.time_s) == summary["fleet"]["frame_sets"] >= 4
    np.testing.assert_allclose(log.position[0, :, 2], -1.5, atol=0.2)  # MIS_TAKEOFF_ALT
    # Each holds its place on an estimate that wanders by 0.15 m (standard deviation).
    np.testing.assert_allclose(log.position[0, 1, :2] - log.position[0, 0, :2], [0.0, 6.0], atol=0.6)
    np.testing.assert_allclose(log.velocity[-1, :, :2], [[1.0, 0.0]] * 2, atol=0.4)  # Eq. 43, slowed by late steps
    assert log.recorded.any(axis=0).all()
    assert {path.name for path in (out / "logs").iterdir()} == {
        f"drone{i}.{suffix}" for i in (1, 2) for suffix in ("log", "yaml")
    }
    assert not (out / "recordings").exists()
    assert _processes(str(tmp_path)) == {}


def test_nobody_is_left_behind_when_it_is_told_to_end(tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    options = ["--autopilot", "fake", "--out", str(tmp_path / "out")]
    run = "from flockd.cli import program; program()"
    with subprocess.Popen(
        [sys.executable, "-c", run, "sim", str(_scenario(tmp_path, drones=1)), *options],
        cwd=data_path("config").parent, env=environment, stderr=subprocess.PIPE, text=True,
    ) as simulator:  # fmt: skip
        until(lambda: simulator.poll() is not None or [*tmp_path.glob("flockd-*/drone1.log")], SECONDS_TO_START)
        assert simulator.poll() is None, simulator.communicate()
        simulator.send_signal(signal.SIGTERM)
        _, told = simulator.communicate(timeout=60.0)
    assert simulator.returncode == 130
    assert told.splitlines()[-1] == "interrupted"
    assert _processes(str(tmp_path)) == {}
    assert (tmp_path / "out/logs/drone1.yaml").is_file()


@pytest.mark.slow
def test_an_interrupted_fleet_lands_and_leaves_a_report_of_what_was_flown(tmp_path: Path) -> None:
    """Ctrl-C while two drones fly, as a terminal sends it: to the whole process group."""
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    out = tmp_path / "out"
    options = ["--autopilot", "fake", "--speed-factor", "0.5", "--duration", "600", "--out", str(out)]
    # As from a terminal: a shell that starts something in the background has it ignore Ctrl-C.
    run = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "from flockd.cli import program; program()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", run, "sim", str(_scenario(tmp_path, drones=2)), *options],
        cwd=data_path("config").parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    ) as simulator:  # fmt: skip
        assert simulator.stderr is not None
        for line in simulator.stderr:
            if (flying := re.match(r"flying: (\d+) of 600 s", line)) and int(flying[1]) >= 2:
                break
        os.killpg(simulator.pid, signal.SIGINT)
        printed, told = simulator.communicate(timeout=600.0)
    assert simulator.returncode == 130, told
    assert "interrupted" in told.splitlines()[-1]
    assert f"report: {out / 'report.html'}" in printed
    log = FlightLog.load(out / "flight.npz")
    assert log.metadata.interrupted
    assert 2.0 <= log.metadata.duration_s < 300.0
    np.testing.assert_allclose(log.position[0, :, 2], -1.5, atol=0.3)
    assert "interrupted" in (out / "report.html").read_text(encoding="utf-8")
    assert _processes(str(tmp_path)) == {}


def test_a_daemon_that_does_not_come_up_ends_the_flight_with_its_own_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = _scenario(tmp_path, drones=1, perception={"flow": "dis", "depth": "nothing"})
    assert main(["sim", str(scenario), "--autopilot", "fake", "--out", str(tmp_path / "out")]) == 69
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("drone1 ended with exit code 78 (")
    assert "nothing" in last


@pytest.mark.parametrize(
    ("environment", "says"),
    [({}, "FLOCKD_PX4 is not set"), ({"FLOCKD_PX4": "/nowhere"}, "in /nowhere, which FLOCKD_PX4 names")],
)
def test_without_px4_it_says_what_to_do(environment: dict[str, str], says: str) -> None:
    with pytest.raises(UnavailableError, match=f"there is no PX4.* {says}; set it to"):
        px4_folder(environment)


def test_the_ground_station_knows_where_everybody_truly_is() -> None:
    """Two metres up, three north and four east of the world's origin, told in degrees and turned by a quarter."""
    port = free_port()
    with (
        GroundStation([port], time.monotonic) as station,
        FakeAutopilot(
            free_port(), height_m=2.0, yaw_rad=np.pi / 2, home_deg=home_deg(np.array([3.0, 4.0])), truth_port=port
        ) as fake_autopilot,
    ):
        until(lambda: station.is_connected(0) and station.is_armed(0))
        poses = station.poses()
        np.testing.assert_allclose(poses.position, [[3.0, 4.0, -2.0]], atol=0.01)
        np.testing.assert_allclose(poses.R_ned_body[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
        assert station.mode_is(0, "LOITER")
        station.select(0, "LAND")
        until(lambda: station.mode_is(0, "LAND"))
        assert fake_autopilot.mode == "LAND"


def test_a_person_flies_one_drone_by_its_sticks_in_position_mode() -> None:
    port = free_port()
    with (
        GroundStation([port], time.monotonic) as station,
        FakeAutopilot(free_port(), height_m=2.0, yaw_rad=0.7, truth_port=port) as fake_autopilot,
    ):
        fake_autopilot.parameters |= {"MPC_VEL_MANUAL": FULL_STICK_M_S, "MAN_DEADZONE": 0.0}
        until(lambda: station.is_connected(0))
        station.select(0, "POSCTL")
        east = np.array([0.0, 1.0])

        def flies_east() -> bool:
            station.steer(0, east)
            return bool(np.linalg.norm(fake_autopilot.state.velocity[:2] - east) < 0.05)

        until(flies_east)
        until(lambda: np.linalg.norm(fake_autopilot.state.velocity) < 0.05)  # nobody moves the sticks any more
        assert fake_autopilot.state.position[2] == pytest.approx(-2.0, abs=0.05)


@pytest.mark.fault("computer-stalls")
@PX4
@pytest.mark.slow
def test_px4_enters_its_failsafe_when_its_daemon_is_frozen(tmp_path: Path) -> None:
    """No setpoint for a second is a failsafe of PX4 in offboard: it ends with another mode."""
    out = tmp_path / "out"
    run = "from flockd.cli import program; program()"
    options = ["--autopilot", "px4", "--drones", "2", "--duration", "20", "--out", str(out)]
    with subprocess.Popen(
        [sys.executable, "-c", run, "sim", *options], cwd=data_path("config").parent,
        env={**os.environ, "TMPDIR": str(tmp_path)}, stderr=subprocess.PIPE, text=True,
    ) as simulator:  # fmt: skip
        assert simulator.stderr is not None
        frozen_s = 0.0
        for line in simulator.stderr:
            flying = re.match(r"flying: (\d+) of 20 s", line)
            if flying and int(flying[1]) >= 5 and not frozen_s:
                known = _processes(str(tmp_path)).items()
                (daemon,) = [number for number, command in known if re.search(r" run --config .*/drone1.yaml", command)]
                os.kill(daemon, signal.SIGSTOP)
                frozen_s = float(flying[1])
    assert simulator.returncode == 1
    fleet = json.loads((out / "summary.json").read_text(encoding="utf-8"))["fleet"]
    left = re.match(r"after ([\d.]+) s it left offboard .*Failsafe", fleet["handed_over"]["drone1"])
    assert left is not None, fleet
    # The progress line is in whole seconds, and up to 2.5 s old: the freeze was up to 3.5 s after it.
    assert 1.0 <= float(left[1]) - frozen_s < 5.5, "COM_OF_LOSS_T is a second of simulated time"
    assert set(fleet["handed_over"]) == {"drone1"}
    assert fleet["exit_codes"] == {"drone1": -signal.SIGKILL, "drone2": 0}
