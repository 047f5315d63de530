"""A serial port to the autopilot: one owner, idle without data, and reopened when the device is back.

MAVSDK 4.1's own serial link polls without a pause, using up to a whole core, shares its port with any other program,
and does not recover after the device was unplugged. It gets the bytes through this port instead.
"""

from __future__ import annotations

import errno
import fcntl
import math
import os
import select
import termios
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from flockd.onboard.autopilot.autopilot_status import AutopilotError

READ_BYTES = 4096
"""The most that a Linux terminal buffers."""
REOPEN_S = 0.2
"""Time between two attempts to open a missing device."""


class SerialPort:
    """Everything but `close` may be called from any thread and returns at once."""

    def __init__(self, device: str, baud: int, report: Callable[[str], None]) -> None:
        """Opens the port, and discards data until `hand_to`.

        Args:
            device: its path.
            baud: bits per second, one of termios; 8 data bits, no parity, one stop bit, no flow control.
            report: called on the port's thread, with a sentence, when the device disappears and when it is back.

        Raises AutopilotError if it cannot be opened or another program has it.
        """
        self._device, self._speed, self._report = device, getattr(termios, f"B{baud}"), report
        self._receive: Callable[[bytes], object] = discard
        self._receiving = threading.Lock()
        self._lock = threading.Lock()
        """Held while the descriptor is written to or changed."""
        try:
            self._descriptor = _open(device, self._speed)
        except OSError as error:
            raise AutopilotError(_why_not(f"serial://{device}:{baud}", error)) from error
        self._unsent = b""
        """The rest of a partly sent message."""
        self._gone_s = math.inf
        """When the device disappeared, on the monotonic clock; infinite while it is present."""
        self.reopened = 0
        """How often the device has come back."""
        self._closing = os.eventfd(0)
        self._thread = threading.Thread(target=self._run, name="serial port", daemon=True)
        self._thread.start()

    def hand_to(self, receive: Callable[[bytes], object]) -> None:
        """Calls ``receive`` with all data from now on, on the port's thread, instead of the receiver before."""
        with self._receiving:
            self._receive = receive

    def close(self) -> None:
        """Closes the port; no receiver is called once this returns. Call it once."""
        os.eventfd_write(self._closing, 1)
        self._thread.join()
        os.close(self._closing)
        with self._lock:
            self._drop()

    def gone_for_s(self) -> float:
        """Seconds since the device disappeared; 0 while it is present."""
        return max(time.monotonic() - self._gone_s, 0.0)

    def send(self, message: bytes) -> None:
        """Sends a message completely, or not at all if the device is missing or the line is too slow for it."""
        with self._lock, suppress(OSError):  # the reading thread notices a missing device
            self._unsent = self._write(self._unsent)
            if not self._unsent:
                rest = self._write(message)
                self._unsent = rest if len(rest) < len(message) else b""

    def _write(self, data: bytes) -> bytes:
        """Returns what did not fit."""
        if self._descriptor < 0 or not data:
            return data
        try:
            return data[os.write(self._descriptor, data) :]
        except BlockingIOError:
            return data

    def _run(self) -> None:
        while True:
            poll, there = select.poll(), self._descriptor >= 0
            poll.register(self._closing, select.POLLIN)
            if there:
                poll.register(self._descriptor, select.POLLIN)
            while there == (self._descriptor >= 0):
                ready = poll.poll(None if there else 1e3 * REOPEN_S)
                if any(descriptor == self._closing for descriptor, _ in ready):
                    return
                if there:
                    self._read()
                else:
                    self._reopen()

    def _read(self) -> None:
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(error.strerror or str(error))
            return
        if data:
            with self._receiving:
                self._receive(data)
        else:
            self._lose("it hung up")

    def _lose(self, why: str) -> None:
        """Closes the device; otherwise the system would give it another name when it is back."""
        with self._lock:
            self._drop()
            self._gone_s = time.monotonic()
        self._report(f"the autopilot's serial port {self._device} is gone ({why}); it is opened again when it is back")

    def _reopen(self) -> None:
        try:
            descriptor = _open(self._device, self._speed)
        except OSError:
            return
        gone_s = self.gone_for_s()
        with self._lock:
            self._descriptor, self._unsent, self._gone_s = descriptor, b"", math.inf
        self.reopened += 1
        self._report(f"the autopilot's serial port {self._device} is back after {gone_s:.1f} s")

    def _drop(self) -> None:
        if self._descriptor >= 0:
            with suppress(OSError):  # a pseudo-terminal would stay exclusive
                fcntl.ioctl(self._descriptor, termios.TIOCNXCL)
            os.close(self._descriptor)
        self._descriptor = -1


def discard(_data: bytes) -> None:
    """Discards data."""


def _open(device: str, speed: int) -> int:
    """The descriptor of the device, a raw terminal that no other program can open. Raises OSError."""
    descriptor = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # TIOCEXCL does not stop programs of root
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
        control: list[bytes | int] = [0] * len(termios.tcgetattr(descriptor)[6])
        control[termios.VMIN] = 1
        flags = termios.CS8 | termios.CREAD | termios.CLOCAL
        attributes: list[int | list[bytes | int]] = [0, 0, flags, 0, speed, speed, control]
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
        termios.tcflush(descriptor, termios.TCIOFLUSH)
    except termios.error as error:
        os.close(descriptor)
        raise OSError(*error.args) from error
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _why_not(address: str, error: OSError) -> str:
    if error.errno in {errno.EBUSY, errno.EAGAIN}:
        return f"autopilot.address: {address} is in use by another program; stop that one first"
    return f"autopilot.address: {address} cannot be opened ({error.strerror}); check the address and the cable"
