"""A source of devices that a test watches; the fixture `watch` of `conftest.py` starts and stops it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.messages import FrameSet
from flockd.onboard.sources import CameraStatus
from flockd.onboard.sources.device_source import Devices, DeviceSource
from tests.calm import until

WAIT_S = 60.0


class WatchedSource(DeviceSource):
    """With what tests wait for; the first camera unless told otherwise."""

    def __init__(
        self,
        sizes: Mapping[str, tuple[int, int]],
        cameras: tuple[CameraDeviceParameters, ...],
        devices: Devices,
        silence_s: float = WAIT_S,
    ) -> None:
        kind: Any = "v4l2" if cameras[0].device else "gstreamer" if cameras[0].pipeline else "ros"
        parameters = SourceParameters(kind=kind, cameras=cameras, silence_s=silence_s, set_tolerance_s=5.0)
        super().__init__(sizes, parameters, devices)
        self._first = cameras[0].name

    def one(self, camera: str | None = None) -> CameraStatus:
        """How a camera is doing."""
        return self.status()[camera or self._first]

    def until(self, holds: Callable[[CameraStatus], object], camera: str | None = None) -> CameraStatus:
        """Its status as soon as that holds."""
        found: CameraStatus = until(lambda: status if holds(status := self.one(camera)) else None, WAIT_S)
        return found

    def why(self) -> str:
        """Why no frames come, as soon as that is known."""
        return str(self.until(lambda status: status.fault is not None).fault)

    def received(self, **counts: int) -> None:
        """Waits until so many frames of each camera have come."""
        for camera, count in counts.items():
            self.until(lambda status, count=count: status.counts.get("received", 0) >= count, camera)  # type: ignore[misc]

    def next(self) -> FrameSet:
        """The next set."""
        frames = self.newest(WAIT_S)
        assert frames is not None
        return frames


Watch = Callable[..., WatchedSource]
"""Starts a `WatchedSource` of these arguments, which ends with the test."""
