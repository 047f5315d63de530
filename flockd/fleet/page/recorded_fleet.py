"""A whole fleet's recordings on one time line."""

from __future__ import annotations

import functools
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from flockd.core.config.rig import RigConfig
from flockd.core.messages import Detection, Frame, PilotOutput, VehicleState
from flockd.fleet.drone_rows import Known, Row, drone_rows, history_row
from flockd.fleet.fleet_source import Event
from flockd.fleet.watcher import Heard, Watched
from flockd.flight.geometry import build_rig
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.foxglove import image_stream
from flockd.onboard.recording.mcap_file import Entry, read_records
from flockd.onboard.recording.reader import Recording, decoded_image, head_of
from flockd.onboard.recording.streams import OUTPUT, TABLE, VEHICLE
from flockd.onboard.telemetry import TOPICS, publish_step
from flockd.onboard.telemetry.preview import EVERY_S, preview
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage

ONE_CLOCK_S = 5.0
"""Clocks that began within this of each other, by the wall clock, are one: of a simulation, or of one computer."""
HISTORY_EVERY_S = 0.5
_OWN = {TABLE[topic].topic: topic for topic in ("flight", "computer", "events")}
"""What does not follow from a step, by its stream."""


@dataclass
class _Story:
    """One drone's messages in order of time, on its own clock."""

    fleet: str
    drone: str
    began_s: float
    """Wall time at which the recording began."""
    about: AboutMessage
    pictures: RecordedPictures
    times: dict[str, list[float]] = field(default_factory=dict)
    messages: dict[str, list[Mapping[str, Any]]] = field(default_factory=dict)
    offset_s: float = 0.0
    """Added to its times, they are on the time line."""

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """A telemetry sink."""
        times = self.times.setdefault(topic, [])
        stamp = message["time_s"]
        assert isinstance(stamp, int | float)
        times.append(max(float(stamp), times[-1]) if times else float(stamp))
        self.messages.setdefault(topic, []).append(message)

    @property
    def span_s(self) -> tuple[float, float]:
        """Begin and end of its steps, on the time line."""
        return self.times["state"][0] + self.offset_s, self.times["state"][-1] + self.offset_s

    def at(self, time_s: float) -> Watched:
        """What a watcher would have heard by then, on the time line."""
        own_s = time_s - self.offset_s
        topics = {}
        for topic, times in self.times.items():
            index = bisect_right(times, own_s) - 1
            if index >= 0:
                period_s = (times[index] - times[index - 5]) / 5 if index >= 5 else None
                heard_s = times[index] + self.offset_s
                topics[topic] = Heard(heard_s, self.messages[topic][index], 1.0, period_s, heard_s)
        begin_s, end_s = self.span_s
        alive = time_s <= end_s + self.about_step_s()
        return Watched(self.fleet, self.drone, alive=alive, topics=topics, seen=time_s >= begin_s, announced=True)

    def about_step_s(self) -> float:
        """Two steps: the last one's messages are good until then."""
        return 2.0 * float(str(self.about["configuration"]["step_s"]))


