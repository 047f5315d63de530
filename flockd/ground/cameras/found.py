"""A camera that is plugged in, what it offers, and how flockd would run it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from flockd.core.choices import PixelFormat
from flockd.core.config.source import CameraDeviceParameters

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
        return replace(best, rates_hz=(_usual_rate(best.rates_hz),))

    def parameters(self, name: str, mode: Mode, *, as_pipeline: bool = False) -> CameraDeviceParameters:
        """How flockd runs it in a mode, under a name of the rig; ``as_pipeline``: through GStreamer in any case."""
        rate_hz = mode.rates_hz[0]
        if self.element or as_pipeline:
            kind = _CAPS.get(mode.pixel_format, f"video/x-raw,format={mode.pixel_format}")
            limits = f"width={mode.size[0]},height={mode.size[1]},framerate={_fraction(rate_hz)}"
            element = self.element or f"v4l2src device={self.device}"
            if element.startswith("nvarguscamerasrc"):
                pipeline = f"{element} ! video/x-raw(memory:NVMM),{limits} ! nvvidconv ! video/x-raw,format=NV12"
            else:
                pipeline = f"{element} ! {kind},{limits}"
            return CameraDeviceParameters(name=name, pipeline=pipeline, rate_hz=rate_hz)
        pixel_format: PixelFormat = "mjpeg" if mode.pixel_format == "mjpeg" else "yuyv"
        return CameraDeviceParameters(name=name, device=self.device, pixel_format=pixel_format, rate_hz=rate_hz)


_CAPS = {"mjpeg": "image/jpeg", "yuyv": "video/x-raw,format=YUY2"}


def _usual_rate(rates_hz: Sequence[float]) -> float:
    """The highest that is not above the usual one; else the lowest there is, and the usual one of an unknown camera."""
    usual = [rate for rate in rates_hz if rate <= USUAL_RATE_HZ + 0.5]
    return max(usual) if usual else min(rates_hz, default=USUAL_RATE_HZ)


def _fraction(rate_hz: float) -> str:
    return f"{rate_hz:.0f}/1" if rate_hz == round(rate_hz) else f"{round(rate_hz * 1000)}/1000"
