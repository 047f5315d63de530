"""Checks of the unit's sandbox: this module is started in flockd's place, tries what the unit forbids, and says so.

To leave nothing to the ordinary rights of files, there are folders and devices outside that everybody may write. What
systemd does by the unit's other lines (memory, namespaces, network), `systemd-analyze security` tells the service's
checks. Needs the standard library only.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools.checks.device_check.findings import UNIT, Finding, run

DROP_IN = Path(f"/run/systemd/system/{UNIT}.d/probe.conf")
RESULTS = Path("/run/probe.json")
ROOT = Path(__file__).parents[3]
OPEN_FOLDERS = ("/etc/open", "/home/open", "/opt/open", "/srv/open", "/usr/open", "/var/open")
OPEN_DISK = Path("/dev/open-disk")
FOLDERS, PRIVATE_FOLDERS = {"/var/lib/flockd", "/run/flockd"}, {"/dev/shm", "/tmp", "/var/tmp"}
MARK = "seen-from-outside"
DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty", "/dev/ptmx", "/dev/pts/")
"""What every program may open."""
LISTED = ("/dev/video", "/dev/ttyS")


def holds() -> Iterator[Finding]:
    """What goes through inside."""
    for folder in OPEN_FOLDERS:
        Path(folder).mkdir(exist_ok=True)
        Path(folder).chmod(0o1777)
    for folder in PRIVATE_FOLDERS:
        Path(folder, MARK).touch()
    if not OPEN_DISK.exists():
        os.mknod(OPEN_DISK, stat.S_IFBLK, Path("/dev/vda").stat().st_rdev)
    OPEN_DISK.chmod(0o666)
    inside = _probed()
    writable, opened = set(inside["writable folders"]), set(inside["devices opened"])
    strange = sorted(
        one for one in writable if not any(f"{one}/".startswith(f"{f}/") for f in FOLDERS | PRIVATE_FOLDERS)
    )
    yield Finding(
        "sandbox: folders", not strange and not inside["marks"] and writable >= FOLDERS,
        f"writes {', '.join(sorted(writable))}, shares {', '.join(inside['marks']) or 'none of them'}",
        f"{', '.join(sorted(FOLDERS))}; {', '.join(sorted(PRIVATE_FOLDERS))} of its own",
    )  # fmt: skip
    strange = sorted(device for device in opened if not device.startswith((*DEVICES, *LISTED)))
    listed = sorted(device for device in opened if device.startswith(LISTED))
    yield Finding(
        "sandbox: devices", not strange and bool(listed), f"opens {', '.join([*listed, *strange])}",
        "cameras, serial ports and what every program may",
    )  # fmt: skip
    status = inside["status"]
    none = {status[key] for key in ("CapEff", "CapPrm", "CapBnd", "CapAmb")} == {"0" * 16}
    yield Finding(
        "sandbox: capabilities", none and (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2"),
        "none, no new ones, system calls filtered" if none else str(status), "none",
    )  # fmt: skip


def _probed() -> dict[str, Any]:
    """The unit as it is, but for what it starts and how long that lives."""
    DROP_IN.parent.mkdir(parents=True, exist_ok=True)
    DROP_IN.write_text(
        "[Service]\nType=oneshot\nRestart=no\nWatchdogSec=0\nTimeoutStartSec=300\n"
        f"Environment=PYTHONPATH={ROOT} PYTHONDONTWRITEBYTECODE=1\n"
        f"ExecStart=\nExecStart={sys.executable} -m {__name__}\nStandardOutput=truncate:{RESULTS}\n",
        encoding="utf-8",
    )
    try:
        run("systemctl", "daemon-reload")
        run("systemctl", "start", UNIT)
    finally:
        DROP_IN.unlink()
        run("systemctl", "daemon-reload")
    results: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return results


# Inside.


def probe() -> None:
    """Prints the results."""
    status = (line.partition(":") for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines())
    results = {
        "writable folders": sorted(_writable_folders()),
        "marks": [str(path) for folder in sorted(PRIVATE_FOLDERS) for path in Path(folder).glob(MARK)],
        "devices opened": sorted(_opened_devices()),
        "status": {key: value.strip() for key, _, value in status},
    }
    print(json.dumps(results))


def _can_open(path: Path, flags: int) -> bool:
    with contextlib.suppress(OSError):
        os.close(os.open(path, flags, 0o600))
        return True
    return False


def _writable_folders() -> Iterator[str]:
    """Every folder in which a file can be made; what lies below /proc is the process itself."""
    for folder, below, _ in os.walk("/"):
        below[:] = [name for name in below if (folder, name) != ("/", "proc")]
        path = Path(folder, f"probe-{os.getpid()}")
        if _can_open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY):
            path.unlink()
            yield folder


def _opened_devices() -> Iterator[str]:
    for folder, _, names in os.walk("/dev"):
        for path in (Path(folder, name) for name in names):
            mode = path.lstat().st_mode
            ways = (os.O_RDONLY, os.O_RDWR) if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) else ()
            if any(_can_open(path, way | os.O_NONBLOCK | os.O_NOCTTY) for way in ways):
                yield str(path)


if __name__ == "__main__":
    probe()
