"""USB cameras and whatever else the kernel shows as /dev/video*, with its time stamps and sequence numbers."""

from __future__ import annotations

import time
from collections.abc import Callable

from flockd.core.config.drone import DroneConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.sources.device_source import DeviceSource
from flockd.onboard.sources.v4l2_device import V4l2Device
from flockd.onboard.sources.v4l2_kernel import Kernel, LinuxKernel


class V4l2Source(DeviceSource):
    """A ``FrameSource`` of V4L2 cameras."""

    def __init__(
        self,
        config: DroneConfig,
        parameters: SourceParameters,
        *,
        kernel: Kernel | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``clock`` is that of the kernel's time stamps."""
        calls = kernel or LinuxKernel()
        super().__init__(config, parameters, lambda camera, size: open_v4l2(camera, size, calls), clock=clock)


def open_v4l2(camera: CameraDeviceParameters, size: tuple[int, int], kernel: Kernel) -> V4l2Device:
    """The camera, set up as configured. Raises CameraError."""
    return V4l2Device(
        camera.name,
        camera.place,
        size=size,
        pixel_format=camera.pixel_format,
        rate_hz=camera.rate_hz,
        controls=camera.controls,
        kernel=kernel,
    )
