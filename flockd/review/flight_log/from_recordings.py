"""A flight's log and key frames from the recordings of one or several drones, with the truth where they hold it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flockd.core.messages import FloatArray, PilotOutput
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.onboard.message_json import from_json, to_json
from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.reader import Recording, flight_number, head_of
from flockd.onboard.recording.truth import Truth
from flockd.review.flight_log.builder import FlightLogBuilder
from flockd.review.flight_log.key_frames import KeyFrame, capture, key_frame_steps
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import FlightMetadata

Progress = Callable[[int, int], None]


def recordings_in(folder: Path) -> tuple[Path, ...]:
    """The first file of each recording in a folder, by name. Raises RecordingError for other MCAP files."""
    paths = sorted(folder.glob("[!.]*.mcap"))  # macOS lays a `._` file beside each on a foreign disk
    return tuple(path for path in paths if head_of(path)[0].facts.get("part", "0") == "0")


def newest_recordings(folder: Path) -> tuple[tuple[Path, ...], int]:
    """Each drone's newest recording in a folder, by the flights' numbers, and how many older ones the folder holds.

    Raises RecordingError for other MCAP files.
    """
    found = recordings_in(folder)
    newest: dict[str, tuple[int, str, Path]] = {}
    for path in found:
        facts = head_of(path)[0].facts
        one = (flight_number(facts), facts.get("began", ""), path)
        newest[facts["drone"]] = max(newest.get(facts["drone"], one), one)
    return tuple(sorted(path for *_, path in newest.values())), len(found) - len(newest)


@dataclass
class _Step:
    """One step, from all recordings that hold it."""

    time_s: float
    truth: Truth | None
    outputs: list[tuple[int, PilotOutput]]
    """Number of the drone, and the output of its pilot."""


def flight_log(recordings: Sequence[Recording], progress: Progress = lambda done, total: None) -> FlightLog:
    """The log of one flight that one or several of its drones recorded.

    Several are put together by their truth, as each drone has a clock of its own. Raises RecordingError where they are
    not of one flight, or damaged. `progress` is called with (steps read, steps in all).
    """
    names, steps = _read(recordings, progress)
    began_s = recordings[0].pilot_began_s
    zero_s = steps[0].time_s if began_s is None else began_s
    builder = FlightLogBuilder(np.array([step.time_s - zero_s for step in steps]), len(names))
    companion = np.full((2, len(steps), len(names), 3), np.nan)
    for row, step in enumerate(steps):
        if step.truth is not None:
            _add_truth(builder, row, step.truth, companion)
        if began_s is not None and step.outputs:
            statuses = [output.mission for _, output in step.outputs]
            builder.add_missions(row, np.array([status.desired for status in statuses]), statuses)
        for drone, output in step.outputs:
            builder.add_output(row, drone, output, output.stages_ms)
    metadata = _metadata(recordings, names, steps[-1].time_s - steps[0].time_s, zero_s)
    return builder.build(metadata, (companion[0], companion[1]) if np.isfinite(companion).all() else None)


def key_frames(
    recording: Recording, log: FlightLog, progress: Progress = lambda done, total: None
) -> tuple[KeyFrame, ...]:
    """Key frames of a drone, computed again: its pilot replays the whole recording with the recorded configuration.

    ``log`` is of the flight that the recording is of. Raises ModelError where the networks are not installed,
    RecordingError where the recording is damaged.
    """
    pilot = FlockPilot(recording.config, learned=recording.learned)
    names, zero_s = log.metadata.names or [], log.metadata.clock_at_start_s or 0.0
    steps = len(recording.contents.steps)
    chosen = key_frame_steps(steps)
    frames: list[KeyFrame] = []
    for index, step in enumerate(recording.steps()):
        trace = StepTrace()
        output = pilot.step(step.frames, step.vehicle, trace, step.order)
        if index in chosen:
            captured = capture(trace, output, names.index(recording.drone), "" if log.has_truth else recording.drone)
            frames += (replace(one, time_s=one.time_s - zero_s) for one in captured)
        progress(index + 1, steps)
    return tuple(frames)


def _read(recordings: Sequence[Recording], progress: Progress) -> tuple[list[str], list[_Step]]:
    """The names of all drones of the flight that are known, and its steps in order."""
    names: list[str] = []
    steps: dict[int, _Step] = {}
    done, total = 0, sum(len(recording.contents.steps) for recording in recordings)
    for recording in recordings:
        for step in recording.steps():
            done += 1
            progress(done, total)
            if not names:
                names = _names(recordings, step.truth)
            if step.truth is None and recording.has_truth:
                continue  # killed within this step
            merged = steps.setdefault(step.number, _Step(step.frames.time_s, step.truth, []))
            if json.dumps(to_json(merged.truth)) != json.dumps(to_json(step.truth)):  # to the last bit
                raise _not_of_one_flight(recordings)
            if step.output is not None:
                output: PilotOutput = from_json(PilotOutput, step.output)
                merged.outputs.append((names.index(recording.drone), output))
    if not steps:
        raise RecordingError(f"{recordings[0].path}: holds no whole step; name another recording")
    return names, [steps[number] for number in sorted(steps)]


def _names(recordings: Sequence[Recording], truth: Truth | None) -> list[str]:
    first = recordings[0]
    if truth is None and len(recordings) > 1:
        raise RecordingError(
            f"{first.path}: holds no truth, and without it the flights of several drones cannot be put together; "
            "name one recording"
        )
    names = [first.drone] if truth is None else [drone.name for drone in truth.drones]
    if not {recording.drone for recording in recordings} <= set(names):
        raise _not_of_one_flight(recordings)
    if len({recording.drone for recording in recordings}) < len(recordings):
        raise RecordingError(f"{first.path.parent}: holds several recordings of one drone; name one recording")
    return names


def _not_of_one_flight(recordings: Sequence[Recording]) -> RecordingError:
    files = ", ".join(recording.path.name for recording in recordings)
    return RecordingError(f"{recordings[0].path.parent}: {files} are not of one flight; name one recording")


def _add_truth(builder: FlightLogBuilder, row: int, truth: Truth, companion: FloatArray) -> None:
    drones = truth.drones
    builder.add_truth(
        row,
        np.array([drone.position for drone in drones]),
        np.array([drone.velocity for drone in drones]),
        np.array([drone.R_ned_body for drone in drones]),
    )
    for i, drone in enumerate(drones):
        if drone.exact_position is not None and drone.exact_velocity is not None:
            companion[0, row, i], companion[1, row, i] = drone.exact_position, drone.exact_velocity


def _metadata(recordings: Sequence[Recording], names: Sequence[str], span_s: float, zero_s: float) -> FlightMetadata:
    first = recordings[0]
    flown, config = first.contents.flight, first.config
    swapped = flown.get("true_roles")
    return FlightMetadata.of_configuration(
        config,
        scenario=flown.get("scenario", first.drone),
        perception=f"learned, true {swapped}" if swapped else "learned",
        flow="truth" if swapped and "flow" in swapped.split(", ") else config.perception.flow,
        drones=len(names),
        names=list(names),
        recorded=[recording.drone for recording in recordings],
        began=flown.get("began"),
        duration_s=span_s + config.step_s,
        seed=int(flown["seed"]) if "seed" in flown else None,
        wall_s=None,
        clock_at_start_s=zero_s,
    )
