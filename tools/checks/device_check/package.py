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

from tools.checks.device_check.findings import UNIT, Finding, run, run_checks, shown, until

CONFIG, RECORDINGS = Path("/etc/flockd/drone.yaml"), Path("/var/lib/flockd")
PYTHON = "/usr/lib/flockd/bin/python"
DRONE = Path("tools/checks/device_check/drone.yaml")
INSTALLED = ("/usr/lib/flockd", "/usr/bin/flockd", "/usr/lib/systemd/system/flockd.service", "/run/flockd")
AUTOPILOT_IS_UP = Path("/run/autopilot_is_up")
CAMERAS = """
from tools.checks.device_check import cameras
cameras.load()
cameras.feed("mjpeg", (160, 120), 5.0)
"""
AUTOPILOT = f"""
import pathlib
import time
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
FakeAutopilot(14540).start()
pathlib.Path("{AUTOPILOT_IS_UP}").touch()
time.sleep(1e6)
"""
"""As in drone.yaml."""
PATIENT = Path(f"/run/systemd/system/{UNIT}.d/patient.conf")
"""An emulated processor takes minutes to load flockd, and is not always back within the watchdog's two seconds."""
PATIENCE_S = 900.0
OTHERS: list[subprocess.Popen[bytes]] = []
"""What runs beside: cameras and autopilot."""


def main() -> None:
    """All checks in their order."""
    run_checks(Path(sys.argv[1]), (gets_ready, is_upgraded, is_removed))
    for process in OTHERS:
        process.kill()
        process.wait()


def gets_ready() -> Iterator[Finding]:
    """On a Debian that has never seen flockd; the start of the cameras and the autopilot is not counted."""
    begun_s = time.monotonic()
    said = _apt("install", sys.argv[2])
    took_s = time.monotonic() - begun_s
    next_step = "fill in /etc/flockd/drone.yaml"
    yield Finding("apt install", next_step in said, f"{took_s:.0f} s", "says what to do next")
    state = f"{shown('UnitFileState')}, {shown('ActiveState')}"
    yield Finding("starts nothing", state == "disabled, inactive", state, "disabled, inactive")
    verify = run("systemd-analyze", "verify", f"/usr/lib/systemd/system/{UNIT}").strip()
    yield Finding("packaged unit verified", not verify, verify or "no complaint", "no complaint")
    others_s = time.monotonic()
    OTHERS.extend(subprocess.Popen([PYTHON, "-c", program]) for program in (CAMERAS, AUTOPILOT))
    until(lambda: Path("/dev/video20").exists(), "the cameras", within_s=PATIENCE_S)
    until(AUTOPILOT_IS_UP.exists, "the autopilot", within_s=PATIENCE_S)
    others_s = time.monotonic() - others_s
    shutil.copy(DRONE, CONFIG)
    checked = run("flockd", "config", "check", str(CONFIG)).strip()
    yield Finding("flockd config check", str(CONFIG) in checked, checked.splitlines()[-1], "accepted")
    PATIENT.parent.mkdir(parents=True)
    PATIENT.write_text(f"[Service]\nTimeoutStartSec={PATIENCE_S:g}\nWatchdogSec=60\n", encoding="ascii")
    run("systemctl", "daemon-reload")
    run("systemctl", "enable", UNIT)
    run("systemctl", "start", "--no-block", UNIT)  # should it begin anew, that is waited for too
    _until_active()
    yield Finding(
        "from apt install to a ready service", shown("UnitFileState") == "enabled",
        f"{(time.monotonic() - begun_s - others_s) / 60:.1f} min in 4 steps: install, fill in, check, enable",
        "active and enabled",
    )  # fmt: skip


def is_upgraded() -> Iterator[Finding]:
    """While it runs: the process must live on, and the configuration stay."""
    new, process, settings = sys.argv[3], shown("MainPID"), CONFIG.read_bytes()
    said = _apt("install", new)
    after = shown("MainPID")
    yield Finding(
        "upgraded under way", after == process != "0" and "sudo systemctl restart flockd.service" in said,
        f"process {process}, then {after}; {said[-100:]!r}", "the same process, and the command to restart it",
    )  # fmt: skip
    kept = CONFIG.read_bytes() == settings
    yield Finding("configuration kept", kept, "as it was" if kept else "changed", "every byte")
    run("systemctl", "restart", "--no-block", UNIT)
    until(lambda: shown("MainPID") != process, "the old process to end", within_s=PATIENCE_S)
    _until_active()
    version = run("dpkg-query", "-W", "-f", "${Version}", "flockd")
    yield Finding("new version runs", version in new, version, "that of the newer file")


def is_removed() -> Iterator[Finding]:
    """Removed, then purged with recordings, then without."""
    _apt("remove", "flockd")
    left, state = [path for path in INSTALLED if Path(path).exists()], shown("ActiveState")
    yield Finding(
        "apt remove", not left and state == "inactive" and CONFIG.exists(), f"{state}; left: {left}",
        "stopped, nothing left but its configuration",
    )  # fmt: skip
    recordings = list(RECORDINGS.glob("*.mcap"))
    said = _apt("purge", "flockd")
    kept = bool(recordings) and all(path.exists() for path in recordings) and "recordings stay in" in said
    yield Finding(
        "apt purge", kept and not CONFIG.parent.exists(),
        f"{len(recordings)} recordings; {said[-100:]!r}", "keeps recordings only",
    )  # fmt: skip
    shutil.rmtree(RECORDINGS)
    _apt("install", sys.argv[3])
    _apt("purge", "flockd")
    left = [path for path in (str(RECORDINGS), str(CONFIG.parent), *INSTALLED) if Path(path).exists()]
    user = subprocess.run(["getent", "passwd", "flockd"], stdout=subprocess.DEVNULL, check=False).returncode == 0
    yield Finding("purged without recordings", not left and not user, f"left: {left}; user: {user}", "nothing left")


def _apt(*arguments: str) -> str:
    """Without a question: an edited configuration file is kept."""
    return run("apt-get", "--yes", "--quiet", "-o", "Dpkg::Options::=--force-confold", *arguments)


def _until_active() -> None:
    """The service is ready. Raises RuntimeError with the end of its journal where it does not get so."""
    try:
        until(lambda: shown("ActiveState") == "active", "the service to be ready", within_s=PATIENCE_S)
    except TimeoutError as error:
        journal = run("journalctl", "--unit", UNIT, "--lines", "12", "--output", "cat")
        raise RuntimeError(f"{error}: {journal}") from None


if __name__ == "__main__":
    main()
