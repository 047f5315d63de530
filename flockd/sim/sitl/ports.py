"""Ports of this computer: free ones, and what an earlier simulation has left running on others."""

from __future__ import annotations

import itertools
import os
import socket
from collections.abc import Iterator
from pathlib import Path

FIRST, COUNT = 20_000, 12_000
"""Below those that Linux gives to connections of its own choice (ip_local_port_range begins at 32,768): a port stays
free until it is used."""
_numbers = itertools.count(1009 * os.getpid())
"""Processes begin at different ports, and none gives a port twice in a row."""


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port for UDP, unless ``kind`` says another. Raises OSError where none is free."""
    for number in itertools.islice(_numbers, COUNT):
        port = FIRST + number % COUNT
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"none of the ports from {FIRST} to {FIRST + COUNT - 1} is free")


def free_endpoint() -> str:
    """A zenoh endpoint: a TCP port that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


PROC = Path("/proc")
_COMMAND_CHARACTERS = 80


def user_of_port(port: int) -> int | None:
    """The process that has bound a UDP port of this computer; None where it is another user's or there is none."""
    inodes = set()
    for line in (PROC / "net/udp").read_text(encoding="ascii").splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) == port:
            inodes.add(f"socket:[{fields[9]}]")
    for pid in _processes():
        try:
            if any(str(link.readlink()) in inodes for link in (PROC / f"{pid}/fd").iterdir()):
                return pid
        except OSError:
            continue
    return None


def px4_instance(number: int) -> int | None:
    """The process that is this instance of PX4; None where it does not run."""
    for pid in _processes():
        arguments = _arguments(pid)
        program = any(Path(argument).name == "px4" for argument in arguments[:2])  # a script's is the second
        if program and "-i" in arguments[:-1] and arguments[arguments.index("-i") + 1] == f"{number}":
            return pid
    return None


def described(pid: int) -> str:
    """A process, and how to end it."""
    command = " ".join(_arguments(pid))
    shown = command if len(command) <= _COMMAND_CHARACTERS else f"{command[:_COMMAND_CHARACTERS]}..."
    return f"process {pid}: {shown}; end it with `kill {pid}`, and start again"


def _processes() -> Iterator[int]:
    return (int(entry.name) for entry in PROC.iterdir() if entry.name.isdecimal())


def _arguments(pid: int) -> list[str]:
    try:
        raw = (PROC / f"{pid}/cmdline").read_bytes()
    except OSError:
        return []
    return raw.decode(errors="replace").removesuffix("\0").split("\0")
