"""Lists the cameras of this computer, V4L2's and GStreamer's, with their modes and the configuration for them."""

from __future__ import annotations

import errno
import math
import os
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import yaml

from flockd.core.choices import PixelFormat
from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig
from flockd.core.config.source import CameraDeviceParameters
from flockd.core.errors import UsageError
from flockd.ground.calibration.fragment import rig_text
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

USUAL_SIZE, USUAL_RATE_HZ = (640, 480), 30.0
"""Preferred size and rate."""
_PREFERENCE = ("mjpeg", "NV12", "yuyv")
"""Formats in order of preference, first those that take the least of a bus."""


@dataclass(frozen=True)
class Mode:
    """One format and size of a camera."""

    pixel_format: str
    """`mjpeg` or `yuyv`; of an element of GStreamer `NV12`."""
    size: tuple[int, int]
    """Width, height."""
    rates_hz: tuple[float, ...]
    """Highest first."""


@dataclass(frozen=True)
class ControlRange:
    """A control of a driver, as `source.cameras[].controls` names it."""

    name: str
    low: int
    high: int


@dataclass(frozen=True)
class FoundCamera:
    """A camera of this computer."""

    name: str
    """Its driver's or maker's."""
    node: str
    """Its node at present, such as /dev/video0; empty: not known."""
    device: str = ""
    """For a V4L2 camera: the path to configure, which stays the same."""
    element: str = ""
    """For a camera that flockd reads through GStreamer: the element with its properties."""
    modes: tuple[Mode, ...] = ()
    controls: tuple[ControlRange, ...] = ()
    fault: str | None = None
    """Why it cannot be used, in one sentence."""

    @property
    def place(self) -> str:
        """Its identifier."""
        return self.element or self.device

    def best_mode(self, size: tuple[int, int] = USUAL_SIZE) -> Mode | None:
        """The mode nearest to a size, in the format that takes the least of a bus, at the usual rate if there is."""

        def cost(mode: Mode) -> tuple[int, int]:
            off = abs(mode.size[0] - size[0]) + abs(mode.size[1] - size[1])
            return off, _PREFERENCE.index(mode.pixel_format)

        if not self.modes:
            return None
        best = min(self.modes, key=cost)
        usual = [rate for rate in best.rates_hz if rate <= USUAL_RATE_HZ + 0.5]
        return replace(best, rates_hz=(max(usual, default=min(best.rates_hz, default=USUAL_RATE_HZ)),))

    def parameters(self, name: str, mode: Mode, *, as_pipeline: bool = False) -> CameraDeviceParameters:
        """Its configuration for a mode and a name in the rig; ``as_pipeline``: always through GStreamer."""
        rate_hz = mode.rates_hz[0]
        if self.element or as_pipeline:
            kind = _PIPELINE_CAPS[mode.pixel_format]
            fraction = f"{rate_hz:.0f}/1" if rate_hz == round(rate_hz) else f"{round(rate_hz * 1000)}/1000"
            limits = f"width={mode.size[0]},height={mode.size[1]},framerate={fraction}"
            element = self.element or f"v4l2src device={self.device}"
            if element.startswith("nvarguscamerasrc"):
                pipeline = f"{element} ! video/x-raw(memory:NVMM),{limits} ! nvvidconv ! video/x-raw,format=NV12"
            else:
                pipeline = f"{element} ! {kind},{limits}"
            return CameraDeviceParameters(name=name, pipeline=pipeline, rate_hz=rate_hz)
        pixel_format: PixelFormat = "mjpeg" if mode.pixel_format == "mjpeg" else "yuyv"
        return CameraDeviceParameters(name=name, device=self.device, pixel_format=pixel_format, rate_hz=rate_hz)


BY_PATH = Path("/dev/v4l/by-path")
"""udev's links by the socket of a camera, which do not depend on other devices."""
RUN_S = 20.0
_ARGUS = "nvarguscamerasrc"
_SIZES_OF_RANGE = ((640, 480), (1280, 720), (1920, 1080))
"""What is listed of a camera that scales to any size."""
_SCALED = tuple(Mode("NV12", size, (30.0,)) for size in _SIZES_OF_RANGE)
"""Modes of an element of GStreamer: those of libcamera and of NVIDIA scale to whatever they are asked for."""


