"""The cameras that GStreamer's device monitor finds, out of what it prints."""

from __future__ import annotations

import re
from collections.abc import Iterator

from flockd.ground.cameras.found import FoundCamera, Mode
from flockd.onboard.sources.gstreamer_device import FORMATS

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
