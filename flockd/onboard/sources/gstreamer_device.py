"""One camera behind a GStreamer pipeline that runs in a process of its own.

Such are those on the CSI ports of a Jetson or a Raspberry Pi, network cameras, and files.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from flockd.core.config.source import CameraDeviceParameters
from flockd.core.secrets import masked
from flockd.onboard.sources import gstreamer_child
from flockd.onboard.sources.child_device import ChildDevice, ChildMessage
from flockd.onboard.sources.devices import CameraError, CapturedBuffer
from flockd.onboard.sources.gstreamer_child import CAPS, IMAGE, packed_text
from flockd.onboard.sources.gstreamer_formats import caps, format_of
from flockd.onboard.sources.image_formats import ImageFormat

CHILD = (sys.executable, "-I", str(Path(gstreamer_child.__file__)))
PACKAGES = "libgstreamer1.0-0, gstreamer1.0-plugins-base and the plugins that its pipeline needs"


class GstreamerDevice(ChildDevice):
    """A ``CameraDevice`` of a pipeline. Its time stamps are those of GStreamer's buffers, on CLOCK_MONOTONIC."""

    _what, _kinds = "its pipeline", (CAPS, IMAGE)

    def __init__(self, camera: CameraDeviceParameters, size: tuple[int, int], command: Sequence[str] = CHILD) -> None:
        """Starts the process: ``command``, with what is asked of the pipeline. Raises CameraError."""
        self._size = size
        self._format: ImageFormat | None = None
        wanted = [*command, caps(size, camera.rate_hz)]
        super().__init__(camera.name, camera.rate_hz, wanted, told=packed_text(camera.place))

    def image_format(self) -> ImageFormat:
        """See ``CameraDevice``."""
        assert self._format is not None
        return self._format

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
        if size != self._size:
            gives, asked = (f"{width}x{height}" for width, height in (size, self._size))
            raise CameraError(
                f"{self._name}: its pipeline gives {gives}, but the rig has {asked}; end it with "
                f"`videoscale ! video/x-raw,width={self._size[0]},height={self._size[1]}`, or correct size_px"
            )

    def _failed(self, reason: str) -> CameraError:
        if reason == gstreamer_child.NOT_INSTALLED:
            return CameraError(f"{self._name}: {reason}; install {PACKAGES}")
        return CameraError(
            f"{self._name}: its pipeline {masked(reason)}; try it with `gst-launch-1.0 PIPELINE ! fakesink`"
        )
