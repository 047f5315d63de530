"""Where camera frames come from: devices of this computer, GStreamer pipelines, or another program's shared memory."""

import time
from collections.abc import Callable

from flockd.core.config import DroneConfig
from flockd.core.errors import ConfigError, ConfigProblem
from flockd.onboard.sources.clock import clock_at
from flockd.onboard.sources.frames import CameraStatus, Count, FrameSource
from flockd.onboard.sources.gstreamer import GstreamerSource
from flockd.onboard.sources.shared_memory import FramePublisher, SharedMemorySource
from flockd.onboard.sources.v4l2 import V4l2Source

__all__ = ["CameraStatus", "Count", "FramePublisher", "FrameSource", "clock_at", "open_source"]


def open_source(config: DroneConfig, file: str, *, clock: Callable[[], float] = time.monotonic) -> FrameSource:
    """The source that a drone's configuration asks for, not started yet; ``file`` is named in errors.

    ``clock`` is that of shared memory: frames of devices have the kernel's.

    Raises ConfigError if it asks for none.
    """
    if config.source is None:
        raise ConfigError([ConfigProblem(file, 0, "source", "is missing; add one, as in config/quadrotor.yaml")])
    if config.source.kind == "v4l2":
        return V4l2Source(config, config.source)
    if config.source.kind == "gstreamer":
        return GstreamerSource(config, config.source)
    return SharedMemorySource(config, config.source, clock=clock)
