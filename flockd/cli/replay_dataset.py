"""`flockd replay` of a dataset: the pilot's ego-motion from pairs of frames, measured against the poses."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.config import loaded
from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Parser, positive_count
from flockd.cli.recording_options import refuse_existing
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.ground.datasets import Dataset
    from flockd.review.replay.dataset_flight import Depth

_OF_RECORDINGS = ("speed", "start", "end", "out", "diff", "reference", "update_reference", "tolerance")
_OF_DATASETS = ("depth", "stride", "flow", "calibration", "trajectory")


def add_dataset_options(parser: Parser) -> None:
    """Adds what only replays of datasets have."""
    group = parser.add_argument_group("datasets", "a folder with images, depth and poses as RECORDING")
    group.add_argument(
        "--depth", choices=("recorded", "network"), help="the recorded depth, or that of the network (default: network)"
    )
    group.add_argument("--stride", metavar="N", type=positive_count, help="pair frame i with frame i + N (default: 1)")
    group.add_argument("--flow", metavar="NAME", help="use this flow model, or `dis`")
    group.add_argument("--calibration", metavar="FILE", type=Path, help="K.txt, or a drone's YAML with one camera")
    group.add_argument("--trajectory", metavar="FILE", type=Path, help="write the integrated path in TUM format")


def refuse_dataset_options(args: argparse.Namespace) -> None:
    """Raises UsageError where a recording is to be replayed like a dataset."""
    _refuse(args, _OF_DATASETS, "is for datasets; a recording of flockd holds it, or --config gives it")


def run_dataset(args: argparse.Namespace) -> int:
    """Runs the command for a dataset."""
    _refuse(args, _OF_RECORDINGS, "is for recordings of flockd, and this is none; leave it out")
    if args.trajectory is not None:
        refuse_existing(args.trajectory, "--trajectory")
    from flockd.ground.datasets import open_dataset
    from flockd.review.replay.dataset_flight import dataset_config, dataset_result, replay_dataset, write_trajectory

    stride = args.stride or 1
    depth: Depth = args.depth or "network"
    dataset = open_dataset(args.recording, args.calibration)
    _check(dataset, stride, depth)
    given = loaded(args.config)
    config = dataset_config(dataset, given, depth, args.flow)
    for note in (*dataset.notes, *_notes(args.config, given)):
        complain(note)
    with progress("replaying", "pairs") as show_progress:
        pairs = replay_dataset(dataset, config, stride, depth, show_progress)
    result = {**dataset_result(pairs), "stride": stride, "depth": depth, "flow": config.perception.flow}
    if args.trajectory is not None:
        broken = write_trajectory(args.trajectory, pairs, stride)
        if broken is not None:
            complain(
                f"{args.trajectory}: ends at frame {broken.before.index}, as the motion to frame {broken.after.index} "
                f"could not be estimated: {broken.reason}"
            )
    if args.json:
        say_json(result)
    else:
        _say_result(args, result)
    if not any(pair.found for pair in pairs):
        complain(f"{dataset.path}: no motion could be estimated: {pairs[0].reason}")
        return ExitCode.CHECK_FAILED
    return ExitCode.DONE


def _notes(file: Path | None, config: DroneConfig | None) -> list[str]:
    if config is None or config.perception.scale == "network":
        return []
    scale = config.perception.scale
    return [f"{file}: perception.scale: {scale} needs an autopilot, which a dataset lacks; scale is the network's"]


def _refuse(args: argparse.Namespace, names: Sequence[str], why: str) -> None:
    for name in names:
        if getattr(args, name):
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def _check(dataset: Dataset, stride: int, depth: str) -> None:
    if depth == "recorded" and not dataset.has_depth:
        raise UsageError(f"{dataset.path}: has no recorded depth; replay it with --depth network")
    if stride >= len(dataset):
        raise UsageError(f"{dataset.path}: has {len(dataset)} frames, and none {stride} after another; lower --stride")


def _say_result(args: argparse.Namespace, result: Mapping[str, Any]) -> None:
    pairs = result["pairs"]
    estimated = [pair for pair in pairs if pair["estimated"]]
    say(
        f"{args.recording}: {len(pairs)} pairs of frames, {result['stride']} apart; flow {result['flow']}, depth "
        f"{result['depth']}"
    )
    say(f"estimated: {len(estimated)} ({100 * result['estimated_ratio']:.1f} %)")
    for name, unit, factor in (("rotation_error_deg", "deg", 1), ("translation_error_m", "cm", 100)):
        spread = {key: value for key, value in result[name].items() if value is not None}
        if spread:
            shown = ", ".join(f"{key} {factor * value:.2f} {unit}" for key, value in spread.items())
            say(f"{name.partition('_')[0]} error: {shown}")
    for pair in pairs:
        if not pair["estimated"]:
            say(f"not estimated: {pair['from']} to {pair['to']}: {pair['reason']}")
    if args.trajectory is not None:
        say(f"trajectory: {args.trajectory}")
