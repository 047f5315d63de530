"""Checks of the Debian package, inside the virtual machine: what a new user does, from `apt install` to `apt purge`.

python3 -m tools.checks.device_check.package FINDINGS OLD.deb NEW.deb

Needs Debian's Python alone, as flockd comes with the package and goes with it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tools.checks.device_check.findings import Finding, Notebook
from tools.checks.device_check.waiting import until

UNIT = "flockd.service"
CONFIG = Path("/etc/flockd/drone.yaml")
RECORDINGS = Path("/var/lib/flockd")
PYTHON = "/usr/lib/flockd/bin/python"
DRONE = Path("tools/checks/device_check/drone.yaml")
INSTALLED = ("/usr/lib/flockd", "/usr/bin/flockd", "/usr/lib/systemd/system/flockd.service", "/run/flockd")
CAMERAS = """
from tools.checks.device_check import cameras
cameras.load()
cameras.loopback((160, 120), 5.0)._process.wait()
"""
AUTOPILOT_IS_UP = Path("/run/autopilot_is_up")
AUTOPILOT = f"""
import pathlib
import time
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
FakeAutopilot(14540).start()
pathlib.Path("{AUTOPILOT_IS_UP}").touch()
time.sleep(1e6)
"""
"""As in drone.yaml."""
PATIENT = Path("/run/systemd/system/flockd.service.d/patient.conf")
"""An emulated processor takes minutes to load flockd, and is not always back within the watchdog's two seconds."""
PATIENCE_S = 900.0


