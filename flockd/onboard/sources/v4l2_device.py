"""A V4L2 camera through the kernel's interface (linux/videodev2.h): ioctl, mmap and poll, on 64-bit Linux.

Frames have the kernel's time stamps and numbers.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import os
import re
from collections.abc import Iterator, Sequence
from fractions import Fraction

from flockd.core.choices import PixelFormat
from flockd.core.config.source import CameraDeviceParameters, ControlParameters
from flockd.onboard.sources import v4l2_kernel as v4l2
from flockd.onboard.sources.frames import CameraDevice, CameraError, CapturedBuffer
from flockd.onboard.sources.image_formats import ImageFormat, MjpegFormat, PackedFormat
from flockd.onboard.sources.v4l2_kernel import Kernel

CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_MAPPED = 1  # V4L2_MEMORY_MMAP
_PROGRESSIVE = 1  # V4L2_FIELD_NONE
CAN_CAPTURE = 0x00000001
_CAN_STREAM = 0x04000000
_HAS_DEVICE_CAPABILITIES = 0x80000000
_FLAG_ERROR = 0x0040
_NEXT_CONTROL = 0x80000000
_CONTROL_DISABLED = 0x0001
FOURCC = {name: int.from_bytes(code, "little") for name, code in (("mjpeg", b"MJPG"), ("yuyv", b"YUYV"))}
_BUFFERS = 4
_RATE_TOLERANCE = 0.1


class V4l2Device(CameraDevice):
    """A ``CameraDevice`` for a V4L2 camera."""

    start_s = 3.0

    def __init__(self, camera: CameraDeviceParameters, size: tuple[int, int], kernel: Kernel | None = None) -> None:
        """Opens, sets up and starts the device. Raises CameraError if the driver does not grant a setting.

        ``size``: width and height of the images as used, after `reduce` and before `turn_deg`.
        """
        self._kernel = kernel or Kernel()
        self._who = f"{camera.name}: {camera.device}"
        self._size = size[0] * camera.reduce, size[1] * camera.reduce
        self._pixel_format, self._reduce = camera.pixel_format, camera.reduce
        self._other_size = f", or write a smaller reduce than {camera.reduce}" if camera.reduce > 1 else ""
        self._other_size += ", or correct crop_of" if camera.crop else ""
        self._maps: list[mmap.mmap] = []
        self._bytes_per_line = 0
        with self._telling("cannot be opened"):
            self._descriptor = self._kernel.open(camera.place)
        try:
            self._check_capabilities()
            self._set_format(self._size, camera.pixel_format)
            self._set_rate(camera.rate_hz)
            self._set_controls(camera.controls)
            self._start()
        except BaseException:
            self.close()
            raise

    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """See ``CameraDevice``."""
        with self._telling("has failed"):
            if not self._kernel.wait(self._descriptor, timeout_s):
                return None
        buffer = v4l2.Buffer(type=CAPTURE, memory=_MAPPED)
        try:
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_DQBUF, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._fault("has failed", error) from error
        captured = CapturedBuffer(
            data=self._maps[buffer.index][slice(0, buffer.bytesused)],
            time_s=buffer.seconds + buffer.microseconds * 1e-6,
            sequence=buffer.sequence,
            flagged=bool(buffer.flags & _FLAG_ERROR),
        )
        with self._telling("has failed"):
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_QBUF, buffer)
        return captured

    def image_format(self) -> ImageFormat:
        """See ``CameraDevice``."""
        if self._pixel_format == "mjpeg":
            return MjpegFormat(self._size, self._reduce)
        return PackedFormat("YUY2", self._size, self._bytes_per_line, self._reduce)

    def close(self) -> None:
        """See ``CameraDevice``."""
        with contextlib.suppress(OSError):  # an unplugged camera cannot be stopped
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_STREAMOFF, ctypes.c_int(CAPTURE))
        while self._maps:
            self._maps.pop().close()
        self._kernel.close(self._descriptor)

    def _check_capabilities(self) -> None:
        capability = v4l2.Capability()
        with self._telling("is not a V4L2 camera"):
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_QUERYCAP, capability)
        flags = camera_flags(capability)
        if not flags & CAN_CAPTURE or not flags & _CAN_STREAM:
            raise CameraError(
                f"{self._who} does not capture images; many cameras have a second device for their metadata: "
                "name the other one"
            )

    def _set_format(self, size: tuple[int, int], pixel_format: PixelFormat) -> None:
        asked = v4l2.Format(
            type=CAPTURE, width=size[0], height=size[1], pixelformat=FOURCC[pixel_format], field=_PROGRESSIVE
        )
        with self._telling("cannot be set up"):
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_S_FMT, asked)
        if (asked.width, asked.height) != size or asked.pixelformat != FOURCC[pixel_format]:
            offered = int(asked.pixelformat).to_bytes(4, "little").decode("ascii", "replace")
            raise CameraError(
                f"{self._who} offers {asked.width}x{asked.height} {offered} instead of {size[0]}x{size[1]} "
                f"{pixel_format}; choose from what `v4l2-ctl --list-formats-ext` lists{self._other_size}"
            )
        self._bytes_per_line = int(asked.bytesperline) or 2 * size[0]

    def _set_rate(self, rate_hz: float) -> None:
        period = 1 / Fraction(rate_hz).limit_denominator(1001)
        asked = v4l2.StreamParameters(type=CAPTURE, numerator=period.numerator, denominator=period.denominator)
        try:
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_S_PARM, asked)
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
        if not controls:
            return
        with self._telling("cannot list its controls"):
            offered = controls_of(self._kernel, self._descriptor)
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
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_S_CTRL, v4l2.Control(id=number, value=wanted.value))
            granted = v4l2.Control(id=number)
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_G_CTRL, granted)
        if granted.value != wanted.value:
            raise CameraError(
                f"{self._who} sets {wanted.name} to {granted.value} instead of {wanted.value}; "
                "write a value that it keeps"
            )

    def _start(self) -> None:
        with self._telling("cannot be started"):
            wanted = v4l2.RequestBuffers(count=_BUFFERS, type=CAPTURE, memory=_MAPPED)
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_REQBUFS, wanted)
            for index in range(wanted.count):
                buffer = v4l2.Buffer(index=index, type=CAPTURE, memory=_MAPPED)
                self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_QUERYBUF, buffer)
                self._maps.append(self._kernel.map(self._descriptor, buffer.length, buffer.offset & 0xFFFFFFFF))
                self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_QBUF, buffer)
            self._kernel.ioctl(self._descriptor, v4l2.VIDIOC_STREAMON, ctypes.c_int(CAPTURE))

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


def camera_flags(capability: v4l2.Capability) -> int:
    """The capabilities of this device; a camera may have several devices."""
    known = capability.capabilities & _HAS_DEVICE_CAPABILITIES
    return int(capability.device_caps if known else capability.capabilities)


def controls_of(kernel: Kernel, descriptor: int) -> dict[str, v4l2.QueryControl]:
    """The controls of an open device, by the names that `v4l2-ctl` prints. Raises OSError."""
    controls: dict[str, v4l2.QueryControl] = {}
    number = 0
    while True:
        control = v4l2.QueryControl(id=number | _NEXT_CONTROL)
        try:
            kernel.ioctl(descriptor, v4l2.VIDIOC_QUERYCTRL, control)
        except OSError as error:
            if error.errno in {errno.EINVAL, errno.ENOTTY}:
                return controls  # that was the last
            raise
        number = control.id
        if not control.flags & _CONTROL_DISABLED:
            controls[control_name(control.name)] = control


def control_name(name: bytes) -> str:
    """A control's name as `v4l2-ctl --list-ctrls` prints it: `Exposure Time, Absolute` is exposure_time_absolute."""
    return re.sub(r"[^a-z0-9]+", "_", name.decode("ascii", "replace").lower()).strip("_")
