"""`flockd run` as a service manager runs it: a process of its own, with the shipped networks on tiny pictures."""

from __future__ import annotations

import contextlib
import errno
import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.data import data_path
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.processes import free_endpoint, free_port
from tests.calm import until
from tests.conftest import Told
from tests.faults.stories import Reacted
from tests.onboard.autopilot.conftest import HEARTBEAT_S
from tests.onboard.daemon.aboard import Cameras, config_for
from tests.onboard.test_worker import endless

RUN = "from flockd.cli import program; program()"
ROOT = Path(__file__).parents[2]
SECONDS_TO_FAIL = 300.0
"""To load three networks on a computer that is busy with other things. A test waits for the process, not so long."""


class Manager:
    """Listens as a service manager does."""

    def __init__(self, path: Path) -> None:
        self.told: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.settimeout(0.1)

    def until(self, condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
        def heard() -> bool:
            assert process.poll() is None, process.communicate()
            with contextlib.suppress(TimeoutError):
                self.told += self._socket.recv(4096).decode().splitlines()
            return condition()

        until(heard, SECONDS_TO_FAIL)


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(tmp_path / "notify")
    with contextlib.closing(manager._socket):
        yield manager


def _written(
    folder: Path, port: int | None = None, frames: str | None = None, endpoint: str | None = None, **changes: Any
) -> Path:
    """A drone's file; ``changes`` are keys of its sections, and None leaves a section out."""
    ends = port or free_port(), frames or free_endpoint(), endpoint or free_endpoint()
    values = config_for(*ends).model_dump(mode="json", exclude_defaults=True)
    for section, keys in changes.items():
        if keys is None:
            del values[section]
        else:
            values.setdefault(section, {}).update(keys)
    values.setdefault("safety", {})["degraded_load"] = values["flocking"]["max_speed_m_s"] = 1.0  # else it stops late
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


def _run(config: Path, folder: Path, *options: str) -> subprocess.Popen[str]:
    environment = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "2000000", "PATH": "/usr/bin"}
    command = [sys.executable, "-c", RUN, "run", "--config", str(config), *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=pipe, stderr=pipe, text=True)


@pytest.mark.fault("second-instance")
def test_it_gets_ready_alone_goes_on_after_sighup_and_ends_when_told(
    tmp_path: Path, manager: Manager, capsys: pytest.CaptureFixture[str]
) -> None:
    port, frames, telemetry = free_port(), free_endpoint(), free_endpoint()
    config = _written(tmp_path, port, frames, telemetry)
    cameras = Cameras(frames)
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S), _run(config, tmp_path) as process:
        try:
            manager.until(lambda: "READY=1" in manager.told, process)
            assert any(line.startswith("STATUS=idle: ") for line in manager.told)

            with _run(config, tmp_path) as second:
                _, told = second.communicate(timeout=SECONDS_TO_FAIL)
            assert second.returncode == 69
            assert "another flockd has the link udpin://" in told.splitlines()[-1]

            row = _status(telemetry, capsys)
            assert (row["fleet"], row["drone"], row["state"], row["flight_mode"]) == ("test", "tiny", "idle", "hold")
            assert "not armed" in row["matters"]

            feeds = manager.told.count("WATCHDOG=1")
            process.send_signal(signal.SIGHUP)
            manager.until(lambda: manager.told.count("WATCHDOG=1") > feeds + 4, process)
            assert manager.told.count("READY=1") == 1
            assert not {"RELOADING=1", "STOPPING=1"} & set(manager.told), "systemd 253 and later would kill it"

            process.send_signal(signal.SIGTERM)
            _, told = process.communicate(timeout=SECONDS_TO_FAIL)
            assert process.returncode == 0, told
            assert told.count("SIGHUP is ignored; to fly with a changed configuration: `flockd config check ") == 1
        finally:
            process.kill()
            cameras.close()


def _status(telemetry: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """`flockd status` of the one drone, asked until it has heard the whole: on a busy computer that takes longer."""

    def whole() -> Any:
        code = main(["status", "--connect", telemetry, "--seconds", "2.5", "--json"])
        rows = json.loads(capsys.readouterr().out or "[]")
        return rows if code == 0 and rows[0]["flight_mode"] is not None else None

    (row,) = until(whole, SECONDS_TO_FAIL)
    return dict(row)


def test_a_changed_model_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    models = tmp_path / "models"
    shutil.copytree(data_path("models"), models)
    flow = bytearray((models / "flow_int8.onnx").read_bytes())
    flow[len(flow) // 2] ^= 1
    (models / "flow_int8.onnx").write_bytes(flow)
    config = _written(tmp_path, perception={"models_dir": str(models)})
    assert main(["run", "--config", str(config)]) == 78
    assert "flow_int8.yaml:5: sha256: " in capsys.readouterr().err


@pytest.mark.fault("wrong-configuration", within_s=30.0)
@pytest.mark.fault("absurd-limits")
@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"autopilot": None}, " autopilot: is missing; "),
        ({"source": None}, " source: is missing; "),
        ({"autopilot": {"adress": "udpin://x"}}, "autopilot.adress: is not a known key; did you mean `address`?"),
        ({"autopilot": {"arm_and_take_off": False}}, "a pilot or a ground station arms, takes off"),
        ({"safety": {"hover_s": 1e9}}, "safety.hover_s: 1000000000.0 is not at most 3; write "),
        ({"safety": {"heartbeat_timeout_s": "2 s"}}, "safety.heartbeat_timeout_s: 2 s is not a number"),
        ({"perception": {"deadline_s": 1e9}}, "perception.deadline_s: 1000000000.0 is not "),
    ],
)
def test_a_drone_that_cannot_be_flown_is_bad_configuration(
    changes: dict[str, Any], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], reacted: Reacted
) -> None:
    config, began_s = _written(tmp_path, **changes), time.monotonic()
    assert main(["run", "--config", str(config)]) == 78
    reacted("wrong-configuration", time.monotonic() - began_s)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"{config}:")
    assert told in last