class RecordedFleet:
    """A `FleetSource`: nothing can be asked of it."""

    def __init__(self, folder: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Reads every recording of a folder. Raises RecordingError where there is none, or a damaged one.

        ``progress`` is called with (bytes read, bytes in all).
        """
        paths = [path for path in sorted(folder.glob("*.mcap")) if head_of(path)[0].facts.get("part", "0") == "0"]
        if not paths:
            raise RecordingError(f"{folder}: holds no recording; name a folder with the recordings of a fleet")
        sizes = [path.stat().st_size for path in paths]
        stories: list[_Story] = []
        for number, path in enumerate(paths):
            stories.append(_story(path, functools.partial(_tell, progress, sum(sizes[:number]), sum(sizes))))
        _align(stories)
        self._stories = {f"{story.fleet}/{story.drone}": story for story in stories}
        if len(self._stories) < len(stories):
            raise RecordingError(f"{folder}: holds several recordings of one drone; leave one of each in the folder")
        self._wall_s = min(story.began_s - story.span_s[0] for story in stories)
        self.span_s = min(story.span_s[0] for story in stories), max(story.span_s[1] for story in stories)
        self._known = {key: Known(story.about) for key, story in self._stories.items()}
        self._events = sorted(
            (time_s + story.offset_s, key, str(message["event"]))
            for key, story in self._stories.items()
            for time_s, message in zip(story.times.get("events", ()), story.messages.get("events", ()), strict=True)
        )

    def now_s(self) -> float:
        """See `FleetSource`; so all that follow."""
        return self.span_s[1]

    def wall_s(self, time_s: float) -> float:
        """By the clock of the computer whose recording began first."""
        return self._wall_s + time_s

    def drones(self, time_s: float) -> tuple[Watched, ...]:
        """Those whose recordings have begun by then."""
        watched = [story.at(time_s) for story in self._stories.values()]
        return tuple(drone for drone in watched if drone.seen)

    def known(self) -> Mapping[str, Known]:
        """As their recordings tell."""
        return self._known

    def rows(self, time_s: float) -> dict[str, Row]:
        """As if it were then."""
        rows = drone_rows(self.drones(time_s), self._known, time_s)
        for key, row in rows.items():
            row["cameras"] = row["cameras"] or dict.fromkeys(self._stories[key].pictures.cameras)
        return rows

    def events(self, time_s: float) -> list[Event]:
        """Up to then."""
        return self._events[: bisect_right(self._events, time_s, key=lambda event: event[0])]

    def history(self) -> Mapping[str, list[list[float | None]]]:
        """The history of all drones."""
        return self._history

    @functools.cached_property
    def _history(self) -> dict[str, list[list[float | None]]]:
        history: dict[str, list[list[float | None]]] = {}
        time_s, end_s = self.span_s
        while time_s <= end_s:
            for key, row in self.rows(time_s).items():
                if row["state"] != "gone":
                    history.setdefault(key, []).append(history_row(row, time_s))
            time_s += HISTORY_EVERY_S
        return history

    def notes(self) -> list[str]:
        """None."""
        return []

    def ask(self, drone: str, command: str, order: Mapping[str, object] | None, operator: str) -> AnswerMessage:
        """Refused."""
        return AnswerMessage(accepted=False, sentence="this is a recording, which takes no commands")

    def image(self, drone: str, camera: str, time_s: float) -> bytes | None:
        """The newest picture of the second before."""
        story = self._stories.get(drone)
        return None if story is None else story.pictures.at(camera, time_s - story.offset_s)


def _story(path: Path, progress: Callable[[int], None]) -> _Story:
    recording = Recording(path, lambda done, total: progress(done // 2))
    config, flight = recording.config, recording.contents.flight
    about = AboutMessage(version=flight.get("version", ""), configuration=config.model_dump(mode="json"), commands=[])
    began = flight.get("began")
    began_s = 0.0 if began is None else datetime.fromisoformat(began).timestamp()
    pictures = RecordedPictures(config.rig)
    story = _Story(config.telemetry.fleet, recording.drone, began_s, about, pictures)
    done, taking = 0, _Taking(story, (camera.name for camera in config.rig.cameras))
    for part in recording.contents.paths:
        for record in read_records(part):
            if not isinstance(record, Entry):
                continue
            done += len(record.data)
            progress(path.stat().st_size // 2 + done // 2)
            try:
                taking.take(record)
            except (ValueError, KeyError) as error:
                raise RecordingError(
                    f"{part}: a message cannot be read ({error}); `flockd record recover` makes a recording without it"
                ) from error
    if "state" not in story.times:
        raise RecordingError(f"{path}: holds no whole step; take it out of the folder")
    return story


class _Taking:
    """Turns the entries of a recording, in order, into messages of its drone."""

    def __init__(self, story: _Story, cameras: Iterable[str]) -> None:
        self._story = story
        self._vehicle: VehicleState | None = None
        self._images = {image_stream(camera).topic: camera for camera in cameras}

    def take(self, entry: Entry) -> None:
        """Raises ValueError and KeyError for what is no message of its stream."""
        topic, story = entry.stream.topic, self._story
        if topic == VEHICLE.topic:
            self._vehicle = from_json(VehicleState, parsed(entry.data))
        elif topic in self._images:
            story.pictures.take_image(self._images[topic], entry.data)
        elif topic == OUTPUT.topic and self._vehicle is not None:
            output: PilotOutput = from_json(PilotOutput, parsed(entry.data))
            publish_step(story, story.drone, self._vehicle, output)
            story.pictures.take_step(output.time_s, output.detections)
        elif topic in _OWN:
            message = parsed(entry.data)
            with suppress(ValueError):  # of another version, or damaged
                story.publish(story.drone, _OWN[topic], from_json(TOPICS[_OWN[topic]].type, message))


def _tell(progress: Callable[[int, int], None], before: int, total: int, done: int) -> None:
    """Progress in one file of several."""
    progress(min(before + done, total), total)


def _align(stories: list[_Story]) -> None:
    """Puts all on one time line: their own clock where all have one, else wall time, which is written to the second."""
    apart_s = [story.began_s - story.times["state"][0] for story in stories]
    if max(apart_s) - min(apart_s) > ONE_CLOCK_S:
        for story, offset_s in zip(stories, apart_s, strict=True):
            story.offset_s = offset_s


SHOWN_S = 3.0
"""For so long a picture stands for what the camera sees."""


class RecordedPictures:
    """Takes a recording's messages in order, and keeps what the page may ask for: about 10 kB a picture."""

    def __init__(self, rig: RigConfig) -> None:
        self._rig = build_rig(rig)
        self._messages: dict[str, bytes] = {}
        self._times: dict[str, list[float]] = {}
        self._pictures: dict[str, list[bytes]] = {}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that there are pictures of."""
        return tuple(self._pictures)

    def take_image(self, camera: str, message: bytes) -> None:
        """A camera's image of the next step."""
        self._messages[camera] = message

    def take_step(self, time_s: float, detections: Sequence[Detection]) -> None:
        """What was detected in the images before; of those that do not decode there is no picture."""
        for camera, message in self._messages.items():
            times = self._times.setdefault(camera, [])
            if times and time_s - times[-1] < EVERY_S:
                continue
            try:
                frame = Frame(camera, decoded_image(message), time_s, 0)
            except (ValueError, RecordingError):
                continue
            times.append(time_s)
            self._pictures.setdefault(camera, []).append(preview(frame, self._rig.cameras.get(camera), detections))
        self._messages = {}

    def at(self, camera: str, time_s: float) -> bytes | None:
        """The newest by then; None where it is too old."""
        times = self._times.get(camera, [])
        index = bisect_right(times, time_s) - 1
        if index < 0 or time_s - times[index] > SHOWN_S:
            return None
        return self._pictures[camera][index]
