"""Cameras that are read in a separate process: if a driver crashes, flockd goes on. See `camera_child`."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import sys
import time
from abc import abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from flockd.core.config.source import CameraDeviceParameters
from flockd.onboard.sources import camera_child
from flockd.onboard.sources.camera_child import DAMAGED, END, ERROR, HEADER
from flockd.onboard.sources.frames import CameraDevice, CameraError, CapturedBuffer
from flockd.onboard.sources.image_formats import ImageFormat

CHILD = (sys.executable, "-I", str(Path(camera_child.__file__)))
ROS_CHILD = (sys.executable, "-P", CHILD[-1])
"""Keeps PYTHONPATH for rclpy, but not this folder, whose names would hide other packages."""
_PIPE_BYTES = 1 << 20
"""The largest pipe that Linux allows a user: an image takes fewer system calls than with the default 64 kB."""
_MOST_BYTES = 1 << 28
"""Largest size of one image; the largest permitted in a rig is smaller."""
_END_S = 1.5


@dataclass(frozen=True)
class ChildMessage:
    """One message of the process."""

    kind: bytes
    flags: int
    time_ns: int
    data: bytes


class ChildDevice(CameraDevice):
    """A ``CameraDevice`` in a separate process. Images are numbered by their times, in periods of the configured rate,
    so that a lost frame leaves a gap in the numbers."""

    start_s = 10.0
    _what: str
    """What the process runs, for errors."""
    _kinds: Collection[bytes]
    """Kinds of messages besides `fail` and `end`."""

    def __init__(
        self,
        camera: CameraDeviceParameters,
        size: tuple[int, int],
        command: Sequence[str],
        told: bytes = b"",
    ) -> None:
        """Starts the process, and writes ``told`` to its standard input. Raises CameraError.

        ``told`` may contain a password, and every user of the computer can read a process's arguments.
        """
        self._name, self._rate_hz, self._size = camera.name, camera.rate_hz, size
        self._size_words = camera.size_words
        self._format: ImageFormat | None = None
        self._last_s: float | None = None
        self._sequence = 0
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,  # Ctrl-C must not reach it
            )
        except OSError as error:
            raise CameraError(
                f"{self._name}: the process of {self._what} cannot be started ({error.strerror})"
            ) from error
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended; `read` reports that
            self._process.stdin.write(told)
        self._stream = _Stream(self._process.stdout.fileno(), {*self._kinds, ERROR, END})

    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """See ``CameraDevice``."""
        until_s = time.monotonic() + timeout_s
        while (message := self._next(max(until_s - time.monotonic(), 0.0))) is not None:
            if message.kind == ERROR:
                raise self._failed(message.data.decode("utf-8", "replace"))
            if message.kind == END:
                raise CameraError(f"{self._name}: {self._what} has ended; use one that does not end")
            captured = self._taken(message)
            if captured is not None:
                return captured
        return None

    def close(self) -> None:
        """Lets the process close its camera and end; kills it if it does not end in time."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    @abstractmethod
    def _taken(self, message: ChildMessage) -> CapturedBuffer | None:
        """The image of a message; None: the message has no image. Raises CameraError."""

    @abstractmethod
    def _failed(self, reason: str) -> CameraError:
        """The error for a reason that the process reports."""

    def image_format(self) -> ImageFormat:
        """See ``CameraDevice``."""
        assert self._format is not None
        return self._format

    def _check_size(self, size: tuple[int, int], who: str, remedy: str) -> None:
        """Raises CameraError if width and height differ from the rig's."""
        if size != self._size:
            gives, asked = (f"{width}x{height}" for width, height in (size, self._size))
            whose, key = self._size_words
            raise CameraError(f"{self._name}: {who} {gives}, but {whose} {asked}; {remedy} {key}")

    def _captured(self, data: bytes, message: ChildMessage) -> CapturedBuffer:
        """An image with its number."""
        time_s = message.time_ns * 1e-9
        if self._last_s is not None:
            self._sequence += max(round((time_s - self._last_s) * self._rate_hz), 1)
        self._last_s = time_s
        return CapturedBuffer(data, time_s, self._sequence, bool(message.flags & DAMAGED))

    def _nonsense(self) -> CameraError:
        return CameraError(
            f"{self._name}: the process of {self._what} sent no image but other data; "
            "stop the element or driver that prints to standard output"
        )

    def _next(self, timeout_s: float) -> ChildMessage | None:
        try:
            return self._stream.read(timeout_s)
        except EOFError:
            raise self._ended() from None
        except ValueError:
            raise self._nonsense() from None

    def _ended(self) -> CameraError:
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return self._nonsense()
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return CameraError(f"{self._name}: the process of {self._what} {how}; a driver may have crashed")


class _Stream:
    """Reads complete messages from a pipe."""

    def __init__(self, descriptor: int, kinds: Collection[bytes]) -> None:
        self._descriptor, self._kinds = descriptor, kinds
        with contextlib.suppress(OSError):  # a larger pipe is faster, but not required
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        self._header: tuple[bytes, int, int] | None = None
        self._expect(HEADER.size)

    def read(self, timeout_s: float) -> ChildMessage | None:
        """The next message; None if it is not complete within ``timeout_s``.

        Raises EOFError at the end, and ValueError if the data are not a message.
        """
        until_s = time.monotonic() + timeout_s
        while self._poll.poll(max(until_s - time.monotonic(), 0.0) * 1000.0):
            came = os.readv(self._descriptor, [memoryview(self._data)[self._filled :]])
            if not came:
                raise EOFError
            self._filled += came
            if self._filled == len(self._data) and (message := self._complete()) is not None:
                return message
        return None

    def _complete(self) -> ChildMessage | None:
        if self._header is None:
            kind, flags, time_ns, length = HEADER.unpack(self._data)
            if kind not in self._kinds or length > _MOST_BYTES:
                raise ValueError(kind)
            self._header = (kind, flags, time_ns)
            self._expect(length)
            if length:
                return None
        message = ChildMessage(*self._header, bytes(self._data))
        self._header = None
        self._expect(HEADER.size)
        return message

    def _expect(self, length: int) -> None:
        self._data, self._filled = bytearray(length), 0