def test_it_flies_in_its_layer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = _written(tmp_path, safety={"first_flight_layer": 2})
    flown: list[DroneConfig] = []

    async def fly(drone: DroneConfig, *_: object) -> None:
        flown.append(drone)

    monkeypatch.setattr("flockd.cli.run._fly", fly)
    assert main(["run", "--config", str(config)]) == 0
    (drone,) = flown
    assert (drone.mission.height_m, drone.flocking.max_speed_m_s) == (7.0, 1.0)


def test_a_file_where_the_recordings_folder_would_be(tmp_path: Path, told: Told) -> None:
    config = _written(tmp_path)
    for name in (config, config / "recordings"):
        assert told(2, "run", "--config", config, "--record", name).startswith(f"{name}: is not a folder; ")


def test_a_fleet_that_is_not_there_is_unavailable(told: Told) -> None:
    endpoint = free_endpoint()
    missing = told(69, "status", "--connect", endpoint, "--seconds", "0.2")
    assert missing.startswith(f"no drone was found at {endpoint} within 0.2 s; ")


def test_without_an_autopilot_it_is_unavailable_and_not_aborted(tmp_path: Path) -> None:
    """The serial port is refused at once, while a thread still loads networks: ended then, the process was aborted."""
    config = _written(tmp_path, autopilot={"address": f"serial://{tmp_path / 'none'}:921600"})
    recordings = tmp_path / "new" / "recordings"
    with _run(config, tmp_path, "--record", str(recordings)) as process:
        _, err = process.communicate(timeout=SECONDS_TO_FAIL)
    assert process.returncode == 69, err
    assert recordings.is_dir(), "it is made"
    assert f"waits for the autopilot at serial://{tmp_path / 'none'}:921600, and for the networks to load" in err
    assert f"autopilot.address: serial://{tmp_path / 'none'}:921600 cannot be opened" in err.splitlines()[-1]


@pytest.mark.fault("endless-network")
def test_a_network_that_never_ends_is_bad_configuration_within_ten_seconds(tmp_path: Path) -> None:
    """The daemon waits for an autopilot meanwhile, and none is there."""
    config = _written(tmp_path, perception={"flow": str(endless(tmp_path))})
    with _run(config, tmp_path) as process:
        _, err = process.communicate(timeout=SECONDS_TO_FAIL)
    assert process.returncode == 78, err
    assert "endless.onnx did not finish the golden input in time" in err.splitlines()[-1]


@pytest.mark.fault("nothing-left-at-start")
@pytest.mark.parametrize(
    ("limit", "values", "changes", "code", "says"),
    [
        ("NOFILE", (20, 20), {}, 69, "this process may open 20 files, and a flight needs 128; "),
        ("AS", (700 << 20,) * 2, {}, 69, "this process may use 700 MiB of addresses, and a flight needs 3072; "),
        ("AS", (200 << 20,) * 2, {}, 69, "this process may use 200 MiB of addresses, and a flight needs 3072; "),
        ("NOFILE", (20, 256), {"source": None}, 78, "source: is missing"),
    ],
    ids=["files", "memory", "hardly any memory", "files that may be raised"],
)
def test_without_files_or_memory_it_is_unavailable_and_not_aborted(
    limit: str, values: tuple[int, int], changes: dict[str, None], code: int, says: str, tmp_path: Path
) -> None:
    """Unchecked, the second is ended by glibc (127), the third by an ImportError; 24 files make a model look bad."""
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_{limit}, {values}); {RUN}"
    command = [sys.executable, "-c", limited, "run", "--config", str(_written(tmp_path, **changes))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=SECONDS_TO_FAIL, check=False)
    assert done.returncode == code, done.stderr
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError("std::bad_alloc"), "out of memory"),
        (RuntimeError("pthread_create failed, error code: 11 error msg: Resource temporarily unavailable"), "threads"),
        (OSError(errno.EMFILE, "Too many open files"), "out of file descriptors"),
    ],
)
def test_what_runs_out_while_networks_load_is_unavailable_and_no_damaged_model(
    error: Exception, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lacks(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("onnxruntime.InferenceSession", lacks)
    config = _written(tmp_path)
    assert main(["run", "--config", str(config)]) == 69
    assert told in capsys.readouterr().err.splitlines()[-1]
