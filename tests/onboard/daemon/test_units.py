"""The systemd units: what systemd itself says of them, and that they start what there is."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config.safety import SafetyParameters
from flockd.onboard.autopilot import streamer
from flockd.onboard.daemon import autopilot_tasks, daemon

UNITS = Path(__file__).parents[3] / "systemd"
NAMES = ("flockd.service", "flockd@.service")
MAX_EXPOSURE = 1.5
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")


@needs_systemd
@pytest.mark.parametrize("name", NAMES)
def test_systemd_finds_nothing_wrong(name: str, tmp_path: Path) -> None:
    unit = (UNITS / name).read_text(encoding="utf-8")
    (tmp_path / name).write_text(unit.replace("/opt/flockd/bin/flockd", "/bin/true"), encoding="utf-8")
    result = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / name)], capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stderr) == (0, "")


@needs_systemd
@pytest.mark.parametrize("name", NAMES)
def test_little_is_exposed(name: str) -> None:
    threshold = f"--threshold={MAX_EXPOSURE * 10:.0f}"
    command = ["systemd-analyze", "security", "--offline=true", threshold, str(UNITS / name)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout.splitlines()[-1]


def test_the_template_is_the_unit_but_for_its_names() -> None:
    unit, template = ((UNITS / name).read_text(encoding="utf-8").splitlines() for name in NAMES)
    differ = {line.partition("=")[0] for line in set(unit) ^ set(template) if not line.startswith("#")}
    assert differ == {"Description", "ExecStart", "TemporaryFileSystem"}


@pytest.mark.parametrize("name", NAMES)
def test_it_starts_a_command_that_there_is(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    unit = (UNITS / name).read_text(encoding="utf-8")
    (start,) = (line for line in unit.splitlines() if line.startswith("ExecStart="))
    _, *arguments = shlex.split(start.partition("=")[2])
    with pytest.raises(SystemExit) as exit_:
        main([*arguments, "--help"])
    assert exit_.value.code == 0
    capsys.readouterr()


@pytest.mark.parametrize("name", NAMES)
def test_it_may_open_the_serial_ports_of_the_computers_that_it_is_installed_on(name: str) -> None:
    """By the names of Linux's drivers: of a PC, a Raspberry Pi, a Jetson, and on USB, an autopilot and an adapter."""
    allowed = set((UNITS / name).read_text(encoding="utf-8").splitlines())
    assert {f"DeviceAllow=char-tty{port} rw" for port in ("S", "AMA", "THS", "ACM", "USB")} <= allowed


@pytest.mark.parametrize("name", NAMES)
def test_the_service_manager_waits_for_the_longest_end(name: str) -> None:
    """Hold or a landing that is not confirmed, and then each part of the drone hangs until its own deadline; and with a
    dead control loop nothing feeds the watchdog while the autopilot is asked for Hold."""
    unit = dict(line.partition("=")[::2] for line in (UNITS / name).read_text(encoding="utf-8").splitlines())
    on_workers, on_the_loop = 3, 2  # frames, pilot and telemetry; link and recording
    landing_s = autopilot_tasks.FROM_HOLD_S + autopilot_tasks.RETRY_S + autopilot_tasks.REPLY_S
    ends_s = max(SafetyParameters().ask_timeout_s, landing_s) + streamer.CLOSE_TIMEOUT_S
    ends_s += on_workers * daemon.CLOSE_S + on_the_loop * 2 * daemon.CLOSE_S
    assert ends_s + 1.0 < float(unit["TimeoutStopSec"])
    assert float(unit["WatchdogSec"]) > daemon.HOLD_S + 0.1
