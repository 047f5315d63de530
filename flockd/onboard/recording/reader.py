"""Reads a recording, complete or cut off by a kill. Refuses other MCAP files and those too damaged to replay."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from pydantic import ValidationError

from flockd.core import gone
from flockd.core.config import DroneConfig
from flockd.core.config.base import NAME
from flockd.core.jpeg_header import cost_fault
from flockd.core.messages import Frame, FrameSet, LearnedSize, MissionOrder, UInt8Array, VehicleState
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.recording import foxglove, streams
from flockd.onboard.recording.mcap_file import (
    Damage,
    Entry,
    Inclosure,
    Note,
    Record,
    RecordingError,
    Stream,
    read_entries,
    read_records,
)
from flockd.onboard.recording.truth import Truth

T = TypeVar("T")
_OF_STEPS = {one.topic for one in (streams.FRAMES, streams.VEHICLE, streams.ORDER, streams.OUTPUT, streams.TRUTH)}
"""Streams whose messages, besides images, are parts of steps, numbered by their sequence."""

OF_A_BAG = (
    "is a part of a bag of ROS 2; `flockd replay` takes the bag's folder, in which metadata.yaml is, and --config"
)

_APART_S = 3600.0
"""Longest time between a step and its images, or the state of its vehicle, which may be of a link that was lost: no
flight lasts an hour."""


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """Inputs and output of one step of the pilot."""

    number: int
    """Counted from 0 at the flight's first step."""
    frames: FrameSet
    vehicle: VehicleState
    output: Mapping[str, Any] | None
    """A `PilotOutput` as JSON with exact numbers; None if the recording ends before it."""
    truth: Truth | None
    """The truth of a simulated flight."""
    order: MissionOrder | None = None
    """The operator's order that the step took."""


@dataclass
class Contents:
    """Result of one pass over a recording."""

    flight: Mapping[str, str]
    models: Mapping[str, str]
    configuration: bytes
    messages: Counter[str] = field(default_factory=Counter)
    """By topic."""
    steps: list[tuple[int, float]] = field(default_factory=list)
    """Number and time of each step."""
    lost: int = 0
    """Steps and messages that the recorder dropped, by its own count."""
    damages: list[Damage] = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """Whether its writer finished it."""
        return not any(damage.at_end for damage in self.damages)

    @property
    def gaps(self) -> tuple[tuple[int, int], ...]:
        """First and last number of each run of missing steps."""
        numbers = [number for number, _ in self.steps]
        return tuple((a + 1, b - 1) for a, b in pairwise(numbers) if b > a + 1)


