"""A fake of the kernel's side of V4L2: plays cameras to the capture code by the bytes of linux/videodev2.h.

The request numbers and offsets are those that a C compiler gives for the header on 64-bit machines, written down here
independently of the code under test.
"""

from __future__ import annotations

import ctypes
import errno
import math
import mmap
import os
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum

from flockd.onboard.sources.v4l2_kernel import Kernel


class Request(IntEnum):
    """The numbers of the ioctl requests."""

    QUERYCAP = 0x80685600
    S_FMT = 0xC0D05605
    REQBUFS = 0xC0145608
    QUERYBUF = 0xC0585609
    QBUF = 0xC058560F
    DQBUF = 0xC0585611
    STREAMON = 0x40045612
    STREAMOFF = 0x40045613
    S_PARM = 0xC0CC5616
    G_CTRL = 0xC008561B
    S_CTRL = 0xC008561C
    QUERYCTRL = 0xC0445624
    ENUM_FMT = 0xC0405602
    ENUM_FRAMESIZES = 0xC02C564A
    ENUM_FRAMEINTERVALS = 0xC034564B


FLAG_ERROR, FLAG_MONOTONIC, FLAG_CLOCK_UNKNOWN = 0x40, 0x2000, 0x0000
VIDEO_CAPTURE, STREAMING, METADATA_CAPTURE = 0x1, 0x04000000, 0x00800000
BUFFER_LENGTH = 1 << 20
EXPOSURE_AUTO, EXPOSURE, GAIN = 0x009A0901, 0x009A0902, 0x00980913


@dataclass
class FakeControl:
    """A control as QUERYCTRL tells of it."""

    name: bytes
    low: int
    high: int
    value: int
    step: int = 1


@dataclass
class FakeCamera:
    """One camera and its driver; the test says what it sends."""

    formats: tuple[tuple[int, int, bytes], ...] = ((640, 480, b"MJPG"), (640, 480, b"YUYV"))
    rates: tuple[int, ...] = (30, 15)
    card: bytes = b"Fake camera"
    padding: int = 0
    """Bytes at the end of each row of an image that is not compressed."""
    capabilities: int = VIDEO_CAPTURE | STREAMING
    controls: dict[int, FakeControl] = field(
        default_factory=lambda: {
            GAIN: FakeControl(b"Gain", 0, 255, 64),
            EXPOSURE_AUTO: FakeControl(b"Auto Exposure", 0, 3, 3),
            EXPOSURE: FakeControl(b"Exposure Time, Absolute", 1, 5000, 157),
        }
    )
    plugged: bool = True
    owner: int | None = None
    """The descriptor that streams."""
    streaming: bool = False
    settings: list[tuple[str, object]] = field(default_factory=list)
    """What was asked of the driver, in order."""
    memory: list[mmap.mmap] = field(default_factory=list)
    empty: deque[int] = field(default_factory=deque)
    full: deque[tuple[int, int, float, int, int]] = field(default_factory=deque)
    sequence: int = 0
    failing: int = 0
    """The error number of every DQBUF; 0: none."""

    # Its driver, a method for each request.

    def querycap(self, memory: memoryview) -> None:
        of_all_devices = 0x80000000 | VIDEO_CAPTURE | METADATA_CAPTURE | STREAMING
        struct.pack_into("<32s", memory, 16, self.card)
        struct.pack_into("<III", memory, 80, 6 << 16, of_all_devices, self.capabilities)

    def s_fmt(self, memory: memoryview) -> None:
        width, height, code = struct.unpack_from("<II4s", memory, 8)
        self.settings.append(("format", (width, height, code)))
        if (width, height, code) not in self.formats:
            width, height, code = self.formats[0]
        row = 0 if code == b"MJPG" else 2 * width + self.padding
        struct.pack_into("<II4sIII", memory, 8, width, height, code, 1, row, BUFFER_LENGTH)

    def s_parm(self, memory: memoryview) -> None:
        numerator, denominator = struct.unpack_from("<II", memory, 12)
        self.settings.append(("rate", denominator / numerator))
        rate = min(self.rates, key=lambda rate: abs(rate - denominator / numerator))
        struct.pack_into("<II", memory, 12, 1, rate)

    def queryctrl(self, memory: memoryview) -> None:
        asked = struct.unpack_from("<I", memory)[0]
        later = sorted(number for number in self.controls if number > (asked & 0x7FFFFFFF))
        if not later:
            raise _error(errno.EINVAL)
        control = self.controls[later[0]]
        struct.pack_into("<II32s", memory, 0, later[0], 1, control.name)
        struct.pack_into("<iii", memory, 40, control.low, control.high, control.step)

    def enum_fmt(self, memory: memoryview) -> None:
        index, kind = struct.unpack_from("<II", memory)
        codes = list(dict.fromkeys(code for _, _, code in self.formats))
        assert kind == 1, "of capture"
        if index >= len(codes):
            raise _error(errno.EINVAL)
        struct.pack_into("<4s", memory, 44, codes[index])

    def enum_framesizes(self, memory: memoryview) -> None:
        index, asked = struct.unpack_from("<I4s", memory)
        sizes = [(width, height) for width, height, code in self.formats if code == asked]
        if index >= len(sizes):
            raise _error(errno.EINVAL)
        struct.pack_into("<III", memory, 8, 1, *sizes[index])

    def enum_frameintervals(self, memory: memoryview) -> None:
        index, code, width, height = struct.unpack_from("<I4sII", memory)
        if (width, height, code) not in self.formats or index >= len(self.rates):
            raise _error(errno.EINVAL)
        struct.pack_into("<III", memory, 16, 1, 1, self.rates[index])

    def s_ctrl(self, memory: memoryview) -> None:
        number, value = struct.unpack_from("<Ii", memory)
        if number == EXPOSURE and self.controls[EXPOSURE_AUTO].value == 3:
            raise _error(errno.EACCES)  # as long as the automatic has it
        control = self.controls[number]
        control.value = value // control.step * control.step
        self.settings.append((control.name.decode(), value))

    def g_ctrl(self, memory: memoryview) -> None:
        struct.pack_into("<i", memory, 4, self.controls[struct.unpack_from("<I", memory)[0]].value)

    def reqbufs(self, memory: memoryview) -> None:
        count, kind, how = struct.unpack_from("<III", memory)
        assert (count, kind, how) == (4, 1, 1), "buffers for capture that are mapped"

    def querybuf(self, memory: memoryview) -> None:
        struct.pack_into("<I", memory, 64, struct.unpack_from("<I", memory)[0] * BUFFER_LENGTH)
        struct.pack_into("<I", memory, 72, BUFFER_LENGTH)

    def qbuf(self, memory: memoryview) -> None:
        self.empty.append(struct.unpack_from("<I", memory)[0])

    def dqbuf(self, memory: memoryview) -> None:
        if self.failing:
            raise _error(self.failing)
        if not self.full:
            raise _error(errno.EAGAIN)
        index, length, stamp, sequence, flags = self.full.popleft()
        struct.pack_into("<IIII", memory, 0, index, 1, length, flags)
        seconds = math.floor(stamp)
        struct.pack_into("<qq", memory, 24, seconds, min(round((stamp - seconds) * 1e6), 999_999))
        struct.pack_into("<II", memory, 56, sequence, 1)

    def streamon(self, memory: memoryview) -> None:
        self.streaming = True

    def streamoff(self, memory: memoryview) -> None:
        self.streaming = False


