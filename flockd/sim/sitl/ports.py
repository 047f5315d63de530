"""Free ports of this computer."""

from __future__ import annotations

import itertools
import os
import socket

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
