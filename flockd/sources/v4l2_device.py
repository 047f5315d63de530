"""One V4L2 camera through the kernel's own interface (linux/videodev2.h): ioctl, mmap and poll, on 64-bit Linux."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import re
import select
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from types import TracebackType
from typing import ClassVar, Literal, Protocol, Self

from flockd.config.source import ControlParameters
from flockd.errors import UnavailableError

PixelFormat = Literal["mjpeg", "yuyv"]
Clock = Literal["monotonic", "copied", "unknown"]

_CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_MAPPED = 1  # V4L2_MEMORY_MMAP
_PROGRESSIVE = 1  # V4L2_FIELD_NONE
_CAN_CAPTURE = 0x00000001
_CAN_STREAM = 0x04000000
_HAS_DEVICE_CAPABILITIES = 0x80000000
_FLAG_ERROR = 0x0040
_CLOCK_MASK = 0xE000
_CLOCKS: dict[int, Clock] = {0x2000: "monotonic", 0x4000: "copied"}
_NEXT_CONTROL = 0x80000000
_CONTROL_DISABLED = 0x0001
_FOURCC = {name: int.from_bytes(code, "little") for name, code in (("mjpeg", b"MJPG"), ("yuyv", b"YUYV"))}
_BUFFERS = 4
_RATE_TOLERANCE = 0.1
_NAME_LENGTH = 32


class CameraError(UnavailableError):
    """Why a camera gives no frames, in one sentence."""


class Capability(ctypes.Structure):
    """struct v4l2_capability"""

    _fields_: ClassVar = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("device_caps", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class Format(ctypes.Structure):
    """struct v4l2_format with its v4l2_pix_format; the union it sits in is 200 bytes long and aligned to 8."""

    _fields_: ClassVar = [
        ("type", ctypes.c_uint32),
        ("padding", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("pixelformat", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("bytesperline", ctypes.c_uint32),
        ("sizeimage", ctypes.c_uint32),
        ("rest", ctypes.c_uint8 * 176),
    ]


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with its v4l2_captureparm; the union is 200 bytes long."""

    _fields_: ClassVar = [
        ("type", ctypes.c_uint32),
        ("capability", ctypes.c_uint32),
        ("capturemode", ctypes.c_uint32),
        ("numerator", ctypes.c_uint32),
        ("denominator", ctypes.c_uint32),
        ("rest", ctypes.c_uint8 * 184),
    ]


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers"""

    _fields_: ClassVar = [
        ("count", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 3),
    ]


class Buffer(ctypes.Structure):
    """struct v4l2_buffer as 64-bit kernels lay it out"""

    _fields_: ClassVar = [
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("bytesused", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("seconds", ctypes.c_int64),
        ("microseconds", ctypes.c_int64),
        ("timecode", ctypes.c_uint8 * 16),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("offset", ctypes.c_uint64),
        ("length", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
    ]


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl"""

    _fields_: ClassVar = [
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * _NAME_LENGTH),
        ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32),
        ("step", ctypes.c_int32),
        ("default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class Control(ctypes.Structure):
    """struct v4l2_control"""

    _fields_: ClassVar = [("id", ctypes.c_uint32), ("value", ctypes.c_int32)]


_READ, _WRITE = 2, 1


def _request(number: int, argument: type[ctypes.Structure] | type[ctypes.c_int], direction: int) -> int:
    """The _IOC macro of most architectures, x86_64 and aarch64 among them."""
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


VIDIOC_QUERYCAP = _request(0, Capability, _READ)
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


class Mapping(Protocol):
    """Memory of a driver, as `mmap.mmap` gives it."""

    def __getitem__(self, part: slice) -> bytes:
        """A copy of some of it."""

    def close(self) -> None:
        """Gives it back; the driver holds the device open until then."""


class Kernel(Protocol):
    """The system calls a camera is driven by; each raises OSError as the kernel does."""

    def open(self, path: str) -> int:
        """A file descriptor for reading and writing that never blocks."""

    def close(self, descriptor: int) -> None:
        """Ends the descriptor."""

    def ioctl(self, descriptor: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Runs the request; the kernel writes its answer into ``argument``."""

    def map(self, descriptor: int, length: int, offset: int) -> Mapping:
        """Maps a buffer of the driver."""

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        """Whether there is something to fetch, a frame or an error, within the time."""


class LinuxKernel:
    """The real one."""

    def open(self, path: str) -> int:
        """See ``Kernel``."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, descriptor: int) -> None:
        """See ``Kernel``."""
        os.close(descriptor)

    def ioctl(self, descriptor: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """See ``Kernel``."""
        while True:
            with contextlib.suppress(InterruptedError):
                fcntl.ioctl(descriptor, request, argument)
                return

    def map(self, descriptor: int, length: int, offset: int) -> Mapping:
        """See ``Kernel``."""
        return mmap.mmap(descriptor, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        """See ``Kernel``."""
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000.0))


@dataclass(frozen=True, eq=False)
class CapturedBuffer:
    """What the driver handed over: one image, its time and its number."""

    data: bytes
    time_s: float
    clock: Clock
    sequence: int
    flagged: bool
    """The driver says that the data may be damaged."""


class V4l2Device:
    """An open camera that streams. Use as a context manager; every method raises CameraError when the camera fails."""

    def __init__(
        self,
        name: str,
        path: str,
        *,
        size: tuple[int, int],
        pixel_format: PixelFormat,
        rate_hz: float,
        controls: Sequence[ControlParameters] = (),
        kernel: Kernel | None = None,
    ) -> None:
        """Opens the device, sets it up as asked, and starts it; what the driver does not grant is a CameraError."""
        self._kernel = kernel or LinuxKernel()
        self._who = f"{name}: {path}"
        self._maps: list[Mapping] = []
        self.bytes_per_line = 0
        """Distance of the rows of an image that is not compressed."""
        with self._telling("cannot be opened"):
            self._descriptor = self._kernel.open(path)
        try:
            self._check_capabilities()
            self._set_format(size, pixel_format)
            self._set_rate(rate_hz)
            self._set_controls(controls)
            self._start()
        except BaseException:
            self.close()
            raise

    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """The next image; None if there is none within the time."""
        with self._telling("has failed"):
            if not self._kernel.wait(self._descriptor, timeout_s):
                return None
        buffer = Buffer(type=_CAPTURE, memory=_MAPPED)
        try:
            self._kernel.ioctl(self._descriptor, VIDIOC_DQBUF, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._fault("has failed", error) from error
        captured = CapturedBuffer(
            data=self._maps[buffer.index][slice(0, buffer.bytesused)],
            time_s=buffer.seconds + buffer.microseconds * 1e-6,
            clock=_CLOCKS.get(buffer.flags & _CLOCK_MASK, "unknown"),
            sequence=buffer.sequence,
            flagged=bool(buffer.flags & _FLAG_ERROR),
        )
        with self._telling("has failed"):
            self._kernel.ioctl(self._descriptor, VIDIOC_QBUF, buffer)
        return captured

    def close(self) -> None:
        """Stops the camera and gives it back."""
        with contextlib.suppress(OSError):  # an unplugged camera cannot be stopped any more
            self._kernel.ioctl(self._descriptor, VIDIOC_STREAMOFF, ctypes.c_int(_CAPTURE))
        while self._maps:
            self._maps.pop().close()
        self._kernel.close(self._descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check_capabilities(self) -> None:
        capability = Capability()
        with self._telling("is not a V4L2 camera"):
            self._kernel.ioctl(self._descriptor, VIDIOC_QUERYCAP, capability)
        known = capability.capabilities & _HAS_DEVICE_CAPABILITIES  # those of this device, not of the whole camera
        flags = capability.device_caps if known else capability.capabilities
        if not flags & _CAN_CAPTURE or not flags & _CAN_STREAM:
            raise CameraError(
                f"{self._who} does not capture images; many cameras have a second device for their metadata: "
                "name the other one"
            )

    def _set_format(self, size: tuple[int, int], pixel_format: PixelFormat) -> None:
        asked = Format(
            type=_CAPTURE, width=size[0], height=size[1], pixelformat=_FOURCC[pixel_format], field=_PROGRESSIVE
        )
        with self._telling("cannot be set up"):
            self._kernel.ioctl(self._descriptor, VIDIOC_S_FMT, asked)
        if (asked.width, asked.height) != size or asked.pixelformat != _FOURCC[pixel_format]:
            offered = int(asked.pixelformat).to_bytes(4, "little").decode("ascii", "replace")
            raise CameraError(
                f"{self._who} offers {asked.width}x{asked.height} {offered} instead of {size[0]}x{size[1]} "
                f"{pixel_format}; choose from what `v4l2-ctl --list-formats-ext` lists"
            )
        self.bytes_per_line = int(asked.bytesperline) or 2 * size[0]

    def _set_rate(self, rate_hz: float) -> None:
        period = 1 / Fraction(rate_hz).limit_denominator(1001)
        asked = StreamParameters(type=_CAPTURE, numerator=period.numerator, denominator=period.denominator)
        try:
            self._kernel.ioctl(self._descriptor, VIDIOC_S_PARM, asked)
        except OSError as error:
            if error.errno == errno.ENOTTY:
                return  # a driver without this call has one rate only
            raise self._fault("cannot be set up", error) from error
        granted = asked.denominator / asked.numerator if asked.numerator else rate_hz
        if abs(granted - rate_hz) > _RATE_TOLERANCE * rate_hz:
            raise CameraError(
                f"{self._who} runs at {granted:.4g} instead of {rate_hz:.4g} images a second; "
                f"write rate_hz: {granted:.4g}"
            )

    def _set_controls(self, controls: Sequence[ControlParameters]) -> None:
        offered = {control_name(control.name): control for control in self._controls()} if controls else {}
        for wanted in controls:
            control = offered.get(wanted.name)
            if control is None:
                raise CameraError(
                    f"{self._who} has no control {wanted.name!r}; it has {', '.join(sorted(offered)) or 'none'}"
                )
            if not control.minimum <= wanted.value <= control.maximum:
                raise CameraError(
                    f"{self._who} takes {wanted.name} from {control.minimum} to {control.maximum}, not {wanted.value}"
                )
            self._set_control(wanted, control.id)

    def _set_control(self, wanted: ControlParameters, number: int) -> None:
        with self._telling(f"cannot set {wanted.name} to {wanted.value}"):
            self._kernel.ioctl(self._descriptor, VIDIOC_S_CTRL, Control(id=number, value=wanted.value))
            granted = Control(id=number)
            self._kernel.ioctl(self._descriptor, VIDIOC_G_CTRL, granted)
        if granted.value != wanted.value:
            raise CameraError(
                f"{self._who} makes {granted.value} of {wanted.name} {wanted.value}; write a value it can keep"
            )

    def _controls(self) -> Iterator[QueryControl]:
        number = 0
        while True:
            control = QueryControl(id=number | _NEXT_CONTROL)
            try:
                self._kernel.ioctl(self._descriptor, VIDIOC_QUERYCTRL, control)
            except OSError as error:
                if error.errno in {errno.EINVAL, errno.ENOTTY}:
                    return  # that was the last
                raise self._fault("cannot list its controls", error) from error
            number = control.id
            if not control.flags & _CONTROL_DISABLED:
                yield control

    def _start(self) -> None:
        with self._telling("cannot be started"):
            wanted = RequestBuffers(count=_BUFFERS, type=_CAPTURE, memory=_MAPPED)
            self._kernel.ioctl(self._descriptor, VIDIOC_REQBUFS, wanted)
            for index in range(wanted.count):
                buffer = Buffer(index=index, type=_CAPTURE, memory=_MAPPED)
                self._kernel.ioctl(self._descriptor, VIDIOC_QUERYBUF, buffer)
                self._maps.append(self._kernel.map(self._descriptor, buffer.length, buffer.offset & 0xFFFFFFFF))
                self._kernel.ioctl(self._descriptor, VIDIOC_QBUF, buffer)
            self._kernel.ioctl(self._descriptor, VIDIOC_STREAMON, ctypes.c_int(_CAPTURE))

    @contextlib.contextmanager
    def _telling(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._fault(what, error) from error

    def _fault(self, what: str, error: OSError) -> CameraError:
        match error.errno:
            case errno.ENODEV | errno.ENOENT | errno.ENXIO:
                return CameraError(f"{self._who} is not there; plug the camera in, or correct the path")
            case errno.EBUSY:
                return CameraError(f"{self._who} is in use by another program; stop that one")
            case errno.EACCES if what == "cannot be opened":
                return CameraError(f"{self._who} may not be opened by this user; add the user to the group `video`")
            case _:
                return CameraError(f"{self._who} {what} ({os.strerror(error.errno or 0)})")


def control_name(name: bytes) -> str:
    """A control's name as `v4l2-ctl --list-ctrls` prints it: `Exposure Time, Absolute` is exposure_time_absolute."""
    return re.sub(r"[^a-z0-9]+", "_", name.decode("ascii", "replace").lower()).strip("_")
