"""Sources of camera frames: devices of this computer, GStreamer pipelines, ROS 2, or shared memory."""

import time
from collections.abc import Callable

from flockd.core.config import DroneConfig
from flockd.core.errors import ConfigError
from flockd.onboard.sources.device_source import Devices, DeviceSource
from flockd.onboard.sources.frames import CameraStatus, Count, FrameSource
from flockd.onboard.sources.shared_memory import FramePublisher, SharedMemorySource

__all__ = ["CameraStatus", "Count", "FramePublisher", "FrameSource", "open_source"]


def open_source(config: DroneConfig, file: str, *, clock: Callable[[], float] = time.monotonic) -> FrameSource:
    """The source that a drone's configuration names, not started yet.

    ``file`` is named in errors. ``clock`` is used for shared memory only: frames of devices have the kernel's times.
    Raises ConfigError if the configuration has no section `source`.
    """
    if config.source is None:
        raise ConfigError.at(file, "is missing; add one, as in config/quadrotor.yaml", "source")
    sizes = {camera.name: camera.size_px for camera in config.rig.cameras}
    if config.source.kind == "shared_memory":
        return SharedMemorySource(sizes, config.source, clock)
    lenses = {camera.name: camera.intrinsics for camera in config.rig.cameras}
    return DeviceSource(sizes, config.source, Devices(lenses=lenses))
