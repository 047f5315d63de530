"""Which cameras are plugged in: those of the kernel, and those that GStreamer's device monitor finds."""

from __future__ import annotations

import errno
import os
import re
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from flockd.ground.cameras.found import ControlRange, FoundCamera, Mode
from flockd.onboard.sources.gstreamer_device import FORMATS
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

BY_PATH = Path("/dev/v4l/by-path")
"""udev's links by the socket that a camera is plugged into: they stay the same whatever is plugged in elsewhere."""
RUN_S = 20.0
_ARGUS = "nvarguscamerasrc"
_ARGUS_MODES = tuple(Mode("NV12", size, (30.0,)) for size in ((640, 480), (1280, 720), (1920, 1080)))
"""It scales to whatever it is asked for."""


def run_program(command: Sequence[str]) -> str | None:
    """What a program prints; None where it is not installed, fails or takes too long."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=RUN_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True)
class Computer:
    """Where cameras are looked for."""

    kernel: Kernel = field(default_factory=Kernel)
    nodes: Path = Path("/sys/class/video4linux")
    links: Path = BY_PATH
    run: Callable[[Sequence[str]], str | None] = run_program


def list_cameras(computer: Computer) -> list[FoundCamera]:
    """All of them, in a stable order; one that cannot be used says why."""
    found = list(_of_kernel(computer))
    monitored = cameras_of_monitor(computer.run(MONITOR) or "")
    if any(camera.fault == SENSOR_ONLY for camera in found) and computer.run(("gst-inspect-1.0", "--exists", _ARGUS)):
        found = list(_by_argus(found))
    elif monitored:  # they are the sensors among the kernel's devices
        found = [camera for camera in found if camera.fault != SENSOR_ONLY]
    return found + monitored


def _of_kernel(computer: Computer) -> Iterator[FoundCamera]:
    """Each by the shortest of its links, as udev has more than one for a USB 2 socket."""
    links: dict[str, str] = {}
    for link in sorted(computer.links.glob("*"), key=lambda link: (len(link.name), link.name)):
        if link.is_symlink():
            links.setdefault(link.readlink().name, str(BY_PATH / link.name))
    names = sorted((file.name for file in computer.nodes.glob("video*")), key=lambda name: (len(name), name))
    for name in names:
        camera = read_camera(computer.kernel, f"/dev/{name}", links.get(name, f"/dev/{name}"))
        if camera is not None:
            yield camera


def _by_argus(found: Sequence[FoundCamera]) -> Iterator[FoundCamera]:
    """On a Jetson the sensors of the CSI ports are cameras of NVIDIA's, numbered in the kernel's order."""
    number = 0
    for camera in found:
        if camera.fault == SENSOR_ONLY:
            element = f"{_ARGUS} sensor-id={number}"
            yield replace(camera, device="", element=element, modes=_ARGUS_MODES, fault=None)
            number += 1
        else:
            yield camera


MONITOR = ("gst-device-monitor-1.0", "Video/Source")
_OTHERS = ("v4l2src", "pipewiresrc", "ximagesrc")
"""Elements that are left out: what flockd finds by itself, and what is a view of it or no camera."""
_LAUNCH = re.compile(r"^\s*gst-launch-1\.0 (\S.*?)(?: ! \.\.\.)?\s*$", re.MULTILINE)
_NAME = re.compile(r"^\s*name\s*: (.*)$", re.MULTILINE)
_CAPS = re.compile(r"(image/jpeg|video/x-raw),([^;\n]*)")
_NUMBER = {key: re.compile(rf"\b{key}=(?:\(int\))?(\d+)") for key in ("width", "height")}
_FORMAT = re.compile(r"\bformat=(?:\(string\))?(\w+)")
_RATES = re.compile(r"\bframerate=(?:\(fraction\))?(?:\{([^}]*)\}|(\d+/\d+))")


def cameras_of_monitor(text: str) -> list[FoundCamera]:
    """A camera for each device that flockd does not find by itself; ``text`` is the monitor's whole output."""
    found = []
    for part in text.split("Device found:")[1:]:
        launch, name = _LAUNCH.search(part), _NAME.search(part)
        if launch is None or launch[1].startswith(_OTHERS):
            continue
        called = name[1].strip() if name else launch[1]
        found.append(FoundCamera(called, node="", element=launch[1], modes=tuple(_modes(part)) or _ANY))
    return found


_ANY = (Mode("NV12", (640, 480), (30.0,)),)
"""Modes assumed for an element that does not say what it offers."""


def _modes(text: str) -> Iterator[Mode]:
    for kind, fields in _CAPS.findall(text):
        width, height = (_NUMBER[key].search(fields) for key in ("width", "height"))
        name = _FORMAT.search(fields)
        pixel_format = "mjpeg" if kind == "image/jpeg" else name[1] if name else ""
        if width is None or height is None or (pixel_format != "mjpeg" and pixel_format not in FORMATS):
            continue
        pixel_format = "yuyv" if pixel_format == "YUY2" else pixel_format
        yield Mode(pixel_format, (int(width[1]), int(height[1])), _rates(fields))


def _rates(fields: str) -> tuple[float, ...]:
    rates = _RATES.search(fields)
    pairs = re.findall(r"(\d+)/(\d+)", rates[0]) if rates else []
    return tuple(sorted({round(int(a) / int(b), 3) for a, b in pairs if int(b)}, reverse=True))


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
        described = _entries(kernel, descriptor, VIDIOC_ENUM_FMT, partial(FormatDescription, type=CAPTURE))
        formats = [entry.pixelformat for entry in described]
        modes = tuple(
            mode for number in formats if number in _NAMES for mode in _kernel_modes(kernel, descriptor, number)
        )
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


def _kernel_modes(kernel: Kernel, descriptor: int, number: int) -> Iterator[Mode]:
    sized = list(_entries(kernel, descriptor, VIDIOC_ENUM_FRAMESIZES, partial(FrameSize, pixel_format=number)))
    sizes = [(one.width, one.height) for one in sized if one.type == _DISCRETE]
    for width, height in sizes if sizes or not sized else _SIZES_OF_RANGE:
        entry = partial(FrameInterval, pixel_format=number, width=width, height=height)
        intervals = _entries(kernel, descriptor, VIDIOC_ENUM_FRAMEINTERVALS, entry)
        rates = {round(one.denominator / one.numerator, 3) for one in intervals if one.numerator}
        yield Mode(_NAMES[number], (width, height), tuple(sorted(rates, reverse=True)))


def _entries(kernel: Kernel, descriptor: int, request: int, entry: Callable[..., _Entry]) -> Iterator[_Entry]:
    """A list of the driver's, by index, until it has no more or does not keep one."""
    for index in range(_MOST):
        asked = entry(index=index)
        try:
            kernel.ioctl(descriptor, request, asked)
        except OSError as error:
            if error.errno in {errno.EINVAL, errno.ENOTTY}:
                return
            raise
        yield asked
