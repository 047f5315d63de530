"""Records one drone's flight on its own thread. The flight never waits for it, and never ends because of it."""

from __future__ import annotations

import json
import platform
import queue
import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, Literal, Self

import cv2
import numpy as np

from flockd import __version__
from flockd.core.config import DroneConfig
from flockd.core.config.drone import RecordingConfig
from flockd.core.config.rig import RigConfig
from flockd.core.messages import FloatArray, Frame, FrameSet, LearnedSize, MissionOrder, PilotOutput, VehicleState
from flockd.core.secrets import masked
from flockd.flight.geometry import build_rig
from flockd.onboard.message_json import to_json
from flockd.onboard.recording import foxglove, streams
from flockd.onboard.recording.mcap_file import Entry, Inclosure, McapFile, Note, RecordingError
from flockd.onboard.recording.reader import flight_number, head_of
from flockd.onboard.recording.truth import Truth

FLUSH_EVERY_S = 0.2
_VERSIONS = {
    "version": __version__,
    "python": platform.python_version(),
    "numpy": np.__version__,
    "opencv": cv2.__version__,
    "machine": f"{platform.system()} {platform.machine()}",
}
_MB = 1e6
_SMALL_BYTES = 4096
"""Size in the queue of an entry without image."""
_FREE_SHARE = 0.05
"""Share of a small disk that stays free; of a large one `queue_mb` stay free."""


