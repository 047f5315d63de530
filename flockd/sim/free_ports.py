"""Ports of this computer that nobody uses now."""

from __future__ import annotations

import socket


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port for UDP, unless ``kind`` says another."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """A zenoh endpoint: a TCP port that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
