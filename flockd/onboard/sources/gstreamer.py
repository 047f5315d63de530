"""Cameras that GStreamer drives: those on the CSI ports of a Jetson or a Raspberry Pi, network cameras, files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from flockd.core.config.drone import DroneConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.sources.device_source import DeviceSource
from flockd.onboard.sources.gstreamer_device import CHILD, GstreamerDevice


class GstreamerSource(DeviceSource):
    """A ``FrameSource`` of pipelines, a process each."""

    def __init__(
        self,
        config: DroneConfig,
        parameters: SourceParameters,
        *,
        command: Sequence[str] = CHILD,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``command`` runs one pipeline."""
        super().__init__(config, parameters, lambda camera, size: open_pipeline(camera, size, command), clock=clock)


def open_pipeline(
    camera: CameraDeviceParameters, size: tuple[int, int], command: Sequence[str] = CHILD
) -> GstreamerDevice:
    """The camera's pipeline, started. Raises CameraError."""
    return GstreamerDevice(camera.name, camera.pipeline, size=size, rate_hz=camera.rate_hz, command=command)
