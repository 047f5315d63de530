"""Cameras that a separate process reads, so that a driver that crashes ends this process alone.

The process writes messages to its standard output, each a header and its data, and ends when its standard input is
closed.
"""

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
"""rclpy may be on the environment's path; the folder of the file is not, whose names would hide other packages."""
_PIPE_BYTES = 1 << 20
"""The largest pipe of an ordinary user; fewer system calls an image than with the usual 64 kB."""
_MOST_BYTES = 1 << 28
"""The most bytes of one image: the largest that a rig may have is less."""
_END_S = 1.5


@dataclass(frozen=True)
class ChildMessage:
    """One message of the process."""

    kind: bytes
    flags: int
    time_ns: int
    data: bytes


class ChildDevice(CameraDevice):
    """A ``CameraDevice`` of a process. Images are numbered by their times, in periods of the rate.

    So a number that is missing is a frame that is.
    """

    start_s = 10.0
    _what: str
    """What the process runs, for messages."""
    _kinds: Collection[bytes]
    """Messages beside errors and the end."""

    def __init__(
        self,
        camera: CameraDeviceParameters,
        size: tuple[int, int],
        command: Sequence[str],
        told: bytes = b"",
    ) -> None:
        """Starts the process, and writes ``told`` to its standard input. Raises CameraError.

        Every user of the computer can read arguments, and what is told may hold a password.
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
                start_new_session=True,  # Ctrl-C is not for it
            )
        except OSError as error:
            raise CameraError(
                f"{self._name}: the process of {self._what} cannot be started ({error.strerror})"
            ) from error
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended, which `read` says
            self._process.stdin.write(told)
        self._stream = _Stream(self._process.stdout.fileno(), {*self._kinds, ERROR, END})

    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """See ``CameraDevice``."""
        until_s = time.monotonic() + timeout_s
        while (message := self._next(max(until_s - time.monotonic(), 0.0))) is not None:
            if message.kind == ERROR:
                raise self._failed(message.data.decode("utf-8", "replace"))
            if message.kind == END:
                raise CameraError(f"{self._name}: {self._what} has ended; a camera's goes on for ever")
            captured = self._taken(message)
            if captured is not None:
                return captured
        return None

    def close(self) -> None:
        """Lets the process close its camera, and ends it, if need be by force."""
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
        """The image of a message; None for one that says something else. Raises CameraError."""

    @abstractmethod
    def _failed(self, reason: str) -> CameraError:
        """The sentence for an error that the process reports."""

    def image_format(self) -> ImageFormat:
        """See ``CameraDevice``."""
        assert self._format is not None
        return self._format

    def _check_size(self, size: tuple[int, int], who: str, remedy: str) -> None:
        """Raises CameraError for another width and height than the rig's."""
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
        return CameraError(f"{self._name}: the process of {self._what} sent what is no image; something in it prints")

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
    """Messages from a pipe, whole ones only."""

    def __init__(self, descriptor: int, kinds: Collection[bytes]) -> None:
        self._descriptor, self._kinds = descriptor, kinds
        with contextlib.suppress(OSError):  # more is quicker, not needed
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        self._header: tuple[bytes, int, int] | None = None
        self._expect(HEADER.size)

    def read(self, timeout_s: float) -> ChildMessage | None:
        """The next one; None if it is not complete within the time.

        Raises EOFError at the end, and ValueError for what is no message.
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