class Recorder:
    """Writes the file of one flight.

    `step` and `publish` return at once, whatever the disk does. Entries that do not fit into the queue are dropped,
    counted and reported once; a failed or full disk ends only the recording. Times are those of the messages.
    """

    def __init__(
        self,
        path: Path,
        *,
        drone: str,
        config: DroneConfig,
        settings: RecordingConfig | None = None,
        models: Mapping[str, str] | None = None,
        facts: Mapping[str, str] | None = None,
        learned: LearnedSize | None = None,
        on_event: Callable[[str], None] = lambda event: None,
    ) -> None:
        """Begins a new recording.

        Args:
            path: the file; its folder must exist. If there is one already, as clocks begin anew, a number is added.
            drone: its name.
            config: the flight's configuration; stored in each file.
            settings: how to record; by default as the configuration says.
            models: SHA-256 of each model in use, by name.
            facts: additional facts about the flight, stored in its note.
            learned: the others' size with which its pilot began.
            on_event: called on the recorder's thread or the caller's, with one sentence about a failure.
        """
        self._settings = settings or config.recording
        self._drone = drone
        self._on_event = on_event
        began = datetime.now(UTC).isoformat(timespec="seconds")
        flight = {"drone": drone, "began": began, "images": self._settings.images, **_VERSIONS, **(facts or {})}
        if learned is not None:
            flight[streams.LEARNED_SIZE] = json.dumps(to_json(learned))
        shown = masked(config.model_dump(mode="json"))  # recordings are passed on, and replay needs no passwords
        head = (
            Note(streams.MODELS_NOTE, models or {}),
            Inclosure(
                streams.CONFIGURATION, "application/json", json.dumps(shown, indent=1, ensure_ascii=False).encode()
            ),
        )
        self._file = _File(path, flight, head, config.rig, self._settings, self._tell)
        self._rig, self._north_east = build_rig(config.rig), np.zeros(2)
        self._placed_s: float | None = None
        self._queue: queue.SimpleQueue[tuple[int, Callable[[], None]] | None] = queue.SimpleQueue()
        """Size of an entry, and the function that writes it; None at the end."""
        self._lock = threading.Condition()
        self._held_bytes = 0
        self._steps = 0
        self.lost = 0
        """Steps and messages dropped."""
        self._told_full = False
        self._closed = False
        self.failure: str | None = None
        """Why the recording ended before the flight; None: it did not."""
        self._time_s: float | None = None
        self._thread = threading.Thread(target=self._write_all, name=f"recorder {drone}", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """The file that is written."""
        return self._file.path

    def step(
        self,
        frames: FrameSet,
        vehicle: VehicleState,
        output: PilotOutput,
        truth: Truth | None = None,
        order: MissionOrder | None = None,
    ) -> None:
        """Takes one step of the pilot: its inputs, its output, and all telemetry that follows from them.

        A simulator adds the ``truth``, which no pilot knows. ``order``: the operator's order that the step took.
        """
        number, self._steps = self._steps, self._steps + 1
        size = sum(frame.image.nbytes for frame in frames.frames.values())
        self._put(size + _SMALL_BYTES, lambda: self._write_step(number, frames, vehicle, output, truth, order))

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """Takes one telemetry message, if the table of topics marks it as recorded; a `TelemetrySink`.

        Only for messages that do not follow from a step, such as events: the others are written with the step.
        """
        if drone == self._drone and topic in streams.TABLE:
            self._put(_SMALL_BYTES, lambda: self._write_message(topic, message))

    def drain(self) -> None:
        """Waits until all is written: only for callers whose time stands still meanwhile, such as a simulator."""
        with self._lock:
            self._lock.wait_for(lambda: self._held_bytes == 0 or self.failure is not None)

    def close(self, timeout_s: float = 30.0) -> None:
        """Writes the rest and closes the file. Entries not written in time are lost and reported."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._on_event(f"recording {self._file.path}: the disk was too slow to end it; it can be read up to there")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, size: int, write: Callable[[], None]) -> None:
        with self._lock:
            fits = self._held_bytes == 0 or self._held_bytes + size <= self._settings.queue_mb * _MB
            if self._closed or self.failure is not None or not fits:
                self.lost += 1
                news = not fits and not self._told_full
                self._told_full = self._told_full or not fits
            else:
                self._held_bytes += size
                self._queue.put((size, write))
                news = False
        if news:
            self._tell("recording: the disk is too slow, so that steps are dropped; record smaller or fewer images")

    def _tell(self, event: str) -> None:
        """Records an event, once a step has given the time, and reports it to subscribers."""
        with self._lock:
            self._held_bytes += _SMALL_BYTES
            self._queue.put((_SMALL_BYTES, lambda: self._write_message("events", {"event": event})))
        self._on_event(event)

    def _write_all(self) -> None:
        """Runs on the recorder's thread."""
        try:
            self._write_queue()
            self._file.finish({"steps": str(self._steps), "lost": str(self.lost)})
        except OSError as error:
            self._fail((error.strerror or str(error)).lower())
        except Exception as error:  # noqa: BLE001 - no error of the recorder may end a flight, or stay hidden
            self._fail(repr(error))

    def _fail(self, reason: str) -> None:
        sentence = f"recording {self._file.path}: {reason}; the recording ends here and the flight goes on"
        with self._lock:
            self.failure = sentence
            self._held_bytes = 0
            while not self._queue.empty():  # the thread that would write these has failed
                self.lost += self._queue.get() is not None
            self._lock.notify_all()
        self._file.abandon()
        self._on_event(sentence)

    def _write_queue(self) -> None:
        self._file.begin()
        flushed_s = time.monotonic()
        closing = unflushed = False
        while not (closing and self._queue.empty()):  # events while closing are recorded too
            size = 0
            with suppress(queue.Empty):
                item = self._queue.get(timeout=FLUSH_EVERY_S)
                closing = closing or item is None
                if item is not None:
                    size, write = item
                    write()
                    unflushed = True
                    del item, write  # or the last frames would stay in memory until the next entry
            if unflushed and (size == 0 or time.monotonic() - flushed_s >= FLUSH_EVERY_S):
                self._file.flush()
                flushed_s, unflushed = time.monotonic(), False
            with self._lock:
                self._held_bytes -= size
                if self._held_bytes == 0:
                    self._lock.notify_all()

    def _write_step(
        self,
        number: int,
        frames: FrameSet,
        vehicle: VehicleState,
        output: PilotOutput,
        truth: Truth | None,
        order: MissionOrder | None,
    ) -> None:
        """Writes all messages of a step; its output comes last, so a step with an output is complete."""
        time_s = self._time_s = frames.time_s
        kept = []
        for camera, frame in frames.frames.items():
            data = _compressed(frame, self._settings)
            if data is None:
                self._tell(
                    f"recording: an image of camera {camera} has no pixels or not three channels and is left out"
                )
                continue
            kept.append(streams.FrameEntry(camera, frame.time_s, frame.sequence))
            stamp = streams.nanoseconds(frame.time_s)
            message = foxglove.image(stamp, camera, data, self._settings.images)
            self._file.write(Entry(foxglove.image_stream(camera), stamp, number, message))
        written = {streams.FRAMES: streams.StepFrames(number, time_s, tuple(kept)), streams.VEHICLE: vehicle}
        written |= {} if order is None else {streams.ORDER: order}
        for stream, of_step in written.items():
            self._file.write(_json_entry(stream, time_s, number, of_step))
        for entry in self._places(number, time_s, vehicle, output.velocity):
            self._file.write(entry)
        if truth is not None:
            self._file.write(_json_entry(streams.TRUTH, time_s, number, truth))
        self._file.write(_json_entry(streams.OUTPUT, time_s, number, output))
        for reason in output.reasons:
            self._file.write(_log_entry(time_s, "WARNING", reason.text))

    def _places(
        self, number: int, time_s: float, vehicle: VehicleState, velocity: FloatArray | None
    ) -> Iterator[Entry]:
        """Transforms of all frames, and the own path, for viewers: from the first step on, height by the autopilot."""
        if velocity is not None and self._placed_s is not None:
            self._north_east = self._north_east + velocity[:2] * (time_s - self._placed_s)
        self._placed_s = time_s
        position, stamp = np.array([*self._north_east, -vehicle.height_m]), streams.nanoseconds(time_s)
        places = foxglove.transforms(stamp, position, vehicle.R_ned_body, self._rig)
        yield Entry(foxglove.TRANSFORMS, stamp, number, places)
        if velocity is not None:
            path = foxglove.odometry(stamp, position, vehicle.R_ned_body, velocity)
            yield Entry(foxglove.ODOMETRY, stamp, number, path)

    def _write_message(self, topic: str, message: Mapping[str, object]) -> None:
        stamp = message.get("time_s", self._time_s)  # the recorder's own events have none
        if not isinstance(stamp, int | float):
            return
        time_s = float(stamp)
        self._file.write(_json_entry(streams.TABLE[topic], time_s, 0, {"time_s": time_s, **message}))
        if topic == "events":
            self._file.write(_log_entry(time_s, "INFO", str(message.get("event", ""))))


class _File:
    """The file of one recording: it begins with everything needed to understand it."""

    def __init__(
        self,
        path: Path,
        flight: Mapping[str, str],
        head: Sequence[Note | Inclosure],
        rig: RigConfig,
        settings: RecordingConfig,
        tell: Callable[[str], None],
    ) -> None:
        self.path, self._flight, self._head, self._rig, self._tell = path, flight, head, rig, tell
        self._quota_mb, self._queue_mb = settings.quota_mb, settings.queue_mb
        self._file: McapFile | None = None
        self._earlier: dict[Path, int] = {}
        """Sizes in bytes of recordings that may be deleted, the oldest first."""
        self._before: Path | None = None
        """The flight before this one, which may need study: deleted last, and only for free space."""
        self._calibrated = False

    def begin(self) -> None:
        """Starts the file."""
        number = self._count_earlier()
        self._make_room(0)
        wanted, copies = self.path, count(2)
        while self._file is None:
            try:
                self._file = McapFile(self.path)
            except FileExistsError:
                self.path = wanted.with_stem(f"{wanted.stem}-{next(copies)}")
        if self.path != wanted:
            self._tell(f"recording: {wanted} exists, so that the recording is {self.path}")
        facts = {"format": streams.FORMAT, "recording": uuid.uuid4().hex, streams.FLIGHT_NUMBER: str(number)}
        self._file.write(Note(streams.FLIGHT_NOTE, {**facts, **self._flight}))
        for record in self._head:
            self._file.write(record)
        self.flush()

    def write(self, entry: Entry) -> None:
        """Adds a message; before the first one, the cameras' calibrations."""
        assert self._file is not None
        if not self._calibrated:
            self._calibrated = True
            for camera in self._rig.cameras:
                message = foxglove.calibration(entry.time_ns, camera)
                self._file.write(Entry(foxglove.calibration_stream(camera.name), entry.time_ns, 0, message))
        self._file.write(entry)

    def flush(self) -> None:
        """Makes written data safe, and deletes earlier recordings beyond the quota. Raises OSError."""
        assert self._file is not None
        self._file.flush()
        self._make_room(self._file.size)

    def _make_room(self, size: int) -> None:
        """Deletes the oldest recordings while they and ``size`` bytes exceed the quota, or the disk is full."""
        while size + sum(self._earlier.values()) > self._quota_mb * _MB:
            if not self._earlier:
                raise OSError("recording.quota_mb is reached")
            self._delete(next(iter(self._earlier)), f"all recordings may take {self._quota_mb:g} MB")
        while self._earlier or self._before is not None:
            disk = shutil.disk_usage(self.path.parent)
            if disk.free >= min(self._queue_mb * _MB, _FREE_SHARE * disk.total):
                break
            self._delete(next(iter(self._earlier), self._before), "the disk is full")

    def _delete(self, path: Path | None, why: str) -> None:
        assert path is not None
        if self._earlier.pop(path, None) is None:
            self._before = None
        path.unlink(missing_ok=True)
        self._tell(f"recording: {path} was deleted, as {why}")

    def finish(self, end: Mapping[str, str]) -> None:
        """Closes the file."""
        assert self._file is not None
        self._file.write(Note(streams.END_NOTE, end))
        self._file.finish()

    def abandon(self) -> None:
        """Leaves the file as it is."""
        if self._file is not None:
            self._file.abandon()

    def _count_earlier(self) -> int:
        """Lists this drone's recordings, and returns this flight's number: file times may come from a wrong clock.
        Replays by people are kept and do not count."""
        found = [path for path in self.path.parent.glob("*.mcap") if path != self.path]
        numbers = {path: number for path in found if (number := self._number_of(path)) is not None}
        order = sorted(numbers, key=lambda path: (numbers[path], path.stat().st_mtime))
        self._earlier = {path: path.stat().st_size for path in order[:-1]}
        self._before = order[-1] if order else None
        return max(numbers.values(), default=0) + 1

    def _number_of(self, path: Path) -> int | None:
        """Number of a flight that this drone's recorder wrote; unreadable files are reported."""
        try:
            facts = head_of(path)[0].facts if path.is_file() else None  # opening a pipe would wait for ever
            why = "is not a file"
        except (RecordingError, OSError) as error:
            facts, why = None, str(error).removeprefix(f"{path}: ")
        if facts is None:
            self._tell(f"recording: {path} was skipped and does not count for the quota: it {why}")
            return None
        is_ours = facts.get("drone") == self._flight["drone"] and not facts.keys() & streams.EDITED
        return flight_number(facts) if is_ours else None


def _compressed(frame: Frame, settings: RecordingConfig) -> bytes | None:
    if frame.image.ndim != 3 or frame.image.shape[2] != 3 or frame.image.size == 0:
        return None
    bgr = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # higher levels take several times longer for a few per cent
    if settings.images == "jpeg":
        options = [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality]
    return bytes(cv2.imencode(f".{settings.images}", bgr, options)[1])


def _json_entry(stream: Any, time_s: float, sequence: int, message: object) -> Entry:
    return Entry(stream, streams.nanoseconds(time_s), sequence, json.dumps(to_json(message), allow_nan=False).encode())


def _log_entry(time_s: float, level: Literal["INFO", "WARNING"], text: str) -> Entry:
    stamp = streams.nanoseconds(time_s)
    return Entry(foxglove.LOG, stamp, 0, foxglove.log(stamp, level, text))
