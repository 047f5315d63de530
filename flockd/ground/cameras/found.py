"""A camera that is plugged in, what it offers, and how flockd would run it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from flockd.core.choices import PixelFormat
from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig
from flockd.core.config.source import CameraDeviceParameters
from flockd.core.errors import UsageError
from flockd.ground.calibration.fragment import rig_text

USUAL_SIZE, USUAL_RATE_HZ = (640, 480), 30.0
"""What is chosen where a camera offers it."""
_PREFERENCE = ("mjpeg", "NV12", "I420", "yuyv")
"""Formats in order of preference, first those that take the least of a bus."""


@dataclass(frozen=True)
class Mode:
    """One format and size of a camera."""

    pixel_format: str
    """`mjpeg` or `yuyv`; of a pipeline also GStreamer's name of a raw format."""
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
    """What the kernel calls it now, such as /dev/video0; empty where that is not known."""
    device: str = ""
    """The path to configure, which stays the same; of a V4L2 camera."""
    element: str = ""
    """GStreamer's, with its properties; of a camera that flockd reads by a pipeline."""
    modes: tuple[Mode, ...] = ()
    controls: tuple[ControlRange, ...] = ()
    fault: str | None = None
    """Why it cannot be used, in one sentence."""

    @property
    def place(self) -> str:
        """By which it is told apart."""
        return self.element or self.device

    def best_mode(self, size: tuple[int, int] = USUAL_SIZE) -> Mode | None:
        """The mode nearest to a size, in the format that takes the least of a bus, at the usual rate if there is."""

        def cost(mode: Mode) -> tuple[int, int]:
            width, height = mode.size
            off = abs(width - size[0]) + abs(height - size[1])
            rank = _PREFERENCE.index(mode.pixel_format) if mode.pixel_format in _PREFERENCE else len(_PREFERENCE)
            return off, rank

        if not self.modes:
            return None
        best = min(self.modes, key=cost)
        usual = [rate for rate in best.rates_hz if rate <= USUAL_RATE_HZ + 0.5]
        return replace(best, rates_hz=(max(usual, default=min(best.rates_hz, default=USUAL_RATE_HZ)),))

    def parameters(self, name: str, mode: Mode, *, as_pipeline: bool = False) -> CameraDeviceParameters:
        """How flockd runs it in a mode, under a name of the rig; ``as_pipeline``: through GStreamer in any case."""
        rate_hz = mode.rates_hz[0]
        if self.element or as_pipeline:
            kind = _CAPS.get(mode.pixel_format, f"video/x-raw,format={mode.pixel_format}")
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


_CAPS = {"mjpeg": "image/jpeg", "yuyv": "video/x-raw,format=YUY2"}


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
        raise UsageError(
            "--turn-deg is for USB cameras, and one of these needs a pipeline; add `videoflip` to each there"
        )
    sizes = {name: mode.size if turn_deg % 180 == 0 else mode.size[::-1] for name, (_, mode) in cameras.items()}
    comment = (
        "Written by `flockd cameras`: the cameras of this computer, as sections of a drone's configuration.",
        "Fill in which camera looks where: exchange the names. `flockd cameras --picture FOLDER` shows what each sees.",
        "Fill in intrinsics and extrinsics, by `flockd calibrate camera` and `flockd calibrate rig`.",
    )
    lines = [
        rig_text([_evenly(number, sizes, name) for number, name in enumerate(sizes)], comment).rstrip(),
        "source:",
        f"  kind: {'gstreamer' if as_pipelines else 'v4l2'}",
        "  cameras:",
    ]
    slowest_hz = min(mode.rates_hz[0] for _, mode in cameras.values())
    for name, (camera, mode) in cameras.items():
        parameters = camera.parameters(name, mode, as_pipeline=as_pipelines)
        where = f", {camera.node} now" if camera.node else ""
        lines.append(f"    - name: {name}    # {' '.join(camera.name.split())}{where}")
        if parameters.pipeline:
            lines.append(f"      pipeline: {json.dumps(parameters.pipeline, ensure_ascii=False)}")
        else:
            lines.append(f"      device: {json.dumps(parameters.device)}")
            lines.append(f"      pixel_format: {parameters.pixel_format}")
        lines.append(f"      rate_hz: {parameters.rate_hz:g}")
        if turn_deg:
            lines.append(f"      turn_deg: {turn_deg}")
        if not as_pipelines:
            lines += _controls(camera)
    tolerance_s = max(0.02, 0.6 / slowest_hz)
    silence_s = max(0.5, 3.0 / slowest_hz)
    lines += [
        f"  set_tolerance_s: {tolerance_s:.3g}    # half a frame period or more",
        f"  silence_s: {silence_s:.3g}",
    ]
    return "\n".join(lines) + "\n"


def _controls(camera: FoundCamera) -> list[str]:
    """A fixed, short exposure where the camera has the usual controls; the others as comments."""
    offered = {control.name: control for control in camera.controls}
    set_by_hand = [name for name in _BY_HAND if name in offered]
    lines = ["      controls:"] if set_by_hand else []
    for name in set_by_hand:
        low, high = offered[name].low, offered[name].high
        value = min(max(_BY_HAND[name], low), high)
        lines.append(f"        - {{name: {name}, value: {value}}}    # {low} to {high}")
    others = [f"{one.name} {one.low} to {one.high}" for one in camera.controls if one.name not in set_by_hand]
    return [*lines, *(f"      # also: {other}" for other in others)]


def camera_names(count: int) -> Sequence[str]:
    """Clockwise from the one that looks forward."""
    named = {1: ("front",), 2: ("front", "back"), 4: ("front", "right", "back", "left")}
    return named.get(count, tuple(f"camera{number + 1}" for number in range(count)))


def _evenly(number: int, sizes: Mapping[str, tuple[int, int]], name: str) -> CameraConfig:
    """One of the cameras that look evenly around, with perfect wide-angle lenses; the field of view is that of the
    longer side."""
    width, height = sizes[name]
    yaw_deg = 360.0 * number / len(sizes)
    forward_m, right_m = (round(0.1 * of(math.radians(yaw_deg)), 2) + 0.0 for of in (math.cos, math.sin))  # no -0.0
    focal_px = round(max(width, height) / 2 / math.radians(FIELD_OF_VIEW_DEG / 2), 1)
    lens = IntrinsicsConfig(model="wide_angle", fx=focal_px, fy=focal_px, cx=width / 2, cy=height / 2)
    mounting = ExtrinsicsConfig(position_m=(forward_m, right_m, 0.0), yaw_deg=yaw_deg)
    return CameraConfig(name=name, size_px=(width, height), intrinsics=lens, extrinsics=mounting)
