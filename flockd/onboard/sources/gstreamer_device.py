"""A camera read through a GStreamer pipeline in a separate process.

For cameras on the CSI ports of a Jetson or a Raspberry Pi, network cameras, and files.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flockd.core.config.source import CameraDeviceParameters
from flockd.core.messages import UInt8Array
from flockd.core.secrets import masked
from flockd.onboard.sources.camera_child import CAPS, IMAGE, NOT_INSTALLED, packed_text
from flockd.onboard.sources.child_device import CHILD, ChildDevice, ChildMessage
from flockd.onboard.sources.frames import CameraError, CapturedBuffer
from flockd.onboard.sources.image_formats import (
    PACKED,
    ImageFormat,
    MjpegFormat,
    PackedFormat,
    check_length,
)

PACKAGES = "libgstreamer1.0-0, gstreamer1.0-plugins-base and the plugins that its pipeline needs"


class GstreamerDevice(ChildDevice):
    """A ``CameraDevice`` for a pipeline. Time stamps are those of GStreamer's buffers, on CLOCK_MONOTONIC."""

    _what, _kinds = "its pipeline", (CAPS, IMAGE)

    def __init__(self, camera: CameraDeviceParameters, size: tuple[int, int], command: Sequence[str] = CHILD) -> None:
        """Starts the process: ``command`` with the caps wanted from the pipeline. Raises CameraError."""
        wanted = [*command, "gstreamer", caps(size, camera.rate_hz)]
        super().__init__(camera, size, wanted, told=packed_text(camera.place))

    def _taken(self, message: ChildMessage) -> CapturedBuffer | None:
        if message.kind == CAPS:
            self._set_format(message.data.decode("utf-8", "replace"))
            return None
        if self._format is None:
            raise self._nonsense()
        return self._captured(message.data, message)

    def _set_format(self, text: str) -> None:
        found = format_of(text)
        if found is None:
            raise CameraError(f"{self._name}: its pipeline gives {masked(text)[:80]}; end it with `videoconvert`")
        self._format, size = found
        scale = f"`videoscale ! video/x-raw,width={self._size[0]},height={self._size[1]}`"
        self._check_size(size, "its pipeline gives", f"end it with {scale}, or correct")

    def _failed(self, reason: str) -> CameraError:
        if reason == NOT_INSTALLED:
            return CameraError(f"{self._name}: {reason}; install {PACKAGES}")
        return CameraError(
            f"{self._name}: its pipeline {masked(reason)}; try it with `gst-launch-1.0 PIPELINE ! fakesink`"
        )


_PLANAR: Mapping[str, int] = {"NV12": cv2.COLOR_YUV2RGB_NV12, "I420": cv2.COLOR_YUV2RGB_I420}
_FIELD = re.compile(r"(format|width|height)=\(\w+\)([^,;\s]+)")


@dataclass(frozen=True)
class PlanarFormat:
    """A plane of luma, then chroma at half the resolution (NV12, I420); BT.601, luma from 16 to 235."""

    name: str
    size: tuple[int, int]
    """Width, a multiple of 8, so that GStreamer pads no plane, and height, even."""

    def check(self, data: bytes) -> None:
        """See ``ImageFormat``: size."""
        check_length(data, self.size[0] * self.size[1] * 3 // 2)

    def pixels(self, data: bytes) -> UInt8Array:
        """See ``ImageFormat``."""
        self.check(data)
        planes = np.frombuffer(data, np.uint8).reshape(-1, self.size[0])
        return np.asarray(cv2.cvtColor(planes, _PLANAR[self.name]), np.uint8)


def _formats(size: tuple[int, int]) -> tuple[str, ...]:
    """Names of the formats that can be decoded, the cheapest first: a pipeline chooses the first that it can give."""
    return (*(_PLANAR if size[0] % 8 == size[1] % 2 == 0 else ()), *PACKED)


def caps(size: tuple[int, int], rate_hz: float) -> str:
    """The caps wanted from a pipeline: all formats that can be decoded, preferably in the rig's size and rate."""
    formats = f"format=(string){{{','.join(_formats(size))}}}"
    kinds = ("image/jpeg", f"video/x-raw,{formats}")
    in_size = f",width={size[0]},height={size[1]}"
    at_rate = f",framerate={round(rate_hz * 1000)}/1000"
    return ";".join(kind + limits for limits in (in_size + at_rate, in_size, "") for kind in kinds)


def format_of(text: str) -> tuple[ImageFormat, tuple[int, int]] | None:
    """The format and size of images with these caps; None: they cannot be decoded."""
    fields = dict(_FIELD.findall(text))
    try:
        size = int(fields["width"]), int(fields["height"])
    except (KeyError, ValueError):
        return None
    if text.startswith("image/jpeg"):
        return MjpegFormat(size), size
    name = fields.get("format", "")
    if name in PACKED:
        return PackedFormat(name, size), size
    return (PlanarFormat(name, size), size) if name in _formats(size) else None
