"""Notifications to a service manager by sd_notify(3): ready, watchdog, stopping."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping

FEEDS_A_PERIOD = 4
"""How often in its period the watchdog is fed."""


class ServiceManager:
    """systemd, if it started this process with a notify socket; else a no-op. Sending never waits and never fails."""

    def __init__(self, environment: Mapping[str, str], *, clock: Callable[[], float] = time.monotonic) -> None:
        """``environment`` is the process's own: NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID."""
        self._clock = clock
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        meant = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._period_s = int(environment.get("WATCHDOG_USEC", "0")) * 1e-6 if meant else 0.0
        self._fed_s = float("-inf")

    def ready(self, status: str) -> None:
        """Startup is complete."""
        self._send("READY=1", f"STATUS={status}")

    def status(self, status: str) -> None:
        """One line for people."""
        self._send(f"STATUS={status}")

    def starting(self, status: str, more_s: float) -> None:
        """Not ready yet: extends the start time-out by ``more_s``."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(more_s * 1e6)}", f"STATUS={status}")

    def stopping(self) -> None:
        """About to end."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feeds the watchdog when due. Only the control loop may call it: its hanging is what the watchdog detects."""
        now = self._clock()
        if self._period_s and now - self._fed_s >= self._period_s / FEEDS_A_PERIOD:
            self._fed_s = now
            self._send("WATCHDOG=1")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:  # the flight goes on; the manager's watchdog decides
            return
