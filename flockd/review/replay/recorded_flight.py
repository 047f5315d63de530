"""Replays a recorded flight: the same frames and vehicle states, through the same pilot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from flockd.core.config import DroneConfig
from flockd.core.config.drone import RecordingConfig
from flockd.core.data import written_whole
from flockd.core.messages import ReasonKind
from flockd.flight.inference.manifest_file import model_hashes
from flockd.flight.pilot import FlockPilot
from flockd.onboard.daemon import load_side_by_side
from flockd.onboard.message_json import to_json
from flockd.onboard.recording import Recorder, RecordingError
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.streams import REPLAYED
from flockd.review.flight_log.log import spread
from flockd.review.replay.difference import Comparison, compare

Outputs = Mapping[int, Mapping[str, Any]]
"""The pilot's outputs as JSON, by step number."""


@dataclass
class Replay:
    """The outputs of a replay beside the recorded ones, and how long it took."""

    outputs: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    recorded: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    times_s: list[float] = field(default_factory=list)
    """Time of each step's frames."""
    steps_ms: list[float] = field(default_factory=list)
    """Real time of each step."""
    blind: list[str] = field(default_factory=list)
    """Why no image was used, of each such step."""
    processor_ms: list[float] = field(default_factory=list)
    """Processor time of each, all threads together."""
    stages_ms: dict[str, list[float]] = field(default_factory=dict)


def replay_flight(
    recording: Recording,
    config: DroneConfig,
    start_s: float,
    end_s: float,
    *,
    out: Path | None = None,
    progress: Callable[[int, int], None],
) -> Replay:
    """Runs a new pilot over the recorded steps.

    Args:
        recording: of any drone.
        config: the settings to fly with, for the recording's cameras.
        start_s: first time, on the recording's clock.
        end_s: last time.
        out: a new recording of the replay; None: none.
        progress: called with the steps done and their total.

    Raises RecordingError when ``out`` cannot be written, ModelError.
    """
    pilot = FlockPilot(config, load_side_by_side(config), stopwatch=time.perf_counter, learned=recording.learned)
    total = sum(start_s <= step_s <= end_s for _, step_s in recording.contents.steps)
    replay = Replay()
    with ExitStack() as stack:
        recorder = None if out is None else stack.enter_context(_recording_to(out, recording, config))
        for step in recording.steps(start_s, end_s):
            begin_s, processor_begin_s = time.perf_counter(), time.process_time()
            output = pilot.step(step.frames, step.vehicle, order=step.order)
            replay.steps_ms.append(1e3 * (time.perf_counter() - begin_s))
            replay.processor_ms.append(1e3 * (time.process_time() - processor_begin_s))
            replay.times_s.append(step.frames.time_s)
            replay.outputs[step.number] = to_json(output)
            refused = any(reason.kind is ReasonKind.INPUT for reason in output.reasons)
            if refused or not step.frames.frames.keys() - set(output.noisy_cameras):
                replay.blind.append(str(output.reasons[0]) if output.reasons else "it has none")
            if step.output is not None:
                replay.recorded[step.number] = step.output
            for stage, ms in output.stages_ms.items():
                replay.stages_ms.setdefault(stage, []).append(ms)
            if recorder is not None:
                recorder.drain()  # nothing waits for a replay, so nothing need be dropped
                recorder.step(step.frames, step.vehicle, output, step.truth, step.order)
            progress(len(replay.outputs), total)
    return replay


def compare_replay(
    drone: str, replay: Replay, reference: Outputs | None, tolerances: Mapping[str, float], *, part_only: bool
) -> Comparison:
    """Compares with the reference, or, without one, with the recorded outputs of the replayed steps.

    ``part_only``: only a part of the flight was replayed, so that further steps of the reference are not missing.
    """
    if reference is None:
        found = {step: replay.outputs[step] for step in replay.recorded}
        return compare(drone, replay.recorded, found, tolerances)
    expected = {step: output for step, output in reference.items() if step in replay.outputs or not part_only}
    return compare(drone, expected, replay.outputs, tolerances)


def replay_result(
    recording: Recording, replay: Replay, warnings: Sequence[str], comparison: Comparison | None
) -> dict[str, Any]:
    """The result of a replay as JSON, for `flockd replay --json`."""
    duration_s = replay.times_s[-1] - replay.times_s[0]
    return {
        "recording": str(recording.path),
        "drone": recording.drone,
        "steps": len(replay.outputs),
        "duration_s": duration_s,
        "realtime_factor": duration_s / (sum(replay.steps_ms) / 1e3),
        "stages_ms": {stage: spread(samples, "median", "p95") for stage, samples in replay.stages_ms.items()},
        "warnings": list(warnings),
        "diff": None if comparison is None else _diff(comparison),
    }


def _diff(comparison: Comparison) -> dict[str, Any]:
    return {
        "equal": comparison.first is None,
        "steps": comparison.steps,
        "values": comparison.values,
        "first": None if comparison.first is None else asdict(comparison.first),
        "fields": {
            name: {"steps": len(difference.steps), "largest": difference.largest}
            for name, difference in comparison.fields.items()
        },
    }


@contextmanager
def _recording_to(out: Path, recording: Recording, config: DroneConfig) -> Iterator[Recorder]:
    """A recorder of one file without loss or quota. The file exists only once all of it is written."""
    settings = RecordingConfig(images="png", quota_mb=1e12)
    flown = recording.contents.flight
    facts = {**{name: flown[name] for name in ("scenario", "seed") if name in flown}, REPLAYED: recording.path.name}
    models = model_hashes(config.perception)
    with written_whole(out) as draft:
        with Recorder(
            draft,
            drone=recording.drone,
            config=config,
            settings=settings,
            models=models,
            facts=facts,
            learned=recording.learned,
        ) as recorder:
            yield recorder
        if recorder.failure is not None:
            raise RecordingError(f"{out}: could not be written ({recorder.failure}); choose another place with --out")


def damage_warnings(recording: Recording) -> Iterator[str]:
    """One sentence for each damaged place and each gap of a recording."""
    contents = recording.contents
    for damage in contents.damages:
        where = "ends early" if damage.at_end else "is damaged"
        yield f"{recording.path}: {where} at byte {damage.offset}: {damage.reason}"
    for first, last in contents.gaps:
        yield f"{recording.path}: steps {first} to {last} are missing, so that later outputs may differ"


def replay_warnings(recording: Recording, config: DroneConfig, start_s: float) -> Iterator[str]:
    """One sentence for each known reason why a replay from ``start_s`` with ``config`` may differ from the flight.

    ``start_s`` is on the recording's clock. Raises ModelError.
    """
    contents = recording.contents
    first_step = next(number for number, time_s in contents.steps if time_s >= start_s)
    if first_step > 0:
        yield f"the replay begins with step {first_step}: the pilot has no tracks and no flight time from before it"
    if contents.flight["images"] != "png":
        yield f"{recording.path}: its images are {contents.flight['images']}, which is lossy; outputs may differ"
    if contents.flight.get("true_roles"):
        yield f"{recording.path}: was flown with true {contents.flight['true_roles']}, and is replayed with networks"
    for name, sha256 in model_hashes(config.perception).items():
        recorded = contents.models.get(name)
        if recorded != sha256:
            flown = f"flew with {recorded[:12]}" if recorded else "flew without it"
            yield f"model {name} is {sha256[:12]} here, and the recording {flown}: outputs will differ"
