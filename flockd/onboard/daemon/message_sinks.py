"""Sends every message of the daemon to telemetry, the recording of the flight, and the log."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.messages import FrameSet, LearnedSize, MissionOrder, PilotOutput, VehicleState
from flockd.core.printable import printable
from flockd.onboard.recording import Recorder
from flockd.onboard.telemetry import TelemetrySink, publish_step
from flockd.onboard.telemetry.topics import EventMessage
from flockd.onboard.worker import BusyError, Worker

BACKLOG = 100
CLOSE_S = 5.0

_log = logging.getLogger(__name__)


class MessageSinks:
    """Only `close` waits, and no error here ends a flight. `event` and `publish` may be called on any thread."""

    def __init__(
        self,
        config: DroneConfig,
        telemetry: TelemetrySink,
        models: Mapping[str, str],
        folder: Path | None,
        clock: Callable[[], float],
    ) -> None:
        """``folder``: for recordings of flights; None: no recording. ``models``: SHA-256 of each, by name."""
        self._config, self._telemetry, self._models = config, telemetry, models
        self._folder, self._clock = folder, clock
        self._worker = Worker("telemetry", BACKLOG)
        self._closing = Worker("recordings", BACKLOG)
        """A slow disk takes long to close a file; telemetry goes on meanwhile."""
        self._recorder: Recorder | None = None
        self.lost = 0
        """Messages dropped because the worker was busy."""

    def event(self, sentence: str) -> None:
        """Logs and publishes one event."""
        _log.info("%s", sentence)
        self.publish("events", EventMessage(time_s=self._clock(), event=sentence))

    def publish(self, topic: str, message: Mapping[str, object]) -> None:
        """Publishes one message; see `flockd.onboard.telemetry.TOPICS`."""
        self._submit(self._telemetry.publish, self._config.name, topic, message)
        if (recorder := self._recorder) is not None:  # the event loop may end it meanwhile
            recorder.publish(self._config.name, topic, message)

    def step(self, frames: FrameSet, vehicle: VehicleState, output: PilotOutput, order: MissionOrder | None) -> None:
        """Publishes and records one step of the pilot."""
        self._submit(publish_step, self._telemetry, self._config.name, vehicle, output)
        if self._recorder is not None:
            self._recorder.step(frames, vehicle, output, order=order)

    @property
    def recording(self) -> str | None:
        """The recording's file, or why it ended; None: not recording."""
        if self._recorder is None:
            return None
        return self._recorder.failure or str(self._recorder.path)

    def begin_recording(self, learned: LearnedSize | None = None) -> None:
        """Begins a file for a flight, if flights are recorded; ``learned``: the size that its pilot begins with."""
        if self._folder is None:
            return
        self.end_recording()
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%fZ")
        path = self._folder / f"{self._config.name}-{stamp}.mcap"
        self._recorder = Recorder(
            path,
            drone=self._config.name,
            config=self._config,
            models=self._models,
            learned=learned,
            on_event=self._on_event,
        )
        self.event(f"recording to {path}")

    def end_recording(self) -> None:
        """Ends the file in the background."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            self._closing.submit(recorder.close, CLOSE_S)

    async def close(self) -> None:
        """Ends the recording, and waits until all is written. Raises LateError if that takes too long."""
        self.end_recording()
        for worker in (self._closing, self._worker):
            await worker.do(CLOSE_S + 1.0, lambda: None)
            worker.leave()

    def _on_event(self, sentence: str) -> None:
        """For the recorder's own events, which it has recorded itself if it can."""
        _log.warning("%s", sentence)
        message = EventMessage(time_s=self._clock(), event=sentence)
        self._submit(self._telemetry.publish, self._config.name, "events", message)

    def _submit(self, job: Callable[..., None], *arguments: object) -> None:
        try:
            self._worker.submit(job, *arguments)
        except BusyError:
            self.lost += 1


MOST_LINES = 1000
"""Lines that may wait to be written."""
LAST_LINES_S = 1.0
"""Time at the end to write the remaining lines."""
STDERR = 2


class StderrLog(logging.Handler):
    """Writes log lines from a separate thread; while too many wait, further lines are lost and counted.

    A write to a full pipe, a hanging journal or a busy disk may take any time. Control characters in texts of the
    autopilot and of operators are replaced.
    """

    def __init__(self, descriptor: int = STDERR) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._worker = Worker("log", MOST_LINES)
        self._lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Queues one line, from any thread; does not wait."""
        lost = f"({self._lost} lines were lost: nobody read them)\n" if self._lost else ""
        try:
            self._worker.submit(self._write, f"{lost}{printable(self.format(record))}\n")
        except BusyError:
            self._lost += 1
        else:
            self._lost = 0

    def close(self) -> None:
        """Waits a moment for the remaining lines."""
        self._worker.leave(LAST_LINES_S)
        super().close()

    def _write(self, text: str) -> None:
        # Not with sys.stderr: the process would wait for its lock at exit.
        data = text.encode("utf-8", "backslashreplace")
        while data:
            data = data[os.write(self._descriptor, data) :]