class Recording:
    """One drone's recording, checked as a whole when it is opened."""

    def __init__(self, path: Path | str, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Opens the file.

        Raises RecordingError if it is not a recording of flockd or too damaged to replay, and OSError. `progress` is
        called with (bytes checked, bytes in total).
        """
        self.path = Path(path)
        self.contents = _survey(self.path, progress)
        self.config, self.unknown = _config(self.path, self.contents)
        """The flight's configuration, and the keys of it that this version does not know or would refuse: with such
        keys the flight cannot be repeated exactly."""
        self._sizes = {camera.name: camera.size_px for camera in self.config.rig.cameras}
        self.learned = _learned(self.path, self.contents.flight)
        """The others' size with which the flight's pilot began."""

    @property
    def drone(self) -> str:
        """Name of the drone."""
        return self.contents.flight["drone"]

    @property
    def start_s(self) -> float:
        """Time of the first step."""
        return self.contents.steps[0][1]

    @property
    def duration_s(self) -> float:
        """Time from the first step to the last."""
        return self.contents.steps[-1][1] - self.start_s

    @property
    def has_truth(self) -> bool:
        """Whether a simulator recorded the true states of all drones."""
        return streams.TRUTH.topic in self.contents.messages

    @property
    def pilot_began_s(self) -> float | None:
        """When the pilot took its first step, from which its time counts; None: not known."""
        number, time_s = self.contents.steps[0]
        return time_s if number == 0 else None

    def steps(self, start_s: float = -np.inf, end_s: float = np.inf) -> Iterator[RecordedStep]:
        """The steps in this interval of the recording's clock, in the order of the flight.

        Steps that lost a message by damage (`Contents.damages`), or at the end of the file, are left out. Raises
        RecordingError for a message that is unreadable despite a correct checksum.
        """
        number, messages = -1, dict[str, bytes]()
        for entry in read_entries(self.path):
            if entry.stream.topic in _OF_STEPS or streams.is_image(entry.stream.topic):
                if entry.sequence != number:
                    yield from self._built(number, messages, start_s, end_s)
                    number, messages = entry.sequence, {}
                if entry.stream.topic in messages:
                    told = f"step {number} has two messages of {entry.stream.topic}"
                    raise RecordingError(f"{self.path}: {told}; use another copy")
                messages[entry.stream.topic] = entry.data
        yield from self._built(number, messages, start_s, end_s)

    def _built(
        self, number: int, messages: Mapping[str, bytes], start_s: float, end_s: float
    ) -> Iterator[RecordedStep]:
        if streams.FRAMES.topic not in messages:
            return

        def read(stream: Stream, kind: type[T]) -> T | None:
            return from_json(kind, parsed(messages[stream.topic])) if stream.topic in messages else None

        try:
            listed: streams.StepFrames = from_json(streams.StepFrames, parsed(messages[streams.FRAMES.topic]))
            if not start_s <= listed.time_s <= end_s:
                return
            vehicle: VehicleState = from_json(VehicleState, parsed(messages[streams.VEHICLE.topic]))
            self._of_step("the state of the vehicle", vehicle.time_s, listed.time_s)
            output = parsed(messages[streams.OUTPUT.topic]) if streams.OUTPUT.topic in messages else None
            truth, order = read(streams.TRUTH, Truth), read(streams.ORDER, MissionOrder)
            frames = {}
            for entry in listed.frames:
                self._of_step(f"the image of camera {entry.camera}", entry.time_s, listed.time_s)
                image = self._of_rig(entry.camera, decoded_image(messages[foxglove.image_stream(entry.camera).topic]))
                frames[entry.camera] = Frame(entry.camera, image, entry.time_s, entry.sequence)
        except KeyError as error:
            if self.contents.damages:
                return
            raise RecordingError(f"{self.path}: step {number} lost its message {error}; use another copy") from error
        except (ValueError, RecordingError) as error:
            raise RecordingError(f"{self.path}: step {number} cannot be read ({error}); use another copy") from error
        if len(frames) < len(listed.frames):
            raise RecordingError(f"{self.path}: step {number} lists a camera twice; use another copy")
        yield RecordedStep(number, FrameSet(listed.time_s, frames), vehicle, output, truth, order)

    @staticmethod
    def _of_step(what: str, time_s: float | None, step_s: float) -> None:
        """Raises ValueError for what is of another time than its step, or of none that is finite."""
        if time_s is None or not abs(time_s - step_s) <= _APART_S:
            raise ValueError(f"{what} is of {time_s} s, and the step of {step_s:g} s")

    def _of_rig(self, camera: str, image: UInt8Array) -> UInt8Array:
        """The image. Raises ValueError if the rig has no such camera, or has it with another size."""
        size = self._sizes.get(camera)
        if size != image.shape[1::-1]:
            known = f"its rig has it with {size[0]} x {size[1]}" if size else "its rig has no such camera"
            raise ValueError(f"camera {camera} has {image.shape[1]} x {image.shape[0]} pixels, and {known}")
        return image


def head_of(path: Path) -> tuple[Note, Note, Inclosure]:
    """The head of every file: the flight, its models and its configuration.

    Raises RecordingError if the file is not a recording of flockd or ends before all three, and OSError.
    """
    flight, models, configuration = None, None, None
    for record in read_records(path):
        match record:
            case Note(name) if name == streams.FLIGHT_NOTE:
                flight = record
            case Note(name) if name == streams.MODELS_NOTE:
                models = record
            case Inclosure(name) if name == streams.CONFIGURATION:
                configuration = record
            case Damage():
                if flight is None:
                    raise RecordingError(f"{path}: nothing in it can be read ({record.reason}); use another copy")
                raise RecordingError(f"{path}: is cut off before the configuration of the flight; use another copy")
            case Entry(stream) if flight is None:
                if "/msg/" in stream.schema_name:
                    raise RecordingError(f"{path}: {OF_A_BAG}")
                break
        if flight and models and configuration:
            if flight.facts.get("format") != streams.FORMAT:
                known = f"format {flight.facts.get('format')!r}, and this flockd reads {streams.FORMAT!r}"
                raise RecordingError(f"{path}: is of {known}; use the flockd that wrote it")
            for fact, pattern in (("drone", NAME), ("images", "[a-z0-9]+")):
                if not re.fullmatch(pattern, flight.facts.get(fact, "")):
                    raise RecordingError(f"{path}: names no {fact} in its note of the flight; use another copy")
            return flight, models, configuration
    raise RecordingError(f"{path}: is an MCAP file, but not a recording of flockd; name one that flockd wrote")


def flight_number(facts: Mapping[str, str]) -> int:
    """Number in a flight's note; 0 if its recorder counted none."""
    text = facts.get(streams.FLIGHT_NUMBER, "")
    return int(text) if re.fullmatch("[0-9]{1,9}", text) else 0


def _survey(path: Path, progress: Callable[[int, int], None]) -> Contents:
    if not path.is_file():
        fault = "is a folder; name a recording in it" if path.is_dir() else "does not exist; check the path"
        raise RecordingError(f"{path}: {fault}")
    if path.suffix == ".db3":
        raise RecordingError(f"{path}: {OF_A_BAG}")
    flight, models, configuration = head_of(path)
    found = Contents(flight.facts, models.facts, configuration.data)
    total, done = path.stat().st_size, 0
    for record in read_records(path):
        if isinstance(record, Entry):
            done += len(record.data)
            progress(done, total)
        _note(found, path, record)
    if not found.steps:
        why = f", and {found.damages[0].reason}" if found.damages else ""
        raise RecordingError(f"{path}: holds no step of a flight{why}; record one that flies")
    return found


def _note(found: Contents, path: Path, record: Record | Damage) -> None:
    match record:
        case Entry(stream, _, sequence, data):
            found.messages[stream.topic] += 1
            if stream.topic == streams.FRAMES.topic:
                if found.steps and sequence <= (last := found.steps[-1][0]):
                    told = f"step {sequence} comes behind step {last}, as in recordings that were joined"
                    raise RecordingError(f"{path}: {told}; use those themselves")
                found.steps.append((sequence, _time_of(path, data)))
        case Note(name, facts_of_end) if name == streams.END_NOTE:
            if not re.fullmatch("[0-9]{1,9}", lost := facts_of_end.get("lost", "0")):
                raise RecordingError(f"{path}: says lost {lost[:20]!r}, which is no number; use another copy")
            found.lost = int(lost)
        case Damage():
            found.damages.append(record)


def _time_of(path: Path, data: bytes) -> float:
    with suppress(ValueError, KeyError, TypeError, OverflowError):
        if math.isfinite(time_s := float(parsed(data)["time_s"])):
            return time_s
    raise RecordingError(f"{path}: holds a frame set without a time; use another copy")


def _config(path: Path, contents: Contents) -> tuple[DroneConfig, tuple[str, ...]]:
    try:
        values = _without_gone(parsed(contents.configuration))
    except ValueError as error:
        raise RecordingError(f"{path}: the configuration in it is not JSON ({error}); use another copy") from error
    unknown: list[str] = []
    while True:
        try:
            return DroneConfig.model_validate_json(json.dumps(values)), tuple(unknown)
        except ValidationError as error:
            first = error.errors()[0]
            key, section = ".".join(map(str, first["loc"])) or "the whole", values
            with suppress(KeyError, IndexError, TypeError):
                for part in first["loc"][:-1]:
                    section = section[part]
                del section[str(first["loc"][-1])]
                unknown.append(key)
                continue
            version = contents.flight.get("version", "of unknown version")
            raise RecordingError(
                f"{path}: the configuration in it is not one of this flockd ({key}: {first['msg']}); "
                f"use the flockd that wrote it, {version}"
            ) from error


def _without_gone(values: Any, at: str = "") -> Any:
    """The values of an older configuration, without keys that this version has removed."""
    if not isinstance(values, dict):
        return values
    return {
        key: _without_gone(value, f"{at}{key}.")
        for key, value in values.items()
        if f"{at}{key}" not in gone.KEYS and (f"{at}{key}", value) not in gone.VALUES
    }


def _learned(path: Path, flight: Mapping[str, str]) -> LearnedSize | None:
    if streams.LEARNED_SIZE not in flight:
        return None
    try:
        learned: LearnedSize = from_json(LearnedSize, parsed(flight[streams.LEARNED_SIZE].encode()))
    except ValueError as error:
        raise RecordingError(
            f"{path}: its {streams.LEARNED_SIZE} cannot be read ({error}); use another copy"
        ) from error
    if not all(0 < number < math.inf for number in (learned.size_m, learned.sigma)):
        raise RecordingError(f"{path}: its {streams.LEARNED_SIZE} is no size; use another copy")
    return learned


def decoded_image(message: bytes) -> UInt8Array:
    """(h, w, 3) RGB from an image's message. Raises ValueError and RecordingError."""
    data, kind = foxglove.image_data(message)
    if (fault := cost_fault(data)) is not None:
        raise ValueError(f"a {kind} image {fault}")
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except cv2.error:
        bgr = None
    if bgr is None:
        raise ValueError(f"a {kind} image does not decode")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def recording_info(recording: Recording) -> dict[str, Any]:
    """A summary of a recording, as JSON: flight, duration, models, gaps, damages and messages of each topic."""
    contents = recording.contents
    return {
        **contents.flight,
        "bytes": recording.path.stat().st_size,
        "finished": contents.finished,
        "steps": len(contents.steps),
        "start_s": recording.start_s,
        "duration_s": recording.duration_s,
        "lost": contents.lost,
        "models": dict(contents.models),
        "gaps": [{"first_step": first, "last_step": last} for first, last in contents.gaps],
        "damages": [{"byte": damage.offset, "reason": damage.reason} for damage in contents.damages],
        "messages": dict(contents.messages),
    }
