"""Makes a new recording of the whole steps of another: after a kill or damage, or of a stretch of time."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from flockd.core.messages import VehicleState
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.recording import foxglove
from flockd.onboard.recording.mcap_file import Entry, McapFile, Note, RecordingError, read_entries
from flockd.onboard.recording.reader import (
    Contents,
    Recording,
    decoded_image,
    head_of,
    is_calibration,
    makes_steps,
)
from flockd.onboard.recording.streams import (
    CUT,
    END_NOTE,
    FLIGHT_NOTE,
    FRAMES,
    OUTPUT,
    PILOT_BEGAN,
    RECOVERED,
    TRUTH,
    VEHICLE,
    StepFrames,
    is_image,
)
from flockd.onboard.recording.truth import Truth

_KINDS = {VEHICLE.topic: VehicleState, TRUTH.topic: Truth}


def recover(recording: Recording, target: Path) -> int:
    """Writes what is whole of a recording, all its files as one; gives the number of steps.

    Raises RecordingError when no step is whole, and OSError; then there is no target.
    """
    return _copy(recording, target, -np.inf, np.inf, RECOVERED)


def cut(recording: Recording, target: Path, start_s: float, end_s: float) -> int:
    """Writes the stretch from `start_s` to `end_s` of the recording's clock; gives the number of steps.

    Raises RecordingError when no whole step is in it, and OSError; then there is no target.
    """
    return _copy(recording, target, start_s, end_s, CUT)


@contextmanager
def written_whole(target: Path) -> Iterator[Path]:
    """A place to write to, which becomes the target when all is written and vanishes otherwise."""
    draft = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        yield draft
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def _copy(recording: Recording, target: Path, start_s: float, end_s: float, how: str) -> int:
    contents, began_s = recording.contents, recording.pilot_began_s
    whole = _whole_steps(contents, start_s, end_s, images=how == RECOVERED)
    if not whole:
        raise RecordingError(f"{contents.paths[0]}: holds no whole step there; nothing was written")
    flight, models, configuration = head_of(contents.paths[0])
    facts = {**flight.facts, "recording": uuid.uuid4().hex, "part": "0", how: recording.path.name}
    if began_s is not None:
        facts[PILOT_BEGAN] = repr(began_s)
    with written_whole(target) as draft, McapFile(draft) as file:
        for record in (Note(FLIGHT_NOTE, facts), models, configuration):
            file.write(record)
        for entry in _kept(contents, whole, lambda time_ns: start_s * 1e9 <= time_ns <= end_s * 1e9):
            file.write(entry)
        file.write(Note(END_NOTE, {"steps": str(len(whole)), "lost": str(contents.lost)}))
    return len(whole)


def _kept(contents: Contents, whole: set[int], in_time: Callable[[int], bool]) -> Iterator[Entry]:
    calibrated: set[str] = set()
    for entry in read_entries(*contents.paths):
        topic = entry.stream.topic
        if is_calibration(topic):
            if topic not in calibrated:
                yield entry
            calibrated.add(topic)
        elif entry.sequence in whole if makes_steps(topic) else in_time(entry.time_ns):
            yield entry


def _whole_steps(contents: Contents, start_s: float, end_s: float, *, images: bool) -> set[int]:
    """Steps with their vehicle's state and all the images that they list; ``images``: only if those decode."""
    seen: dict[int, set[str]] = {}
    listed: dict[int, StepFrames] = {}
    damaged: set[int] = set()
    for entry in read_entries(*contents.paths):
        if makes_steps(entry.stream.topic):
            seen.setdefault(entry.sequence, set()).add(entry.stream.topic)
        if entry.stream.topic == FRAMES.topic:
            with suppress(ValueError):
                listed[entry.sequence] = from_json(StepFrames, parsed(entry.data))
        elif not _can_be_read(entry, images):
            damaged.add(entry.sequence)
    return {
        number
        for number, step in listed.items()
        if number not in damaged
        and start_s <= step.time_s <= end_s
        and {VEHICLE.topic, *(foxglove.image_stream(f.camera).topic for f in step.frames)} <= seen[number]
    }


def _can_be_read(entry: Entry, images: bool) -> bool:
    """Whether a step with this message can be replayed."""
    try:
        if entry.stream.topic in _KINDS:
            from_json(_KINDS[entry.stream.topic], parsed(entry.data))
        elif entry.stream.topic == OUTPUT.topic:
            parsed(entry.data)
        elif images and is_image(entry.stream.topic):
            decoded_image(entry.data)
    except (ValueError, RecordingError):
        return False
    return True
