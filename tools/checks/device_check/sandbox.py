"""Checks of the unit's sandbox: this module is started in flockd's place, tries what the unit forbids, and says so.

To leave nothing to the ordinary rights of files, there are folders and devices outside that everybody may write. The
result of each attempt is "done" or the name of the error. Needs the standard library only.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import json
import mmap
import os
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator
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
NEEDED = {"to this computer", "map a file in memory executable"}
"""What has to go through: libffi needs the second for MAVSDK's callbacks, as the unit says."""
FOREIGN_ADDRESS = "203.0.113.1"
"""An address in no private network; the check gives it to this machine itself."""
CODE = b"\xb8\x2a\x00\x00\x00\xc3"
"""x86: return 42."""
_FAILED = ctypes.c_void_p(-1).value
_READ, _WRITE, _EXECUTE, _SHM_EXECUTE, _NEW_USER = 1, 2, 4, 0o100000, 0x10000000
_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = _libc.shmat.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
_libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
_libc.shmat.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_int]


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
    run("ip", "address", "replace", f"{FOREIGN_ADDRESS}/32", "dev", "lo")
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
    done = {what for what, result in inside["attempts"].items() if result == "done"}
    refused = ", ".join(f"{what} {result}" for what, result in inside["attempts"].items() if result != "done")
    yield Finding(
        "sandbox: memory, rights, network", done == NEEDED,
        f"allowed: {', '.join(sorted(done))}; refused: {refused}", f"{', '.join(sorted(NEEDED))} alone, as it needs it",
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
        "attempts": {name: _attempt(action) for name, action in ATTEMPTS.items()},
        "status": {key: value.strip() for key, _, value in status},
    }
    print(json.dumps(results))


def _attempt(action: Callable[[], object]) -> str:
    try:
        action()
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    return "done"


def _writable_folders() -> Iterator[str]:
    """Every folder in which a file can be made; what lies below /proc is the process itself."""
    for folder, below, _ in os.walk("/"):
        below[:] = [name for name in below if (folder, name) != ("/", "proc")]
        path = Path(folder, f"probe-{os.getpid()}")
        if _attempt(functools.partial(_open, path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)) == "done":
            path.unlink()
            yield folder


def _opened_devices() -> Iterator[str]:
    for folder, _, names in os.walk("/dev"):
        for path in (Path(folder, name) for name in names):
            mode = path.lstat().st_mode
            if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
                ways = (os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY)
                if "done" in [_attempt(functools.partial(_open, path, way)) for way in ways]:
                    yield str(path)


def _open(path: Path, flags: int) -> None:
    os.close(os.open(path, flags, 0o600))


def _map(protection: int, descriptor: int = -1) -> int:
    kind = mmap.MAP_PRIVATE | (mmap.MAP_ANONYMOUS if descriptor < 0 else 0)
    address = _libc.mmap(None, mmap.PAGESIZE, protection, kind, descriptor, 0)
    if address == _FAILED:
        raise OSError(ctypes.get_errno(), "mmap")
    return int(address)


def _turn_executable() -> None:
    address = _map(_READ | _WRITE)
    ctypes.memmove(address, CODE, len(CODE))
    if _libc.mprotect(address, mmap.PAGESIZE, _READ | _EXECUTE):
        raise OSError(ctypes.get_errno(), "mprotect")


def _share_executable() -> None:
    number = _libc.shmget(0, mmap.PAGESIZE, 0o1700)  # IPC_PRIVATE; IPC_CREAT
    if number < 0 or _libc.shmat(number, None, _SHM_EXECUTE) == _FAILED:
        raise OSError(ctypes.get_errno(), "shmat")


def _scratch() -> Path:
    """Where flockd may write."""
    return Path("/var/lib/flockd", f"probe-{os.getpid()}")


def _run_from(descriptor: int) -> None:
    """Writes code to a file and runs it from there."""
    try:
        os.write(descriptor, CODE.ljust(mmap.PAGESIZE, b"\0"))
        assert ctypes.CFUNCTYPE(ctypes.c_int)(_map(_READ | _EXECUTE, descriptor))() == 42
    finally:
        os.close(descriptor)
        _scratch().unlink(missing_ok=True)


def _with_mode(mode: int, then: Callable[[Path], object]) -> None:
    """A program of ours in flockd's own folder."""
    path = _scratch()
    path.write_text("#!/bin/sh\nexit 0\n", encoding="ascii")
    try:
        path.chmod(mode)
        then(path)
    finally:
        path.unlink()


def _new_namespace() -> None:
    """In a child, which then ends: nothing after it shall run in one."""
    child = os.fork()
    if child == 0:
        os._exit(ctypes.get_errno() if _libc.unshare(_NEW_USER) else 0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code:
        raise OSError(code, "unshare")


def _send(address: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"probe", (address, 9))


ATTEMPTS: dict[str, Callable[[], object]] = {
    "map writable and executable": lambda: _map(_READ | _WRITE | _EXECUTE),
    "make written memory executable": _turn_executable,
    "attach shared memory executable": _share_executable,
    "map a written file executable": lambda: _run_from(os.open(_scratch(), os.O_RDWR | os.O_CREAT, 0o700)),
    "map a file in memory executable": lambda: _run_from(os.memfd_create("probe")),
    "start a written program": lambda: _with_mode(
        0o700, lambda path: os.waitpid(os.posix_spawn(path, [str(path)], {}), 0)
    ),
    "new user namespace": _new_namespace,
    "realtime priority": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)),
    "set the clock": lambda: time.clock_settime(time.CLOCK_REALTIME, time.time()),
    "become root": lambda: os.setuid(0),
    "signal process 1": lambda: os.kill(1, 0),
    "see process 1": lambda: Path("/proc/1").stat(),
    "setuid file": lambda: _with_mode(0o4700, lambda _path: None),
    "packet socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close(),
    "to the internet": lambda: _send(FOREIGN_ADDRESS),
    "to this computer": lambda: _send("127.0.0.1"),
}


if __name__ == "__main__":
    probe()
