"""A serial cable to a fake autopilot: a pseudo-terminal, to unplug and to plug in again under the same name."""

from __future__ import annotations

import os
import select
import socket
import threading
import tty
from contextlib import suppress
from pathlib import Path
from typing import Self


class SerialCable:
    """Carries what fake autopilots send to a UDP port, and what is written to the device to all of them."""

    def __init__(self, port: int, device: Path) -> None:
        """``device`` becomes the name of the terminal. It is plugged in between ``__enter__`` and ``__exit__``."""
        self.device = device
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._autopilots: set[tuple[str, int]] = set()
        self._ends: tuple[int, int] | None = None
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self.thread = threading.Thread(target=self._carry, daemon=True)

    @property
    def address(self) -> str:
        """For `autopilot.address`."""
        return f"serial://{self.device}:921600"

    def plug_in(self) -> None:
        """A new terminal has the device's name; the one before it may have another number."""
        autopilot, computer = os.openpty()
        tty.setraw(computer)
        os.set_blocking(autopilot, False)
        Path(os.ttyname(computer)).chmod(0o666)
        self.device.symlink_to(os.ttyname(computer))
        with self._lock:
            self._ends = autopilot, computer

    def unplug(self) -> None:
        """Whoever has the device open is hung up on."""
        with self._lock:
            ends, self._ends = self._ends, None
        self.device.unlink(missing_ok=True)
        for end in ends or ():
            os.close(end)

    def __enter__(self) -> Self:
        self.plug_in()
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self.thread.join()
        self.unplug()
        self._socket.close()

    def _carry(self) -> None:
        while not self._closing.is_set():
            with self._lock:
                autopilot = None if self._ends is None else self._ends[0]
            packets = self._socket.fileno()
            ready, _, _ = select.select([packets, *([] if autopilot is None else [autopilot])], [], [], 0.05)
            if packets in ready:
                data, sender = self._socket.recvfrom(4096)
                self._autopilots.add(sender)
                self._move(data)
            if autopilot in ready:
                self._move(None)

    def _move(self, data: bytes | None) -> None:
        """``data`` to the device, or what was written to the device to the autopilots."""
        with self._lock, suppress(OSError):
            if self._ends is None:
                return
            if data is not None:
                os.write(self._ends[0], data)
                return
            written = os.read(self._ends[0], 4096)
            for autopilot in self._autopilots:
                self._socket.sendto(written, autopilot)
