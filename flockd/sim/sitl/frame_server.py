"""Renders and publishes the camera frames of a simulated fleet's daemons, and keeps the truth behind them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Self

from flockd.onboard.sources import FramePublisher
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.sitl.ground_station import Poses


class FrameServer:
    """Renders and publishes frames on a thread of its own between `start` and ``__exit__``."""

    def __init__(
        self,
        cameras: CameraSimulator,
        drones: Sequence[str | None],
        *,
        endpoint: str,
        rate_hz: float,
        poses: Callable[[], Poses],
        clock: Callable[[], float],
        speed_factor: float,
    ) -> None:
        """``drones`` are names in the order of ``poses``; None: without cameras.

        Raises UnavailableError for an endpoint that cannot be used.
        """
        self._cameras = cameras
        self._publisher = FramePublisher(listen=[endpoint])
        self._drones, self._period_s = tuple(drones), 1.0 / rate_hz
        self._poses, self._clock, self._speed_factor = poses, clock, speed_factor
        self._frames: list[Poses] = []
        self._failure: BaseException | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frame server", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._publisher.close()

    def start(self) -> None:
        """Starts the thread that renders and publishes."""
        self._thread.start()

    def frames(self) -> tuple[Poses, ...]:
        """The poses behind all frame sets so far. Raises the exception that ended the thread."""
        if self._failure is not None:
            raise self._failure
        return tuple(self._frames)

    def _run(self) -> None:
        due_s = self._clock()
        try:
            while not self._closing.wait(max(0.0, due_s - self._clock()) / self._speed_factor):
                self._publish(len(self._frames))
                due_s = max(due_s + self._period_s, self._clock())
        except BaseException as error:  # noqa: BLE001 - `frames` raises it in the thread that can handle it
            self._failure = error

    def _publish(self, number: int) -> None:
        poses = self._poses()
        for i, drone in enumerate(self._drones):
            if drone is None:
                continue
            frames = self._cameras.capture(i, number, poses.time_s, poses)()
            for frame in frames.frames.values():
                self._publisher.publish(drone, frame)
        self._frames.append(poses)
