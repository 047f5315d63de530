"""Everything the daemon tells, to whoever is there to take it: watchers, the recording of the flight, and the log."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from flockd.config import DroneConfig
from flockd.daemon.worker import BusyError, Worker
from flockd.messages import FrameSet, PilotOutput, VehicleState
from flockd.recording import Recorder
from flockd.telemetry import TelemetrySink, publish_step
from flockd.telemetry.topics import EventMessage

BACKLOG = 100
CLOSE_S = 5.0

_log = logging.getLogger(__name__)


class Chronicle:
    """Nothing here waits, and nothing that goes wrong here ends a flight. `event` and `publish` are for any thread."""

    def __init__(
        self,
        config: DroneConfig,
        telemetry: TelemetrySink,
        models: Mapping[str, str],
        folder: Path | None,
        clock: Callable[[], float],
    ) -> None:
        """``folder``: where flights are recorded; None: nowhere. ``models``: SHA-256 of each, by name."""
        self._config, self._telemetry, self._models = config, telemetry, models
        self._folder, self._clock = folder, clock
        self._worker = Worker("telemetry", BACKLOG)
        self._recorder: Recorder | None = None
        self._path: Path | None = None
        self.lost = 0
        """Messages that nobody could take in time."""

    def event(self, sentence: str) -> None:
        """Something that happened once."""
        _log.info("%s", sentence)
        self.publish("events", EventMessage(time_s=self._clock(), event=sentence))

    def publish(self, topic: str, message: Mapping[str, object]) -> None:
        """One message; see `flockd.telemetry.TOPICS`."""
        self._hand_over(self._telemetry.publish, self._config.name, topic, message)
        if self._recorder is not None:
            self._recorder.publish(self._config.name, topic, message)

    def step(self, frames: FrameSet, vehicle: VehicleState, output: PilotOutput) -> None:
        """One step of the pilot, to watchers and into the recording."""
        self._hand_over(publish_step, self._telemetry, self._config.name, vehicle, output)
        if self._recorder is not None:
            self._recorder.step(frames, vehicle, output)

    @property
    def recording(self) -> str | None:
        """The file, or why its recording ended; None where nothing is being recorded."""
        if self._recorder is None:
            return None
        return self._recorder.failure or str(self._path)

    def begin_recording(self) -> None:
        """A flight begins: a new file, where flights are recorded."""
        if self._folder is None:
            return
        self.end_recording()
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%fZ")
        self._path = self._folder / f"{self._config.name}-{stamp}.mcap"
        self._recorder = Recorder(
            self._path, drone=self._config.name, config=self._config, models=self._models, on_event=self._of_recorder
        )
        self.event(f"recording to {self._path}")

    def end_recording(self) -> None:
        """The flight is over; the file is ended in the background."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            self._hand_over(recorder.close, CLOSE_S)

    async def close(self) -> None:
        """Ends the recording, and waits until all is written or it takes too long. Raises LateError."""
        self.end_recording()
        await self._worker.do(CLOSE_S + 1.0, lambda: None)
        self._worker.leave()

    def _of_recorder(self, sentence: str) -> None:
        """Already in the recording, if that still can be."""
        _log.warning("%s", sentence)
        message = EventMessage(time_s=self._clock(), event=sentence)
        self._hand_over(self._telemetry.publish, self._config.name, "events", message)

    def _hand_over(self, job: Callable[..., None], *arguments: object) -> None:
        try:
            self._worker.submit(job, *arguments)
        except BusyError:
            self.lost += 1
