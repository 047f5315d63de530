"""What one V4L2 device is and offers, asked without starting it."""

from __future__ import annotations

import errno
import functools
import os
from collections.abc import Callable, Iterator
from typing import TypeVar

from flockd.ground.cameras.found import ControlRange, FoundCamera, Mode
from flockd.onboard.sources.v4l2_device import CAN_CAPTURE, CAPTURE, FOURCC, camera_flags, controls_of
from flockd.onboard.sources.v4l2_kernel import (
    VIDIOC_ENUM_FMT,
    VIDIOC_ENUM_FRAMEINTERVALS,
    VIDIOC_ENUM_FRAMESIZES,
    VIDIOC_QUERYCAP,
    Capability,
    FormatDescription,
    FrameInterval,
    FrameSize,
    Kernel,
)

SENSOR_ONLY = "sends a sensor's raw values only; read it by a pipeline of libcamerasrc, or nvarguscamerasrc on a Jetson"
_DISCRETE = 1
_MOST = 100
"""Entries of a list; a driver that never ends its own is not followed further."""
_SIZES_OF_RANGE = ((640, 480), (1280, 720), (1920, 1080))
"""What is listed of a camera that scales to any size."""
_NAMES = {number: name for name, number in FOURCC.items()}
_WORTH_SETTING = ("exposure", "gain", "white_balance", "focus")
_Entry = TypeVar("_Entry", FormatDescription, FrameSize, FrameInterval)


def read_camera(kernel: Kernel, node: str, device: str) -> FoundCamera | None:
    """The camera at a node, whose path to configure is ``device``; None for what captures no images."""
    try:
        descriptor = kernel.open(node)
    except OSError as error:
        reason = "may not be opened by this user; add the user to the group `video`"
        told = reason if error.errno == errno.EACCES else f"cannot be opened ({os.strerror(error.errno or 0)})"
        return FoundCamera(name="", node=node, device=device, fault=told)
    try:
        capability = Capability()
        kernel.ioctl(descriptor, VIDIOC_QUERYCAP, capability)
        if not camera_flags(capability) & CAN_CAPTURE:
            return None
        name = capability.card.decode("utf-8", "replace")
        described = _entries(kernel, descriptor, VIDIOC_ENUM_FMT, lambda i: FormatDescription(index=i, type=CAPTURE))
        formats = [entry.pixelformat for entry in described]
        modes = tuple(mode for number in formats if number in _NAMES for mode in _modes(kernel, descriptor, number))
        controls = tuple(
            ControlRange(name, control.minimum, control.maximum)
            for name, control in controls_of(kernel, descriptor).items()
            if any(part in name for part in _WORTH_SETTING)
        )
    except OSError as error:
        return FoundCamera(name="", node=node, device=device, fault=f"has failed ({os.strerror(error.errno or 0)})")
    finally:
        kernel.close(descriptor)
    return FoundCamera(name, node, device, modes=modes, controls=controls, fault=None if modes else _useless(formats))


def _useless(formats: list[int]) -> str:
    """Why a camera without a usable mode has none."""
    codes = [int(number).to_bytes(4, "little").decode("ascii", "replace") for number in formats]
    if codes and all(code[:2] in ("RG", "BG", "GB", "GR", "BA", "pR", "pB", "pg", "pG") for code in codes):
        return SENSOR_ONLY
    return f"offers {', '.join(codes) or 'no format'}, and flockd reads MJPG and YUYV; use a pipeline of GStreamer"


def _modes(kernel: Kernel, descriptor: int, number: int) -> Iterator[Mode]:
    def size_at(index: int) -> FrameSize:
        return FrameSize(index=index, pixel_format=number)

    sized = list(_entries(kernel, descriptor, VIDIOC_ENUM_FRAMESIZES, size_at))
    sizes = [(one.width, one.height) for one in sized if one.type == _DISCRETE]
    for width, height in sizes if sizes or not sized else _SIZES_OF_RANGE:
        interval = functools.partial(_interval, number, width, height)
        intervals = _entries(kernel, descriptor, VIDIOC_ENUM_FRAMEINTERVALS, interval)
        rates = {round(one.denominator / one.numerator, 3) for one in intervals if one.numerator}
        yield Mode(_NAMES[number], (width, height), tuple(sorted(rates, reverse=True)))


def _interval(number: int, width: int, height: int, index: int) -> FrameInterval:
    return FrameInterval(index=index, pixel_format=number, width=width, height=height)


def _entries(kernel: Kernel, descriptor: int, request: int, entry: Callable[[int], _Entry]) -> Iterator[_Entry]:
    """A list of the driver's, by index, until it has no more or does not keep one."""
    for index in range(_MOST):
        asked = entry(index)
        try:
            kernel.ioctl(descriptor, request, asked)
        except OSError as error:
            if error.errno in {errno.EINVAL, errno.ENOTTY}:
                return
            raise
        yield asked
