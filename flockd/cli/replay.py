"""`flockd replay`: lets the pilot fly a recorded flight again, and tells what comes out differently."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.datasets import add_dataset_options, refuse_dataset_options, replay_dataset
from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Commands
from flockd.cli.record import add_stretch, models_of, opened, refuse_existing, stretch
from flockd.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.config import DroneConfig
    from flockd.recording import Recorder
    from flockd.recording.difference import Comparison
    from flockd.recording.reader import RecordedStep, Recording


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd replay drone1.mcap --diff",
        "flockd replay drone1.mcap --start 60 --end 70 --speed 1",
        "flockd replay drone1.mcap --config my_drone.yaml --out again.mcap",
        "flockd replay drone1.mcap --diff --reference drone1.expected --tolerance command=1e-6",
        "flockd replay drone1.mcap --reference drone1.expected --update-reference",
        "flockd replay rgbd_folder --depth recorded --stride 3 --trajectory path.txt",
        "flockd replay clip.mp4 --calibration K.txt --flow dis --json",
    )
    description = "Let the pilot fly a recorded flight again: the same frames and vehicle states, the same code."
    parser = commands("replay", description, examples)
    parser.add_argument("recording", metavar="RECORDING", type=Path)
    parser.add_argument(
        "--speed", metavar="X", type=_speed, default=0.0, help="times real time; 0: as fast as it goes (default)"
    )
    add_stretch(parser)
    parser.add_argument("--config", metavar="FILE", type=Path, help="fly with this drone's or scenario's settings")
    parser.add_argument("--out", metavar="FILE", type=Path, help="write a new recording")
    parser.add_argument("--diff", action="store_true", help="compare every output with what was recorded")
    parser.add_argument("--reference", metavar="FILE", type=Path, help="compare with this file instead")
    parser.add_argument("--update-reference", action="store_true", help="write the outputs to the reference")
    parser.add_argument(
        "--tolerance",
        metavar="FIELD=X",
        type=_tolerance,
        action="append",
        default=[],
        help="numbers of this field, such as command.velocity, may differ by X; may be given again",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    add_dataset_options(parser)
    parser.set_defaults(run=_run)


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not (math.isfinite(speed) and speed >= 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, 0 or more")
    return speed


def _tolerance(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        tolerance = float(value)
    except ValueError:
        tolerance = math.nan
    if not name or not (math.isfinite(tolerance) and tolerance >= 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a field and a number, as in command.velocity=1e-6")
    return name, tolerance


@dataclass
class _Replayed:
    """What came out."""

    outputs: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    recorded: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    times_s: list[float] = field(default_factory=list)
    reading_s: float = 0.0
    thinking_s: float = 0.0
    stages_ms: dict[str, list[float]] = field(default_factory=dict)


def _run(args: argparse.Namespace) -> int:
    from flockd.datasets import is_dataset

    if is_dataset(args.recording):
        return replay_dataset(args)
    refuse_dataset_options(args)
    _check_options(args)
    recording = opened(args.recording)
    config = _config(args, recording)
    start_s, end_s = stretch(recording, args)
    warnings = [*faults(recording), *changes(recording, config, start_s)]
    for warning in warnings:
        complain(warning)
    expected = _reference(args)
    replayed = _replay(args, recording, config, start_s, end_s)
    if args.update_reference:
        from flockd.recording.difference import save_reference

        save_reference(args.reference, recording.drone, replayed.outputs)
    comparison = _compare(args, recording, replayed, expected)
    result = _result(recording, replayed, warnings, comparison)
    if args.json:
        say_json(result)
    else:
        _say_result(args, comparison, result)
    return ExitCode.CHECK_FAILED if comparison is not None and comparison.first else ExitCode.DONE


def _check_options(args: argparse.Namespace) -> None:
    if args.update_reference and args.reference is None:
        raise UsageError("--update-reference needs the file to write; name it with --reference")
    if args.update_reference and args.diff:
        raise UsageError("--diff and --update-reference exclude each other; compare first, then update")
    if args.reference is not None and not (args.diff or args.update_reference):
        raise UsageError("--reference alone does nothing; add --diff or --update-reference")
    if args.tolerance and not args.diff:
        raise UsageError("--tolerance has no meaning without --diff; add it")
    if args.out is not None:
        refuse_existing(args.out)


def _config(args: argparse.Namespace, recording: Recording) -> DroneConfig:
    """The settings to fly with: the recorded ones, or those of --config, for the same cameras."""
    if args.config is None:
        return recording.config
    from flockd.config import ScenarioConfig, load

    loaded = load(args.config)
    config = loaded.drone if isinstance(loaded, ScenarioConfig) else loaded
    recorded = {camera.name: camera.size_px for camera in recording.config.rig.cameras}
    for camera in config.rig.cameras:
        if recorded.get(camera.name) != camera.size_px:
            size = recorded.get(camera.name)
            there = f"has it with {size[0]} x {size[1]}" if size else f"has {', '.join(recorded)}"
            raise UsageError(
                f"{args.config}: rig.cameras: wants camera {camera.name!r} with {camera.size_px[0]} x "
                f"{camera.size_px[1]} pixels, and {recording.path} {there}; give it the recording's cameras"
            )
    return config


def faults(recording: Recording) -> Iterator[str]:
    """What is missing of a recording."""
    contents = recording.contents
    for path, damage in contents.damages:
        where = "ends early" if damage.at_end else "is damaged"
        yield f"{path}: {where} at byte {damage.offset}: {damage.reason}"
    for first, last in contents.gaps:
        yield f"{recording.path}: steps {first} to {last} are missing, so that what follows may come out differently"


def changes(recording: Recording, config: DroneConfig, start_s: float) -> Iterator[str]:
    """What may keep a replay from this time on, with these settings, from being the flight."""
    contents = recording.contents
    if recording.migrations and config is recording.config:
        changed = "; ".join(recording.migrations)
        yield f"{recording.path}: was recorded by version {contents.flight.get('version')}: {changed}"
    first_step = next(number for number, time_s in contents.steps if time_s >= start_s)
    if first_step > 0:
        yield f"the replay begins with step {first_step}: the pilot remembers nothing before it, nor the time it flew"
    if contents.flight["images"] != "png":
        yield f"{recording.path}: its images are {contents.flight['images']}, not what the flight saw to the last bit"
    if contents.flight.get("true_roles"):
        yield f"{recording.path}: was flown with true {contents.flight['true_roles']}, and is replayed by network"
    for name, sha256 in models_of(config).items():
        recorded = contents.models.get(name)
        if recorded != sha256:
            flown = f"flew with {recorded[:12]}" if recorded else "flew without it"
            yield f"model {name} is {sha256[:12]} here, and the recording {flown}: outputs will differ"


def _reference(args: argparse.Namespace) -> Mapping[int, Mapping[str, Any]] | None:
    if args.reference is None or args.update_reference:
        return None
    if not args.reference.is_file():
        raise UsageError(f"{args.reference}: does not exist; write it first with --update-reference")
    from flockd.recording.difference import load_reference

    return load_reference(args.reference)


def _replay(
    args: argparse.Namespace, recording: Recording, config: DroneConfig, start_s: float, end_s: float
) -> _Replayed:
    from flockd.pilot import FlockPilot
    from flockd.recording.codec import to_json

    pilot = FlockPilot(config, stopwatch=time.perf_counter)
    total = sum(start_s <= step_s <= end_s for _, step_s in recording.contents.steps)
    replayed = _Replayed()
    with ExitStack() as stack:
        tell = stack.enter_context(progress("replaying", "steps"))
        recorder = None if args.out is None else stack.enter_context(_recording_to(args.out, recording, config))
        for step, read_s in _paced(recording.steps(start_s, end_s), args.speed):
            begin_s = time.perf_counter()
            output = pilot.step(step.frames, step.vehicle)
            replayed.thinking_s += time.perf_counter() - begin_s
            replayed.reading_s += read_s
            replayed.times_s.append(step.frames.time_s)
            replayed.outputs[step.number] = to_json(output)
            if step.output is not None:
                replayed.recorded[step.number] = step.output
            for stage, ms in output.stages_ms.items():
                replayed.stages_ms.setdefault(stage, []).append(ms)
            if recorder is not None:
                recorder.drain()  # nobody waits for a replay, so nothing need be dropped
                recorder.step(step.frames, step.vehicle, output, step.truth)
            tell(len(replayed.outputs), total)
    return replayed


@contextmanager
def _recording_to(out: Path, recording: Recording, config: DroneConfig) -> Iterator[Recorder]:
    """A recorder whose file is there when all is written, and not otherwise: one file, without loss or quota."""
    from flockd.config.recording import RecordingConfig
    from flockd.recording import Recorder, RecordingError
    from flockd.recording.editing import written_whole
    from flockd.recording.streams import REPLAYED

    settings = RecordingConfig(images="png", file_mb=1e9, quota_mb=1e12)
    flown = recording.contents.flight
    facts = {**{name: flown[name] for name in ("scenario", "seed") if name in flown}, REPLAYED: recording.path.name}
    with written_whole(out) as draft:
        with Recorder(
            draft, drone=recording.drone, config=config, settings=settings, models=models_of(config), facts=facts
        ) as recorder:
            yield recorder
        if recorder.failure is not None:
            raise RecordingError(f"{out}: could not be written ({recorder.failure}); choose another place with --out")


def _paced(steps: Iterator[RecordedStep], speed: float) -> Iterator[tuple[RecordedStep, float]]:
    """Each step not before its time, with how long it took to read."""
    began_s, first_s = time.monotonic(), None
    while True:
        begin_s = time.perf_counter()
        step = next(steps, None)
        read_s = time.perf_counter() - begin_s
        if step is None:
            return
        first_s = step.frames.time_s if first_s is None else first_s
        if speed > 0:
            due_s = began_s + (step.frames.time_s - first_s) / speed
            time.sleep(max(0.0, due_s - time.monotonic()))
        yield step, read_s


def _compare(
    args: argparse.Namespace,
    recording: Recording,
    replayed: _Replayed,
    reference: Mapping[int, Mapping[str, Any]] | None,
) -> Comparison | None:
    """With the reference for the steps asked for, or with what was recorded for all that were replayed."""
    if not args.diff:
        return None
    from flockd.recording.difference import compare

    part_only = args.start > 0 or args.end is not None
    if reference is None:
        expected, found = replayed.recorded, {step: replayed.outputs[step] for step in replayed.recorded}
    else:
        expected = {s: o for s, o in reference.items() if s in replayed.outputs or not part_only}
        found = replayed.outputs
    return compare(recording.drone, expected, found, dict(args.tolerance))


def _result(
    recording: Recording, replayed: _Replayed, warnings: Sequence[str], comparison: Comparison | None
) -> dict[str, Any]:
    duration_s = replayed.times_s[-1] - replayed.times_s[0]
    spent_s = replayed.reading_s + replayed.thinking_s
    return {
        "recording": str(recording.path),
        "drone": recording.drone,
        "steps": len(replayed.outputs),
        "duration_s": duration_s,
        "realtime_factor": duration_s / spent_s,
        "reading_share": replayed.reading_s / spent_s,
        "stages_ms": {stage: _spread(samples) for stage, samples in replayed.stages_ms.items()},
        "warnings": list(warnings),
        "diff": None if comparison is None else _diff(comparison),
    }


def _spread(samples: Sequence[float]) -> dict[str, float]:
    ordered = sorted(samples)
    return {"median": ordered[len(ordered) // 2], "p95": ordered[int(0.95 * (len(ordered) - 1))]}


def _diff(comparison: Comparison) -> dict[str, Any]:
    return {
        "equal": comparison.first is None,
        "steps": comparison.steps,
        "values": comparison.values,
        "first": None if comparison.first is None else asdict(comparison.first),
        "fields": {
            name: {"steps": len(told.steps), "largest": told.largest} for name, told in comparison.fields.items()
        },
    }


def _say_result(args: argparse.Namespace, comparison: Comparison | None, result: Mapping[str, Any]) -> None:
    say(
        f"{result['drone']}: {result['steps']} steps, {result['duration_s']:g} s, "
        f"{result['realtime_factor']:.2f} x real time, {100 * result['reading_share']:.0f} % of it reading"
    )
    if args.out is not None:
        say(f"recording: {args.out}")
    if args.update_reference:
        say(f"reference: {args.reference}")
    if comparison is None:
        return
    if comparison.first is None:
        say(f"equal in all {comparison.values} values")
        return
    say(str(comparison.first))
    for name, told in comparison.fields.items():
        size = "" if told.largest is None else f", by at most {told.largest:.3g}"
        say(f"  {name}: in {len(told.steps)} of {comparison.steps} steps{size}")
    if args.reference is not None:
        say(f"if this is meant: flockd replay {args.recording} --reference {args.reference} --update-reference")