class Package:
    """The package in two versions, and who the service talks to."""

    def __init__(self, old: str, new: str) -> None:
        """``old`` and ``new``: files."""
        self._old, self._new = old, new
        self._others: list[subprocess.Popen[bytes]] = []
        self._begun_s = 0.0

    def close(self) -> None:
        """Leaves no process behind."""
        for process in self._others:
            process.kill()
            process.wait()

    def installs(self) -> Iterator[Finding]:
        """On a Debian that has never seen flockd."""
        self._begun_s = time.monotonic()
        said = _apt("install", self._old)
        took_s = time.monotonic() - self._begun_s
        yield Finding(
            "apt install", "fill in /etc/flockd/drone.yaml" in said, f"{took_s:.0f} s", "says what to do next"
        )
        state = f"{_shown('UnitFileState')}, {_shown('ActiveState')}"
        yield Finding("starts nothing", state == "disabled, inactive", state, "disabled, inactive")
        verify = _run("systemd-analyze", "verify", f"/usr/lib/systemd/system/{UNIT}")
        yield Finding("packaged unit verified", not verify.strip(), verify.strip() or "no complaint", "no complaint")
        yield Finding("on the PATH", "usage: flockd" in _run("flockd", "--help"), _which(), "/usr/bin/flockd")

    def gets_ready(self) -> Iterator[Finding]:
        """Configured, checked, enabled; the time of the cameras' and the autopilot's start is not the user's."""
        others_s = time.monotonic()
        self._others = [_python(CAMERAS), _python(AUTOPILOT)]
        until(lambda: Path("/dev/video20").exists(), "the cameras", within_s=PATIENCE_S)
        until(AUTOPILOT_IS_UP.exists, "the autopilot", within_s=PATIENCE_S)
        others_s = time.monotonic() - others_s
        shutil.copy(DRONE, CONFIG)
        checked = _run("flockd", "config", "check", str(CONFIG))
        yield Finding("flockd config check", str(CONFIG) in checked, checked.strip().splitlines()[-1], "accepted")
        PATIENT.parent.mkdir(parents=True)
        PATIENT.write_text(f"[Service]\nTimeoutStartSec={PATIENCE_S:g}\nWatchdogSec=60\n", encoding="ascii")
        _run("systemctl", "daemon-reload")
        _run("systemctl", "enable", UNIT)
        _run("systemctl", "start", "--no-block", UNIT)  # should it begin anew, that is waited for too
        _until_active()
        took_s = time.monotonic() - self._begun_s - others_s
        yield Finding(
            "from apt install to a ready service",
            _shown("UnitFileState") == "enabled",
            f"{took_s / 60:.1f} min in 4 steps: install, fill in, check, enable",
            "active and enabled",
        )

    def is_upgraded(self) -> Iterator[Finding]:
        """While it runs: the process must live on, and the configuration stay."""
        process, settings = _shown("MainPID"), CONFIG.read_bytes()
        said = _apt("install", self._new)
        after = _shown("MainPID")
        same = after == process != "0"
        yield Finding("upgraded under way", same, f"process {process}, then {after}", "the same process")
        told = "sudo systemctl restart flockd.service" in said
        yield Finding("says what to restart", told, "it does" if told else said[-200:], "the command to restart it")
        kept = CONFIG.read_bytes() == settings
        yield Finding("configuration kept", kept, "as it was" if kept else "changed", "every byte")
        _run("systemctl", "restart", "--no-block", UNIT)
        until(lambda: _shown("MainPID") != process, "the old process to end", within_s=PATIENCE_S)
        _until_active()
        version = _run("dpkg-query", "-W", "-f", "${Version}", "flockd")
        yield Finding("new version runs", version in self._new, version, "that of the newer file")

    def is_removed(self) -> Iterator[Finding]:
        """Removed, then purged with recordings, then without."""
        _apt("remove", "flockd")
        left = [path for path in INSTALLED if Path(path).exists()]
        state = _shown("ActiveState")
        yield Finding("apt remove", not left and state == "inactive", f"{state}; left: {left}", "stopped, nothing left")
        yield Finding("configuration outlives it", CONFIG.exists(), str(CONFIG.exists()), "True")
        recordings = list(RECORDINGS.glob("*.mcap"))
        said = _apt("purge", "flockd")
        kept = all(path.exists() for path in recordings) and "recordings stay in" in said
        found = f"{len(recordings)} recordings kept, configuration {'left' if CONFIG.exists() else 'deleted'}"
        yield Finding(
            "apt purge", bool(recordings) and kept and not CONFIG.parent.exists(), found, "keeps recordings only"
        )
        shutil.rmtree(RECORDINGS)
        _apt("install", self._new)
        _apt("purge", "flockd")
        left = [str(path) for path in (RECORDINGS, CONFIG.parent, *map(Path, INSTALLED)) if path.exists()]
        user = subprocess.run(["getent", "passwd", "flockd"], stdout=subprocess.DEVNULL, check=False).returncode == 0
        yield Finding("purged without recordings", not left and not user, f"left: {left}; user: {user}", "nothing left")


def main() -> None:
    """All checks in their order."""
    findings, old, new = sys.argv[1:]
    notebook, package = Notebook(Path(findings), ()), Package(old, new)
    notebook.run("package", (package.installs, package.gets_ready, package.is_upgraded, package.is_removed))
    package.close()
    notebook.close()


def _apt(*arguments: str) -> str:
    """Without a question: an edited configuration file is kept."""
    return _run("apt-get", "--yes", "--quiet", "-o", "Dpkg::Options::=--force-confold", *arguments)


def _run(*command: str) -> str:
    """What a command prints on both streams. Raises RuntimeError with the end of it where the command fails."""
    result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{' '.join(command)}: {result.stdout.strip()[-400:]}")
    return result.stdout


def _shown(what: str) -> str:
    """A property of the unit."""
    return _run("systemctl", "show", UNIT, "--value", "-p", what).strip()


def _until_active() -> None:
    """The service is ready. Raises RuntimeError with the end of its journal where it does not get so."""
    try:
        until(lambda: _shown("ActiveState") == "active", "the service to be ready", within_s=PATIENCE_S)
    except TimeoutError as error:
        journal = _run("journalctl", "--unit", UNIT, "--lines", "12", "--output", "cat")
        raise RuntimeError(f"{error}: {journal}") from None


def _which() -> str:
    return shutil.which("flockd") or "nowhere"


def _python(program: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([PYTHON, "-c", program])


if __name__ == "__main__":
    main()
