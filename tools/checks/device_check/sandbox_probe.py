"""Tries what flockd's unit forbids, and prints the results as JSON. Run in flockd's place, and outside the sandbox.

The result of each attempt is "done" or the name of the error. Needs the standard library only.
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
import time
from collections.abc import Callable, Iterator
from pathlib import Path

DONE = "done"
CODE = b"\xb8\x2a\x00\x00\x00\xc3"
"""x86: return 42."""
FOREIGN_ADDRESS = "203.0.113.1"
"""An address in no private network; the check gives it to this machine itself."""
_FAILED = ctypes.c_void_p(-1).value
_READ, _WRITE, _EXECUTE = 1, 2, 4
_SHM_EXECUTE = 0o100000
_NEW_USER = 0x10000000
_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = _libc.shmat.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
_libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
_libc.shmat.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_int]


def main() -> None:
    """Prints the results."""
    results = {
        "writable folders": sorted(_writable_folders()),
        "marks": [str(path) for folder in ("/dev/shm", "/tmp", "/var/tmp") for path in Path(folder).glob("seen-*")],
        "devices opened": sorted(_opened_devices()),
        "memory": _attempts(_memory()),
        "rights": _attempts(_rights()),
        "network": _attempts(_network()),
        "status": _status(),
    }
    print(json.dumps(results))


def _attempts(attempts: dict[str, Callable[[], object]]) -> dict[str, str]:
    return {name: _attempt(action) for name, action in attempts.items()}


def _attempt(action: Callable[[], object]) -> str:
    try:
        action()
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    return DONE


def _writable_folders() -> Iterator[str]:
    """Every folder in which a file can be made; what lies below /proc is the process itself."""
    for folder, below, _ in os.walk("/"):
        below[:] = [name for name in below if (folder, name) != ("/", "proc")]
        path = Path(folder, f"probe-{os.getpid()}")
        if _attempt(functools.partial(_open, path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)) == DONE:
            path.unlink()
            yield folder


def _opened_devices() -> Iterator[str]:
    for folder, _, names in os.walk("/dev"):
        for name in names:
            path = Path(folder, name)
            mode = path.lstat().st_mode
            if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
                ways = (os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY)
                if DONE in [_attempt(functools.partial(_open, path, way)) for way in ways]:
                    yield str(path)


def _open(path: Path, flags: int) -> None:
    os.close(os.open(path, flags, 0o600))


def _memory() -> dict[str, Callable[[], object]]:
    return {
        "map writable and executable": lambda: _map(_READ | _WRITE | _EXECUTE),
        "make written memory executable": _turn_executable,
        "attach shared memory executable": _share_executable,
        "map a written file executable": lambda: _run_from(os.open(_scratch(), os.O_RDWR | os.O_CREAT, 0o700)),
        "map a file in memory executable": lambda: _run_from(os.memfd_create("probe")),
        "start a written program": _start_written,
    }


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
    private, create = 0, 0o1700
    number = _libc.shmget(private, mmap.PAGESIZE, create)
    if number < 0 or _libc.shmat(number, None, _SHM_EXECUTE) == _FAILED:
        raise OSError(ctypes.get_errno(), "shmat")


def _scratch() -> Path:
    """Where flockd may write."""
    return Path("/var/lib/flockd", f"probe-{os.getpid()}")


def _run_from(descriptor: int) -> None:
    """Writes code to a file and runs it from there."""
    try:
        os.write(descriptor, CODE.ljust(mmap.PAGESIZE, b"\0"))
        code = ctypes.CFUNCTYPE(ctypes.c_int)(_map(_READ | _EXECUTE, descriptor))
        assert code() == 42
    finally:
        os.close(descriptor)
        _scratch().unlink(missing_ok=True)


def _start_written() -> None:
    path = _scratch()
    path.write_text("#!/bin/sh\nexit 0\n", encoding="ascii")
    path.chmod(0o700)
    try:
        os.waitpid(os.posix_spawn(path, [str(path)], {}), 0)
    finally:
        path.unlink()


def _rights() -> dict[str, Callable[[], object]]:
    return {
        "new user namespace": _new_namespace,
        "realtime priority": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)),
        "set the clock": lambda: time.clock_settime(time.CLOCK_REALTIME, time.time()),
        "become root": lambda: os.setuid(0),
        "signal process 1": lambda: os.kill(1, 0),
        "see process 1": lambda: Path("/proc/1").stat(),
        "setuid file": _make_setuid,
    }


def _new_namespace() -> None:
    """In a child, which then ends: nothing after it shall run in one."""
    child = os.fork()
    if child == 0:
        os._exit(ctypes.get_errno() if _libc.unshare(_NEW_USER) else 0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code:
        raise OSError(code, "unshare")


def _make_setuid() -> None:
    path = _scratch()
    path.touch()
    try:
        path.chmod(0o4700)
    finally:
        path.unlink()


def _network() -> dict[str, Callable[[], object]]:
    return {
        "packet socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close(),
        "to the internet": lambda: _send(FOREIGN_ADDRESS),
        "to this computer": lambda: _send("127.0.0.1"),
    }


def _send(address: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"probe", (address, 9))


def _status() -> dict[str, str]:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    wanted = {"NoNewPrivs", "Seccomp", "CapEff", "CapPrm", "CapBnd", "CapAmb"}
    return {key: value.strip() for key, _, value in (line.partition(":") for line in lines) if key in wanted}


if __name__ == "__main__":
    main()
