"""Checks of the unit's sandbox: a probe is started in flockd's place, and again as the same user without the sandbox.

What it can do outside and cannot do inside is the sandbox's doing. To leave nothing to the ordinary rights of files,
there are folders and devices outside that everybody may write.
"""

from __future__ import annotations

import json
import os
import stat
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tools.checks.device_check.cameras import run
from tools.checks.device_check.findings import Finding

UNIT = "flockd.service"
DROP_IN = Path("/run/systemd/system/flockd.service.d/probe.conf")
RESULTS = Path("/run/probe.json")
PROBE = Path(__file__).with_name("sandbox_probe.py")
OPEN_FOLDERS = {"/etc/open", "/home/open", "/opt/open", "/srv/open", "/usr/open", "/var/open"}
OPEN_DISK = Path("/dev/open-disk")
OPEN_DEVICES = {str(OPEN_DISK), "/dev/fuse", "/dev/net/tun"}
FOLDERS = {"/var/lib/flockd", "/run/flockd"}
PRIVATE_FOLDERS = {"/dev/shm", "/tmp", "/var/tmp"}
MARK = "seen-from-outside"
DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty", "/dev/ptmx", "/dev/pts/")
"""What every program may open."""
LISTED = ("/dev/video", "/dev/ttyS")
NEEDED = {"to this computer", "map a file in memory executable"}
"""What has to go through: libffi needs the second for MAVSDK's callbacks, as the unit says."""
TELLING = {
    *("map writable and executable", "make written memory executable", "attach shared memory executable"),
    *("map a written file executable", "map a file in memory executable", "start a written program"),
    *("new user namespace", "see process 1", "setuid file", "to the internet", "to this computer"),
}
"""What goes through outside, so that its refusal inside is the sandbox's; everything else is for root only."""
FOREIGN_ADDRESS = "203.0.113.1/32"


def holds() -> Iterator[Finding]:
    """Inside against outside."""
    _open_the_outside()
    inside = _probe_inside()  # first: systemd makes the unit's folders
    outside = _probe_outside()
    yield _folders(inside, outside)
    yield _devices(inside, outside)
    for part in ("memory", "rights", "network"):
        yield _attempts(part, inside[part], outside[part])
    status = inside["status"]
    none = {status[key] for key in ("CapEff", "CapPrm", "CapBnd", "CapAmb")} == {"0" * 16}
    yield Finding(
        "sandbox: capabilities",
        none and (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2"),
        "none, no new ones, system calls filtered" if none else str(status),
        "none",
    )


def _open_the_outside() -> None:
    for folder in OPEN_FOLDERS:
        Path(folder).mkdir(exist_ok=True)
        Path(folder).chmod(0o1777)
    for folder in PRIVATE_FOLDERS:
        Path(folder, MARK).touch()
    if not OPEN_DISK.exists():
        os.mknod(OPEN_DISK, stat.S_IFBLK, Path("/dev/vda").stat().st_rdev)
    OPEN_DISK.chmod(0o666)
    run("ip", "address", "replace", FOREIGN_ADDRESS, "dev", "lo")


def _probe_outside() -> Mapping[str, Any]:
    command = ["setpriv", "--reuid=flockd", "--regid=flockd", "--groups=video,dialout", sys.executable, str(PROBE)]
    return _parsed(run(*command))


def _probe_inside() -> Mapping[str, Any]:
    """The unit as it is, but for what it starts and how long that lives."""
    DROP_IN.parent.mkdir(parents=True, exist_ok=True)
    DROP_IN.write_text(
        "[Service]\nType=oneshot\nRestart=no\nWatchdogSec=0\nTimeoutStartSec=300\n"
        f"ExecStart=\nExecStart={sys.executable} {PROBE}\nStandardOutput=truncate:{RESULTS}\n",
        encoding="utf-8",
    )
    try:
        run("systemctl", "daemon-reload")
        run("systemctl", "start", UNIT)
    finally:
        DROP_IN.unlink()
        run("systemctl", "daemon-reload")
    return _parsed(RESULTS.read_text(encoding="utf-8"))


def _parsed(text: str) -> Mapping[str, Any]:
    results: Mapping[str, Any] = json.loads(text)
    return results


def _folders(inside: Mapping[str, Any], outside: Mapping[str, Any]) -> Finding:
    """What can be written inside, beside what is private to the unit and gone with it."""
    writable = set(inside["writable folders"])
    strange = {folder for folder in writable if not _is_within(folder, FOLDERS | PRIVATE_FOLDERS)}
    shared = sorted(folder for folder in PRIVATE_FOLDERS if f"{folder}/{MARK}" in inside["marks"])
    forbidden = set(outside["writable folders"]) - writable
    return Finding(
        "sandbox: folders",
        not strange and not shared and writable >= FOLDERS and forbidden >= OPEN_FOLDERS,
        f"writes {', '.join(sorted(writable))}, shares {', '.join(shared) or 'none of them'}; "
        f"not {', '.join(sorted(forbidden))}",
        f"{', '.join(sorted(FOLDERS))}; {', '.join(sorted(PRIVATE_FOLDERS))} of its own",
    )


def _devices(inside: Mapping[str, Any], outside: Mapping[str, Any]) -> Finding:
    opened = set(inside["devices opened"])
    strange = {device for device in opened if not device.startswith((*DEVICES, *LISTED))}
    listed = sorted(device for device in opened if device.startswith(LISTED))
    forbidden = set(outside["devices opened"]) - opened
    return Finding(
        "sandbox: devices",
        not strange and bool(listed) and forbidden >= OPEN_DEVICES,
        f"opens {', '.join([*listed, *sorted(strange)])}; not {', '.join(sorted(forbidden))}",
        "cameras, serial ports and what every program may",
    )


def _attempts(part: str, inside: Mapping[str, str], outside: Mapping[str, str]) -> Finding:
    allowed = sorted(what for what, result in inside.items() if result == "done" and what not in NEEDED)
    powerless = sorted(what for what, result in outside.items() if result != "done" and what in TELLING)
    broken = sorted(what for what, result in inside.items() if result != "done" and what in NEEDED)
    refused = ", ".join(f"{what} {result}" for what, result in inside.items() if result != "done")
    needed = ", ".join(sorted(NEEDED & inside.keys()))
    measured = f"{', '.join(allowed) or 'nothing'} allowed{f' but {needed}, which it needs' if needed else ''}; "
    measured += f"refused: {refused}"
    measured += f"; outside could not either: {', '.join(powerless)}" if powerless else ""
    return Finding(f"sandbox: {part}", not allowed and not powerless and not broken, measured, "all others refused")


def _is_within(folder: str, roots: set[str]) -> bool:
    return any(folder == root or folder.startswith(f"{root}/") for root in roots)
