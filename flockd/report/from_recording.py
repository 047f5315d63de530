"""A flight's log and pictures from its recordings, one or several drones', with what truth there is in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flockd.flocking import desired_velocity
from flockd.messages import FloatArray, PilotOutput
from flockd.pilot import FlockPilot, StepTrace
from flockd.recording import RecordingError
from flockd.recording.codec import from_json, to_json
from flockd.recording.reader import Recording, head_of
from flockd.recording.truth import Truth
from flockd.report.filmstrip import FilmstripFrame
from flockd.sim.log import FlightLog
from flockd.sim.log_book import LogBook
from flockd.sim.pictures import picture, pictured_steps

Progress = Callable[[int, int], None]


def recordings_in(folder: Path) -> tuple[Path, ...]:
    """The first file of each recording in a folder, by name. Raises RecordingError for a file that is none."""
    paths = sorted(folder.glob("*.mcap"))
    return tuple(path for path in paths if head_of(path)[0].facts.get("part", "0") == "0")


@dataclass
class _Moment:
    """One step, by all who recorded it."""

    time_s: float
    truth: Truth | None
    seen: list[tuple[int, PilotOutput, FloatArray]]
    """Number of the drone, what it saw, and its attitude."""


def flight_log(recordings: Sequence[Recording], progress: Progress = lambda done, total: None) -> FlightLog:
    """The log of one flight that one or several of its drones recorded.

    Several are put together by their truth, as each drone has a clock of its own. Raises RecordingError where they are
    not of one flight, or spoilt. `progress` is told how many of how many steps are read.
    """
    names, moments = _read(recordings, progress)
    began_s = recordings[0].pilot_began_s
    zero_s = moments[0].time_s if began_s is None else began_s
    book = LogBook(np.array([moment.time_s - zero_s for moment in moments]), len(names))
    companion = np.full((2, len(moments), len(names), 3), np.nan)
    for row, moment in enumerate(moments):
        if moment.truth is not None:
            _tell_truth(book, row, moment.truth, companion)
        if began_s is not None:
            book.desired(row, desired_velocity(recordings[0].config.desired, moment.time_s - began_s))
        for drone, output, R_ned_body in moment.seen:
            book.seen(row, drone, output, R_ned_body, output.stages_ms)
    meta = {**_meta(recordings, names, moments[-1].time_s - moments[0].time_s), "clock_at_start_s": zero_s}
    return book.log(meta, (companion[0], companion[1]) if np.isfinite(companion).all() else None)


def filmstrip(
    recording: Recording, log: FlightLog, progress: Progress = lambda done, total: None
) -> tuple[FilmstripFrame, ...]:
    """A few moments of a drone, seen again: its pilot flies all of the recording once more with what it flew with.

    Raises ModelError where its networks are not here, RecordingError where the recording is spoilt.
    """
    pilot = FlockPilot(recording.config)
    names = log.meta["names"]
    steps = len(recording.contents.steps)
    pictured = pictured_steps(steps)
    frames: list[FilmstripFrame] = []
    for index, step in enumerate(recording.steps()):
        trace = StepTrace()
        output = pilot.step(step.frames, step.vehicle, trace)
        if index in pictured:
            seen = picture(trace, output, names.index(recording.drone), "" if log.has_truth else recording.drone)
            frames += (replace(one, time_s=one.time_s - log.meta["clock_at_start_s"]) for one in seen)
        progress(index + 1, steps)
    return tuple(frames)


def _read(recordings: Sequence[Recording], progress: Progress) -> tuple[list[str], list[_Moment]]:
    """The names of all drones of the flight that anything is known of, and its steps in order."""
    names: list[str] = []
    moments: dict[int, _Moment] = {}
    done, total = 0, sum(len(recording.contents.steps) for recording in recordings)
    for recording in recordings:
        for step in recording.steps():
            done += 1
            progress(done, total)
            if not names:
                names = _names(recordings, step.truth)
            if step.truth is None and recording.has_truth:
                continue  # killed within this step
            moment = moments.setdefault(step.number, _Moment(step.frames.time_s, step.truth, []))
            _check_same(recordings, moment.truth, step.truth)
            if step.output is not None:
                output: PilotOutput = from_json(PilotOutput, step.output)
                moment.seen.append((names.index(recording.drone), output, step.vehicle.R_ned_body))
    if not moments:
        raise RecordingError(f"{recordings[0].path}: holds no whole step; name another recording")
    return names, [moments[number] for number in sorted(moments)]


def _names(recordings: Sequence[Recording], truth: Truth | None) -> list[str]:
    first = recordings[0]
    if truth is None and len(recordings) > 1:
        raise RecordingError(
            f"{first.path}: holds no truth, and without it the flights of several drones cannot be put together; "
            "name one recording"
        )
    names = [first.drone] if truth is None else [drone.name for drone in truth.drones]
    if not {recording.drone for recording in recordings} <= set(names):
        raise _strangers(recordings)
    if len({recording.drone for recording in recordings}) < len(recordings):
        raise RecordingError(f"{first.path.parent}: holds several recordings of one drone; name one recording")
    return names


def _check_same(recordings: Sequence[Recording], one: Truth | None, other: Truth | None) -> None:
    """Two drones of one flight were recorded beside the same truth, to the last bit."""
    if json.dumps(to_json(one)) != json.dumps(to_json(other)):
        raise _strangers(recordings)


def _strangers(recordings: Sequence[Recording]) -> RecordingError:
    files = ", ".join(recording.path.name for recording in recordings)
    return RecordingError(f"{recordings[0].path.parent}: {files} are not of one flight; name one recording")


def _tell_truth(book: LogBook, row: int, truth: Truth, companion: FloatArray) -> None:
    drones = truth.drones
    book.truth(
        row,
        np.array([drone.position for drone in drones]),
        np.array([drone.velocity for drone in drones]),
        np.array([drone.R_ned_body for drone in drones]),
    )
    for i, drone in enumerate(drones):
        if drone.exact_position is not None and drone.exact_velocity is not None:
            companion[0, row, i], companion[1, row, i] = drone.exact_position, drone.exact_velocity


def _meta(recordings: Sequence[Recording], names: Sequence[str], span_s: float) -> dict[str, Any]:
    first = recordings[0]
    flown, config = first.contents.flight, first.config
    swapped = flown.get("true_roles")
    return {
        "scenario": flown.get("scenario", first.drone),
        "perception": f"learned, true {swapped}" if swapped else "learned",
        "flow": "truth" if swapped and "flow" in swapped.split(", ") else config.perception.flow,
        "scale": config.perception.scale,
        "drones": len(names),
        "names": list(names),
        "recorded": [recording.drone for recording in recordings],
        "began": flown.get("began"),
        "duration_s": span_s + config.step_s,
        "step_s": config.step_s,
        "seed": int(flown["seed"]) if "seed" in flown else None,
        "wall_s": None,
        "circle_until_s": config.desired.circle_until_s,
        "desired_distance_m": config.flocking.desired_distance_m,
        "observation_distance_m": config.flocking.observation_distance_m,
        "separation_distance_m": config.flocking.separation_distance_m,
    }