class FakeKernel(Kernel):
    """Cameras by the path of their device."""

    def __init__(self, **cameras: FakeCamera) -> None:
        self.cameras = {f"/dev/{name}": camera for name, camera in cameras.items()}
        self.open_files: dict[int, FakeCamera] = {}
        self._changed = threading.Condition()
        self._next = 100

    # What the test does

    def send(
        self,
        name: str,
        data: bytes,
        *,
        time_s: float | None = None,
        flags: int = FLAG_MONOTONIC,
        lost_before: int = 0,
        wait_s: float = 5.0,
    ) -> float:
        """The camera takes a picture as soon as it streams; gives its time stamp."""
        camera = self.cameras[f"/dev/{name}"]
        until_s = time.monotonic() + wait_s
        with self._changed:
            while not (camera.streaming and camera.empty):
                assert self._changed.wait(max(until_s - time.monotonic(), 0.0)), f"{name} is not streaming"
            stamp = time.monotonic() if time_s is None else time_s
            index = camera.empty.popleft()
            camera.memory[index][: len(data)] = data
            camera.sequence += lost_before
            camera.full.append((index, len(data), stamp, camera.sequence, flags))
            camera.sequence += 1
            self._changed.notify_all()
        return stamp

    def unplug(self, name: str) -> None:
        with self._changed:
            self.cameras[f"/dev/{name}"].plugged = False
            self._changed.notify_all()

    def plug(self, name: str) -> None:
        with self._changed:
            self.cameras[f"/dev/{name}"].plugged = True

    def fail(self, name: str, number: int) -> None:
        with self._changed:
            self.cameras[f"/dev/{name}"].failing = number
            self._changed.notify_all()

    # What the capture code calls

    def open(self, path: str) -> int:
        with self._changed:
            camera = self.cameras.get(path)
            if camera is None or not camera.plugged:
                raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
            self._next += 1
            self.open_files[self._next] = camera
            return self._next

    def close(self, descriptor: int) -> None:
        with self._changed:
            camera = self.open_files.pop(descriptor)
            if camera.owner == descriptor:
                assert all(memory.closed for memory in camera.memory), "a mapping keeps the device open"
                _release(camera)

    def map(self, descriptor: int, length: int, offset: int) -> mmap.mmap:
        assert length == BUFFER_LENGTH
        memory = mmap.mmap(-1, length)
        assert offset == len(self.open_files[descriptor].memory) * BUFFER_LENGTH
        self.open_files[descriptor].memory.append(memory)
        return memory

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        camera = self.open_files[descriptor]
        with self._changed:
            return self._changed.wait_for(
                lambda: bool(camera.full) or not camera.plugged or bool(camera.failing), timeout_s
            )

    def ioctl(self, descriptor: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        asked = Request(request)
        with self._changed:
            camera = self.open_files[descriptor]
            if not camera.plugged:
                raise _error(errno.ENODEV)
            if asked in {Request.S_FMT, Request.REQBUFS} and camera.owner not in {None, descriptor}:
                raise _error(errno.EBUSY)
            if asked is Request.REQBUFS:
                camera.owner = descriptor
            getattr(camera, asked.name.lower())(memoryview(argument).cast("B"))
            self._changed.notify_all()


def _release(camera: FakeCamera) -> None:
    """Its last user has gone."""
    camera.owner = None
    camera.streaming = False
    camera.sequence = 0
    camera.memory.clear()
    camera.empty.clear()
    camera.full.clear()


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
