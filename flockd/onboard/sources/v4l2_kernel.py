"""The V4L2 interface of the Linux kernel: structures, ioctl requests and system calls, as videodev2.h defines them."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
import select
from typing import Any, ClassVar


def _words(names: str, kind: type[Any] = ctypes.c_uint32) -> list[tuple[str, type[Any]]]:
    return [(name, kind) for name in names.split()]


class Capability(ctypes.Structure):
    """struct v4l2_capability"""

    _fields_: ClassVar = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        *_words("version capabilities device_caps"),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class Format(ctypes.Structure):
    """struct v4l2_format with its v4l2_pix_format, in a union of 200 bytes that is aligned to 8."""

    _fields_: ClassVar = [
        *_words("type padding width height pixelformat field bytesperline sizeimage"),
        ("rest", ctypes.c_uint8 * 176),
    ]


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with its v4l2_captureparm; the union is 200 bytes long."""

    _fields_: ClassVar = [
        *_words("type capability capturemode numerator denominator"),
        ("rest", ctypes.c_uint8 * 184),
    ]


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers; the last word holds flags and reserved bytes."""

    _fields_: ClassVar = _words("count type memory capabilities flags")


class Buffer(ctypes.Structure):
    """struct v4l2_buffer as 64-bit kernels lay it out"""

    _fields_: ClassVar = [
        *_words("index type bytesused flags field"),
        *_words("seconds microseconds", ctypes.c_int64),
        ("timecode", ctypes.c_uint8 * 16),
        *_words("sequence memory"),
        ("offset", ctypes.c_uint64),
        *_words("length reserved2 request_fd"),
    ]


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl"""

    _fields_: ClassVar = [
        *_words("id type"),
        ("name", ctypes.c_char * 32),
        *_words("minimum maximum step default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class Control(ctypes.Structure):
    """struct v4l2_control"""

    _fields_: ClassVar = [("id", ctypes.c_uint32), ("value", ctypes.c_int32)]


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc"""

    _fields_: ClassVar = [
        *_words("index type flags"),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 4),
    ]


class FrameSize(ctypes.Structure):
    """struct v4l2_frmsizeenum; for a range of sizes the first two numbers are the smallest and the largest width."""

    _fields_: ClassVar = [*_words("index pixel_format type width height"), ("rest", ctypes.c_uint32 * 6)]


class FrameInterval(ctypes.Structure):
    """struct v4l2_frmivalenum; for a range the shortest interval."""

    _fields_: ClassVar = [
        *_words("index pixel_format width height type numerator denominator"),
        ("rest", ctypes.c_uint32 * 6),
    ]


_READ, _WRITE = 2, 1


def _request(number: int, argument: type[ctypes.Structure] | type[ctypes.c_int], direction: int) -> int:
    """The _IOC macro of most architectures, x86_64 and aarch64 among them."""
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


VIDIOC_QUERYCAP = _request(0, Capability, _READ)
VIDIOC_ENUM_FMT = _request(2, FormatDescription, _READ | _WRITE)
VIDIOC_S_FMT = _request(5, Format, _READ | _WRITE)
VIDIOC_REQBUFS = _request(8, RequestBuffers, _READ | _WRITE)
VIDIOC_QUERYBUF = _request(9, Buffer, _READ | _WRITE)
VIDIOC_QBUF = _request(15, Buffer, _READ | _WRITE)
VIDIOC_DQBUF = _request(17, Buffer, _READ | _WRITE)
VIDIOC_STREAMON = _request(18, ctypes.c_int, _WRITE)
VIDIOC_STREAMOFF = _request(19, ctypes.c_int, _WRITE)
VIDIOC_S_PARM = _request(22, StreamParameters, _READ | _WRITE)
VIDIOC_G_CTRL = _request(27, Control, _READ | _WRITE)
VIDIOC_S_CTRL = _request(28, Control, _READ | _WRITE)
VIDIOC_QUERYCTRL = _request(36, QueryControl, _READ | _WRITE)
VIDIOC_ENUM_FRAMESIZES = _request(74, FrameSize, _READ | _WRITE)
VIDIOC_ENUM_FRAMEINTERVALS = _request(75, FrameInterval, _READ | _WRITE)


class Kernel:
    """The system calls that drive a camera. Each may raise OSError."""

    def open(self, path: str) -> int:
        """A file descriptor for reading and writing that never blocks."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, descriptor: int) -> None:
        """Closes the descriptor."""
        os.close(descriptor)

    def ioctl(self, descriptor: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Runs the request; the kernel writes its result into ``argument``."""
        while True:
            with contextlib.suppress(InterruptedError):
                fcntl.ioctl(descriptor, request, argument)
                return

    def map(self, descriptor: int, length: int, offset: int) -> mmap.mmap:
        """Maps a buffer of the driver; the device stays open until the map is closed."""
        return mmap.mmap(descriptor, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        """Whether a frame or an error can be read within the time."""
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000.0))
