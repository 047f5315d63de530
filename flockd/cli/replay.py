"""`flockd replay`: computes a recorded flight or a dataset again, compares the outputs, and says where time goes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from flockd.cli.options import add_stretch, loaded, opened, refuse, refuse_overwriting, stretch
from flockd.cli.output import complain, progress, say, say_facts, say_json
from flockd.cli.parser import Commands, OnceEach, Parser, existing, flag, option, positive_count
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.onboard.recording.reader import Recording
    from flockd.review.replay.dataset_flight import Depth
    from flockd.review.replay.difference import Comparison

MOST_SCALE = 3.0
"""Of motions by the images relative to those by a dataset's poses; a depth network errs by less where it never was."""
_OF_RECORDINGS = ("start", "end", "out", "diff", "reference", "update_reference", "tolerance")
_OF_DATASETS = ("depth", "stride", "flow")


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd replay drone1.mcap --diff",
        "flockd replay drone1.mcap --start 60 --end 70",
        "flockd replay drone1.mcap --profile",
        "flockd replay drone1.mcap --config my_drone.yaml --out again.mcap",
        "flockd replay drone1.mcap --diff --reference drone1.expected --tolerance command=1e-6",
        "flockd replay drone1.mcap --reference drone1.expected --update-reference",
        "flockd replay office --depth recorded --stride 3",
        "flockd replay flight_bag --config my_drone.yaml --vehicle /mavros/local_position/odom",
    )
    description = "Run the pilot on a recorded flight again: the same frames and vehicle states, the same code."
    parser = commands("replay", description, examples, _run)
    option(parser, "RECORDING", "a recording, or a dataset (see below)", existing)
    add_stretch(parser)
    option(parser, "--config FILE", "use the settings of this drone or scenario", existing)
    option(parser, "--out FILE", "write the replay as a new recording (.mcap)", Path)
    flag(parser, "--diff", "compare every output with the recorded one")
    flag(parser, "--profile", "show where time goes on this computer, and which step_s it can keep")
    option(parser, "--reference FILE", "with --diff: compare with the outputs in this file instead", Path)
    flag(parser, "--update-reference", "write the outputs to the file of --reference")
    option(
        parser,
        "--tolerance FIELD=X",
        "numbers of this field, such as command.velocity, may differ by X; may be given again",
        _tolerance,
        action=OnceEach,
        default=[],
    )
    flag(parser, "--json", "print the result as JSON")
    group = parser.add_argument_group("bags of ROS 2", "a bag folder as RECORDING, with --config")
    option(group, "--vehicle TOPIC", "odometry, pose or IMU of the drone (default: the only one there is)")
    _add_dataset(parser)


