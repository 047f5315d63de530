"""Where camera frames come from: devices of this computer, or another program's shared memory."""

from flockd.config import DroneConfig
from flockd.errors import ConfigError, ConfigProblem
from flockd.sources.frames import CameraStatus, Count, FrameSource
from flockd.sources.shared_memory import FramePublisher, SharedMemorySource
from flockd.sources.v4l2 import V4l2Source

__all__ = ["CameraStatus", "Count", "FramePublisher", "FrameSource", "open_source"]


def open_source(config: DroneConfig, file: str) -> FrameSource:
    """The source that a drone's configuration asks for, not started yet; ``file`` is named in errors.

    Raises ConfigError if it asks for none.
    """
    if config.source is None:
        raise ConfigError([ConfigProblem(file, 0, "source", "is missing; add it with kind `v4l2` or `shared_memory`")])
    if config.source.kind == "v4l2":
        return V4l2Source(config, config.source)
    return SharedMemorySource(config, config.source)
