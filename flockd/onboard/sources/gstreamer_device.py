"""One camera behind a GStreamer pipeline that runs in a process of its own: what crashes there, crashes there.

Such are those on the CSI ports of a Jetson or a Raspberry Pi, network cameras, and files.
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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flockd.core.config.source import CameraDeviceParameters
from flockd.core.secrets import masked
from flockd.onboard.sources import gstreamer_child
from flockd.onboard.sources.devices import CameraDevice, CameraError, CapturedBuffer
from flockd.onboard.sources.gstreamer_child import CAPS, DAMAGED, END, ERROR, HEADER, IMAGE, packed_text
from flockd.onboard.sources.gstreamer_formats import caps, format_of
from flockd.onboard.sources.image_formats import ImageFormat

CHILD = (sys.executable, "-I", str(Path(gstreamer_child.__file__)))
PACKAGES = "libgstreamer1.0-0, gstreamer1.0-plugins-base and the plugins that its pipeline needs"
_PIPE_BYTES = 1 << 20
"""What an ordinary user may have; fewer system calls an image than with the usual 64 kB."""
_MOST_BYTES = 1 << 28
"""The most bytes of one image: the largest that a rig may have is less."""
_END_S = 1.5


@dataclass(frozen=True)
class _Message:
    kind: bytes
    flags: int
    time_ns: int
    data: bytes


class GstreamerDevice(CameraDevice):
    """A ``CameraDevice`` of a pipeline. Its time stamps are those of GStreamer's buffers, on CLOCK_MONOTONIC.

    Images are numbered by their times, in periods of the rate: a number that is missing is a frame that is.
    """

    start_s = 10.0

    def __init__(self, camera: CameraDeviceParameters, size: tuple[int, int], command: Sequence[str] = CHILD) -> None:
        """Starts the process: ``command``, with what is asked of the pipeline. Raises CameraError."""
        self._name, self._size, self._rate_hz = camera.name, size, camera.rate_hz
        self._format: ImageFormat | None = None
        self._last_s: float | None = None
        self._sequence = 0
        try:
            self._process = subprocess.Popen(
                [*command, caps(size, camera.rate_hz)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,  # Ctrl-C is not for it
            )
        except OSError as error:
            raise CameraError(
                f"{camera.name}: the process of its pipeline cannot be started ({error.strerror})"
            ) from error
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended, which `read` says
            # Not as an argument: every user of the computer may read those, and a pipeline may hold a password.
            self._process.stdin.write(packed_text(camera.pipeline))
        self._stream = _Stream(self._process.stdout.fileno())

    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """See ``CameraDevice``."""
        until_s = time.monotonic() + timeout_s
        while (message := self._next(max(until_s - time.monotonic(), 0.0))) is not None:
            match message.kind:
                case _ if message.kind == CAPS:
                    self._set_format(message.data.decode("utf-8", "replace"))
                case _ if message.kind == IMAGE and self._format is not None:
                    return self._captured(message)
                case _ if message.kind == ERROR:
                    raise self._failed(message.data.decode("utf-8", "replace"))
                case _ if message.kind == END:
                    raise CameraError(f"{self._name}: its pipeline has ended; a camera's goes on for ever")
                case _:
                    raise self._nonsense()
        return None

    def image_format(self) -> ImageFormat:
        """See ``CameraDevice``."""
        assert self._format is not None
        return self._format

    def close(self) -> None:
        """Lets the pipeline close its camera, and ends the process, if need be by force."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _next(self, timeout_s: float) -> _Message | None:
        try:
            return self._stream.read(timeout_s)
        except EOFError:
            raise self._ended() from None
        except ValueError:
            raise self._nonsense() from None

    def _captured(self, message: _Message) -> CapturedBuffer:
        time_s = message.time_ns * 1e-9
        if self._last_s is not None:
            self._sequence += max(round((time_s - self._last_s) * self._rate_hz), 1)
        self._last_s = time_s
        return CapturedBuffer(message.data, time_s, self._sequence, bool(message.flags & DAMAGED))

    def _set_format(self, text: str) -> None:
        found = format_of(text)
        if found is None:
            raise CameraError(f"{self._name}: its pipeline gives {masked(text)[:80]}; end it with `videoconvert`")
        self._format, size = found
        if size != self._size:
            gives, asked = (f"{width}x{height}" for width, height in (size, self._size))
            raise CameraError(
                f"{self._name}: its pipeline gives {gives}, but the rig has {asked}; end it with "
                f"`videoscale ! video/x-raw,width={self._size[0]},height={self._size[1]}`, or correct size_px"
            )

    def _failed(self, reason: str) -> CameraError:
        if reason == gstreamer_child.NOT_INSTALLED:
            return CameraError(f"{self._name}: {reason}; install {PACKAGES}")
        return CameraError(
            f"{self._name}: its pipeline {masked(reason)}; try it with `gst-launch-1.0 PIPELINE ! fakesink`"
        )

    def _ended(self) -> CameraError:
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return self._nonsense()
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return CameraError(f"{self._name}: the process of its pipeline {how}; a driver may have crashed")

    def _nonsense(self) -> CameraError:
        return CameraError(f"{self._name}: the process of its pipeline sent what is no image; something in it prints")


class _Stream:
    """Messages from a pipe, whole ones only."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        with contextlib.suppress(OSError):  # more is quicker, not needed
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        self._header: tuple[bytes, int, int] | None = None
        self._expect(HEADER.size)

    def read(self, timeout_s: float) -> _Message | None:
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

    def _complete(self) -> _Message | None:
        if self._header is None:
            kind, flags, time_ns, length = HEADER.unpack(self._data)
            if kind not in (CAPS, IMAGE, ERROR, END) or length > _MOST_BYTES:
                raise ValueError(kind)
            self._header = (kind, flags, time_ns)
            self._expect(length)
            if length:
                return None
        message = _Message(*self._header, bytes(self._data))
        self._header = None
        self._expect(HEADER.size)
        return message

    def _expect(self, length: int) -> None:
        self._data, self._filled = bytearray(length), 0