def _tolerance(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        tolerance = float(value)
    except ValueError:
        tolerance = math.nan
    if not name or not (math.isfinite(tolerance) and tolerance >= 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a field and a number, as in command.velocity=1e-6")
    return name, tolerance


def _run(args: argparse.Namespace) -> int:
    from flockd.review.replay.bag_flight import is_bag

    if args.recording.is_dir() and not is_bag(args.recording):
        return _run_dataset(args)
    refuse(args, _OF_DATASETS, "is for datasets; a recording of flockd holds it, or --config gives it")
    _check_options(args)
    with _recording(args) as recording:
        return _replay(args, recording)


@contextmanager
def _recording(args: argparse.Namespace) -> Iterator[Recording]:
    """What is replayed; of a bag of somebody else's a recording in a temporary folder."""
    from flockd.review.replay.bag_flight import Bag, is_bag, recording_of_bag

    if args.vehicle is not None and not is_bag(args.recording):
        raise UsageError("--vehicle is for bags of ROS 2, and this is not one; leave it out")
    if not is_bag(args.recording):
        yield opened(args.recording)
        return
    with Bag(args.recording) as bag, TemporaryDirectory(prefix="flockd-bag-") as folder:
        config = loaded(args.config)
        if config is None:
            raise UsageError(
                f"{args.recording}: is a bag of ROS 2; name a drone with --config whose "
                "source.kind is `ros` and whose cameras name their topics"
            )
        target = Path(folder) / f"{args.recording.resolve().name}.mcap"
        recording_of_bag(bag, config, args.vehicle, target, complain)
        yield opened(target)


def _replay(args: argparse.Namespace, recording: Recording) -> int:
    from flockd.review.replay.profile import Watch, profile_result
    from flockd.review.replay.recorded_flight import (
        compare_replay,
        damage_warnings,
        replay_flight,
        replay_result,
        replay_warnings,
    )

    config = _config(args, recording)
    start_s, end_s = stretch(recording, args)
    if args.profile:
        _refuse_short(recording, start_s, end_s)
    warnings = [*damage_warnings(recording), *replay_warnings(recording, config, start_s)]
    for warning in warnings:
        complain(warning)
    expected = _reference(args)
    watch = Watch() if args.profile else None
    with progress("replaying", "steps") as show_progress:

        def after_step(done: int, total: int) -> None:
            show_progress(done, total)
            if watch is not None:
                watch.look()

        replay = replay_flight(recording, config, start_s, end_s, out=args.out, progress=after_step)
    if args.update_reference:
        from flockd.review.replay.difference import save_reference

        save_reference(args.reference, recording.drone, replay.outputs)
    comparison = None
    if args.diff:
        part_only = args.start > 0 or args.end is not None
        comparison = compare_replay(recording.drone, replay, expected, dict(args.tolerance), part_only=part_only)
        for name in sorted(comparison.unused):
            complain(f"--tolerance {name}: no output has this field, so nothing was permitted; correct the name")
    result = replay_result(recording, replay, warnings, comparison)
    if watch is not None:
        result["profile"] = profile_result(replay, config, watch)
    if args.json:
        say_json(result)
    else:
        _say_result(args, comparison, result)
        if watch is not None:
            _say_profile(args, result["profile"])
    if len(replay.blind) == len(replay.outputs):
        complain(f"{recording.path}: no image could be used: {replay.blind[0]}")
        return ExitCode.CHECK_FAILED
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
    if args.out is not None and args.out.suffix != ".mcap":
        raise UsageError(f"{args.out}: a recording is written as .mcap; give it such a name")
    refuse_overwriting(args, args.out)
    if args.update_reference:
        from flockd.review.replay.difference import is_reference

        if not is_reference(args.reference):
            refuse_overwriting(args, args.reference)


def _refuse_short(recording: Recording, start_s: float, end_s: float) -> None:
    from flockd.review.replay.profile import LEAST_STEPS

    steps = sum(start_s <= time_s <= end_s for _, time_s in recording.contents.steps)
    if steps < LEAST_STEPS:
        raise UsageError(
            f"{recording.path}: has {steps} {'step' if steps == 1 else 'steps'} there, and --profile needs "
            f"{LEAST_STEPS} or more; choose a longer flight, or drop --start and --end"
        )


def _config(args: argparse.Namespace, recording: Recording) -> DroneConfig:
    """The settings to fly with: the recorded ones, or those of --config, for the same cameras."""
    if args.config is None and recording.unknown:
        from flockd.onboard.recording import RecordingError

        raise RecordingError(
            f"{recording.path}: was flown with settings unknown to this flockd ({', '.join(recording.unknown)}), "
            f"so that a replay would be another flight; use {recording.contents.flight.get('version', 'the version')} "
            "that wrote it, or other settings with --config"
        )
    if args.config is None:
        return recording.config
    config = loaded(args.config)
    assert config is not None
    recorded = {camera.name: camera.size_px for camera in recording.config.rig.cameras}
    for camera in config.rig.cameras:
        if recorded.get(camera.name) != camera.size_px:
            size = recorded.get(camera.name)
            there = f"has it with {size[0]} x {size[1]}" if size else f"has {', '.join(recorded)}"
            raise UsageError(
                f"{args.config}: rig.cameras: camera {camera.name!r} has {camera.size_px[0]} x {camera.size_px[1]} "
                f"pixels, but {recording.path} {there}; use the recording's cameras"
            )
    return config


def _reference(args: argparse.Namespace) -> Mapping[int, Mapping[str, Any]] | None:
    if args.reference is None or args.update_reference:
        return None
    if not args.reference.is_file():
        raise UsageError(f"{args.reference}: does not exist; write it first with --update-reference")
    from flockd.review.replay.difference import load_reference

    return load_reference(args.reference)


def _say_result(args: argparse.Namespace, comparison: Comparison | None, result: Mapping[str, Any]) -> None:
    say(
        f"{result['drone']}: {result['steps']} steps, {result['duration_s']:g} s, "
        f"{result['realtime_factor']:.2f} x real time"
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
    for name, difference in comparison.fields.items():
        size = "" if difference.largest is None else f", by at most {difference.largest:.3g}"
        say(f"  {name}: in {len(difference.steps)} of {comparison.steps} steps{size}")
    if args.reference is not None:
        say(f"if this is meant: flockd replay {args.recording} --reference {args.reference} --update-reference")


def _add_dataset(parser: Parser) -> None:
    """Adds what only replays of datasets have."""
    group = parser.add_argument_group("datasets", "a folder with images, depth and poses as RECORDING")
    option(
        group,
        "--depth",
        "use the recorded depth, or the network's (default: network)",
        choices=("recorded", "network"),
    )
    option(group, "--stride N", "pair frame i with frame i + N (default: 1)", positive_count)
    option(group, "--flow NAME", "use this flow model, or `dis`")


def _run_dataset(args: argparse.Namespace) -> int:
    """Runs the command for a dataset."""
    from flockd.ground.datasets.image_folder import open_dataset
    from flockd.review.replay.dataset_flight import dataset_config, dataset_result, replay_dataset

    stride = args.stride or 1
    depth: Depth = args.depth or "network"
    dataset = open_dataset(args.recording)
    refuse(args, _OF_RECORDINGS, "is for recordings of flockd, and this is not one; leave it out")
    if depth == "recorded" and not dataset.has_depth:
        raise UsageError(f"{dataset.path}: has no recorded depth; replay it with --depth network")
    if stride >= len(dataset):
        raise UsageError(f"{dataset.path}: has {len(dataset)} frames, and none {stride} after another; lower --stride")
    given = loaded(args.config)
    config = dataset_config(dataset, given, depth, args.flow)
    if given is not None and (scale := given.perception.scale) != "network":
        complain(f"{args.config}: perception.scale: {scale} needs an autopilot; of a dataset it is the network's")
    with progress("replaying", "pairs") as show_progress:
        pairs = []
        for pair in replay_dataset(dataset, config, stride, depth):
            pairs.append(pair)
            show_progress(len(pairs), len(dataset) - stride)
    result = {**dataset_result(pairs), "stride": stride, "depth": depth, "flow": config.perception.flow}
    lines = [f"not estimated: {p['from']} to {p['to']}: {p['reason']}" for p in result["pairs"] if not p["estimated"]]
    say_facts(args, result if args.json else {**result, "pairs": len(pairs)}, *lines)
    if not any(pair.found for pair in pairs):
        complain(f"{dataset.path}: no motion could be estimated: {pairs[0].reason}")
        return ExitCode.CHECK_FAILED
    if (scale := result["scale"]) is not None and not 1 / MOST_SCALE < scale < MOST_SCALE:
        complain(
            f"{dataset.path}: motions by the images are {scale:.3g} times as long as by poses.txt; write poses in "
            "metres, and depth maps in millimetres (TUM's have 5000 units to a metre)"
        )
        return ExitCode.CHECK_FAILED
    return ExitCode.DONE


def _say_profile(args: argparse.Namespace, profile: Mapping[str, Any]) -> None:
    """A table of stages, the computer, and the step time that it can keep; ``profile`` as `profile_result` gives it."""
    say(f"\n{'stage':<20}{'p50 ms':>8}{'p95 ms':>8}{'share':>8}")
    for stage, row in profile["stages"].items():
        say(f"{stage:<20}{row['p50_ms']:>8.1f}{row['p95_ms']:>8.1f}{100 * row['share']:>7.0f}%")
    say_facts(args, {name: fact for name, fact in profile.items() if name != "stages"}, _advice(profile))


def _advice(profile: Mapping[str, Any]) -> str:
    share = 100 * profile["stages"]["step"]["p95_ms"] / (1e3 * profile["step_s"])
    text = f"step_s {profile['step_s']:g} is configured: a step takes {share:.0f} % of it (p95)"
    least = profile["least_step_s"]
    if least > profile["step_s"]:
        return f"{text}. Too long: configure step_s: {least:g} or more here"
    return f"{text}. The least that leaves a fifth for cameras, recording and telemetry: step_s: {least:g}"