def run_program(command: Sequence[str]) -> str | None:
    """The output of a program; None: it is not installed, fails or takes too long."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=RUN_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True)
class Computer:
    """The parts of the system in which cameras are searched; tests replace them."""

    kernel: Kernel = field(default_factory=Kernel)
    nodes: Path = Path("/sys/class/video4linux")
    links: Path = BY_PATH
    run: Callable[[Sequence[str]], str | None] = run_program


def list_cameras(computer: Computer) -> list[FoundCamera]:
    """All cameras in a stable order; an unusable one says why."""
    found = list(_of_kernel(computer))
    monitored = list(_of_monitor(computer.run(MONITOR) or ""))
    if any(camera.fault == SENSOR_ONLY for camera in found) and computer.run(("gst-inspect-1.0", "--exists", _ARGUS)):
        found = list(_by_argus(found))
    elif monitored:  # they are the sensors among the kernel's devices
        found = [camera for camera in found if camera.fault != SENSOR_ONLY]
    return found + monitored


def _of_kernel(computer: Computer) -> Iterator[FoundCamera]:
    """V4L2 cameras, each by its shortest link: udev has several for a USB 2 socket."""
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
    """On a Jetson, sensors of the CSI ports as NVIDIA's cameras, numbered in the kernel's order."""
    number = 0
    for camera in found:
        if camera.fault == SENSOR_ONLY:
            element = f"{_ARGUS} sensor-id={number}"
            yield replace(camera, device="", element=element, modes=_SCALED, fault=None)
            number += 1
        else:
            yield camera


MONITOR = ("gst-device-monitor-1.0", "Video/Source")
_OTHERS = ("v4l2src", "pipewiresrc", "ximagesrc")
"""Elements that are left out: cameras that flockd finds itself, and elements that are no camera."""
_LAUNCH = re.compile(r"^\s*gst-launch-1\.0 (\S.*?)(?: ! \.\.\.)?\s*$", re.MULTILINE)
_NAME = re.compile(r"^\s*name\s*: (.*)$", re.MULTILINE)


def _of_monitor(text: str) -> Iterator[FoundCamera]:
    """A camera for each device that flockd does not find by itself; ``text`` is the monitor's whole output."""
    for part in text.split("Device found:")[1:]:
        launch, name = _LAUNCH.search(part), _NAME.search(part)
        if launch is not None and not launch[1].startswith(_OTHERS):
            called = name[1].strip() if name else launch[1]
            yield FoundCamera(called, node="", element=launch[1], modes=_SCALED)


SENSOR_ONLY = "sends a sensor's raw values only; read it by a pipeline of libcamerasrc, or nvarguscamerasrc on a Jetson"
_DISCRETE = 1
_MOST = 100
"""Entries of a list; a driver that never ends its own is not followed further."""
_NAMES = {number: name for name, number in FOURCC.items()}
_WORTH_SETTING = ("exposure", "gain", "white_balance", "focus")
_Entry = TypeVar("_Entry", FormatDescription, FrameSize, FrameInterval)


def read_camera(kernel: Kernel, node: str, device: str) -> FoundCamera | None:
    """The camera at a node, whose path to configure is ``device``; None: it captures no images."""
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
    """Why a camera has no usable mode."""
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
    """Entries of a driver's list by index, until it ends or the driver returns an error."""
    for index in range(_MOST):
        asked = entry(index=index)
        try:
            kernel.ioctl(descriptor, request, asked)
        except OSError as error:
            if error.errno in {errno.EINVAL, errno.ENOTTY}:
                return
            raise
        yield asked


_PIPELINE_CAPS = {
    "mjpeg": "image/jpeg", "yuyv": "video/x-raw,format=YUY2", "NV12": "video/x-raw,format=NV12",
}  # fmt: skip


FIELD_OF_VIEW_DEG = 130.0
"""Written down until the lenses are calibrated."""
_BY_HAND = {"auto_exposure": 1, "exposure_auto": 1, "exposure_time_absolute": 50, "exposure_absolute": 50}
"""What cameras of the USB video class take for an exposure of 5 ms that is set by hand."""


def sections_text(cameras: Mapping[str, tuple[FoundCamera, Mode]], turn_deg: int = 0) -> str:
    """A commented file that `flockd config check` passes; cameras by their names in the rig.

    ``turn_deg``: as of `CameraDeviceParameters`. Raises UsageError where it is not 0 and one needs a pipeline.
    """
    as_pipelines = any(camera.element for camera, _ in cameras.values())
    if as_pipelines and turn_deg:
        raise UsageError("--turn-deg is for USB cameras, and one of these needs a pipeline; add `videoflip` there")
    comment = [
        "Written by `flockd cameras`: the cameras of this computer, as sections of a drone's configuration.",
        "Fill in which camera looks where: exchange the names. `flockd cameras --picture FOLDER` shows what each sees.",
        "Fill in intrinsics, by `flockd calibrate camera`, and extrinsics, by a tape and the frame's drawing.",
    ]
    entries = []
    for name, (camera, mode) in cameras.items():
        entry = camera.parameters(name, mode, as_pipeline=as_pipelines).model_dump(mode="json", exclude_defaults=True)
        entry |= {"turn_deg": turn_deg} if turn_deg else {}
        limits = {one.name: (one.low, one.high) for one in camera.controls}
        by_hand = {
            one: min(max(value, limits[one][0]), limits[one][1]) for one, value in _BY_HAND.items() if one in limits
        }
        if by_hand and not as_pipelines:
            entry["controls"] = [{"name": one, "value": value} for one, value in by_hand.items()]
        entries.append(entry)
        told = "".join(f"; {one} {low} to {high}" for one, (low, high) in limits.items())
        comment.append(f"{name}: {' '.join(camera.name.split())}{f', {camera.node} now' if camera.node else ''}{told}")
    slowest_hz = min(mode.rates_hz[0] for _, mode in cameras.values())
    source = {
        "kind": "gstreamer" if as_pipelines else "v4l2",
        "cameras": entries,
        "set_tolerance_s": round(max(0.02, 0.6 / slowest_hz), 3),
        "silence_s": round(max(0.5, 3.0 / slowest_hz), 3),
    }
    sizes = {name: mode.size if turn_deg % 180 == 0 else mode.size[::-1] for name, (_, mode) in cameras.items()}
    rig = [_evenly(number, len(sizes), name, size) for number, (name, size) in enumerate(sizes.items())]
    return rig_text(rig, comment) + yaml.safe_dump(
        {"source": source}, default_flow_style=None, sort_keys=False, width=math.inf, allow_unicode=True
    )


def camera_names(count: int) -> Sequence[str]:
    """Clockwise from the one that looks forward."""
    named = {1: ("front",), 2: ("front", "back"), 4: ("front", "right", "back", "left")}
    return named.get(count, tuple(f"camera{number + 1}" for number in range(count)))


def _evenly(number: int, count: int, name: str, size: tuple[int, int]) -> CameraConfig:
    """One of the cameras at equal angles around the drone, with ideal wide-angle lenses; the field of view is that of
    the longer side."""
    width, height = size
    yaw_deg = 360.0 * number / count
    forward_m, right_m = (round(0.1 * of(math.radians(yaw_deg)), 2) + 0.0 for of in (math.cos, math.sin))  # no -0.0
    focal_px = round(max(width, height) / 2 / math.radians(FIELD_OF_VIEW_DEG / 2), 1)
    lens = IntrinsicsConfig(model="wide_angle", fx=focal_px, fy=focal_px, cx=width / 2, cy=height / 2)
    mounting = ExtrinsicsConfig(position_m=(forward_m, right_m, 0.0), yaw_deg=yaw_deg)
    return CameraConfig(name=name, size_px=(width, height), intrinsics=lens, extrinsics=mounting)
