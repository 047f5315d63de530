"""`flockd replay` of what others recorded: the pilot's own motion from pairs of frames, measured against the poses."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Parser, positive_count
from flockd.cli.record import refuse_existing
from flockd.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.config import DroneConfig
    from flockd.datasets import Dataset
    from flockd.datasets.pair_motion import Pair

_ANY_ACCELERATION_M_S2 = 1e9
"""A camera in somebody's hand keeps to no drone's limits."""
_STRIDE_PX = 6
"""One camera has to do for the four of a drone."""
_OF_RECORDINGS = ("speed", "start", "end", "out", "diff", "reference", "update_reference", "tolerance")
_OF_DATASETS = ("depth", "stride", "flow", "calibration", "trajectory")


def add_dataset_options(parser: Parser) -> None:
    """Adds what only replays of datasets have."""
    group = parser.add_argument_group("datasets", "a folder with images, depth and poses, or a video, as RECORDING")
    group.add_argument("--depth", choices=("recorded", "network"), help="whose depth is used (default: network)")
    group.add_argument("--stride", metavar="N", type=positive_count, help="pair frame i with frame i + N (default: 1)")
    group.add_argument("--flow", metavar="NAME", help="use this flow model, or `dis`")
    group.add_argument("--calibration", metavar="FILE", type=Path, help="K.txt, or a drone's YAML with one camera")
    group.add_argument("--trajectory", metavar="FILE", type=Path, help="write the integrated path in TUM format")


def refuse_dataset_options(args: argparse.Namespace) -> None:
    """Raises UsageError where a recording is to be replayed like a dataset."""
    _refuse(args, _OF_DATASETS, "is for datasets; a recording of flockd knows it by itself, or takes it from --config")


def replay_dataset(args: argparse.Namespace) -> int:
    """Runs the command for a dataset."""
    _refuse(args, _OF_RECORDINGS, "is for recordings of flockd, and this is none; leave it out")
    if args.trajectory is not None:
        refuse_existing(args.trajectory, "--trajectory")
    from flockd.datasets import open_dataset

    stride, depth = args.stride or 1, args.depth or "network"
    dataset = open_dataset(args.recording, args.calibration)
    _check(dataset, stride, depth)
    config, notes = _config(args, dataset)
    for note in (*dataset.notes, *notes):
        complain(note)
    pairs = _fly(dataset, config, stride, recorded_depth=depth == "recorded")
    result = {**_result(pairs), "stride": stride, "depth": depth, "flow": config.perception.flow}
    if args.trajectory is not None:
        _write_trajectory(args.trajectory, pairs, stride)
    if args.json:
        say_json(result)
    else:
        _say_result(args, result)
    if not any(pair.found for pair in pairs):
        complain(f"{dataset.path}: no motion could be estimated: {pairs[0].reason}")
        return ExitCode.CHECK_FAILED
    return ExitCode.DONE


def _refuse(args: argparse.Namespace, names: Sequence[str], why: str) -> None:
    for name in names:
        if getattr(args, name):
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def _check(dataset: Dataset, stride: int, depth: str) -> None:
    if depth == "recorded" and not dataset.has_depth:
        raise UsageError(f"{dataset.path}: has no recorded depth; replay it with --depth network")
    if depth == "recorded" and dataset.camera.intrinsics.model != "pinhole":
        raise UsageError(
            f"{dataset.path}: recorded depth is along the optical axis, which a wide-angle camera does not use; "
            "replay it with --depth network"
        )
    if stride >= len(dataset):
        raise UsageError(f"{dataset.path}: has {len(dataset)} frames, and none {stride} after another; lower --stride")


def _config(args: argparse.Namespace, dataset: Dataset) -> tuple[DroneConfig, list[str]]:
    """The settings to fly with, for the dataset's camera, and what was changed in them."""
    from flockd.config import DroneConfig, ScenarioConfig, load
    from flockd.config.geometry import GeometryParameters
    from flockd.config.perception import PerceptionConfig
    from flockd.config.rig import RigConfig

    rig = RigConfig(cameras=(dataset.camera,))
    notes = []
    if args.config is None:
        geometry = GeometryParameters(
            max_acceleration_m_s2=_ANY_ACCELERATION_M_S2,
            background_stride_px=_STRIDE_PX,
            # The polish trusts depth as little as a network's deserves; a sensor's is better than that.
            refine=args.depth != "recorded",
        )
        perception = PerceptionConfig(scale="network", flow_refinement="dis")
        config = DroneConfig(rig=rig, geometry=geometry, perception=perception)
    else:
        loaded = load(args.config)
        config = loaded.drone if isinstance(loaded, ScenarioConfig) else loaded
        scale = config.perception.scale
        if scale != "network":
            notes.append(
                f"{args.config}: perception.scale: there is no autopilot's {scale} here; the network's is used"
            )
    changes = {"scale": "network", "flow": args.flow or config.perception.flow}
    update = {"rig": rig, "source": None, "perception": config.perception.model_copy(update=changes)}
    return config.model_copy(update=update), notes


def _fly(dataset: Dataset, config: DroneConfig, stride: int, *, recorded_depth: bool) -> list[Pair]:
    from flockd.datasets.pair_motion import fly_pairs
    from flockd.pilot.pilot import load_perception

    pairs: list[Pair] = []
    with ExitStack() as stack:
        tell = stack.enter_context(progress("replaying", "pairs"))
        learned = load_perception(config)
        for pair in fly_pairs(dataset, config, learned, stride=stride, recorded_depth=recorded_depth):
            pairs.append(pair)
            tell(len(pairs), len(dataset) - stride)
    return pairs


def _result(pairs: Sequence[Pair]) -> dict[str, Any]:
    errors = [pair.error for pair in pairs if pair.error]
    return {
        "pairs": [_told(pair) for pair in pairs],
        "rotation_error_deg": _spread([rotation for rotation, _ in errors]),
        "translation_error_m": _spread([translation for _, translation in errors]),
        "estimated_ratio": sum(pair.found is not None for pair in pairs) / len(pairs),
    }


def _told(pair: Pair) -> dict[str, Any]:
    from flockd.datasets.pair_motion import size_of

    true_rotation, true_translation = size_of(pair.true) if pair.true else (None, None)
    rotation_error, translation_error = pair.error or (None, None)
    return {
        "from": pair.before.index,
        "to": pair.after.index,
        "true_rotation_deg": true_rotation,
        "true_translation_m": true_translation,
        "rotation_error_deg": rotation_error,
        "translation_error_m": translation_error,
        "inlier_ratio": pair.inlier_ratio,
        "estimated": pair.found is not None,
        "reason": pair.reason,
    }


def _spread(samples: Sequence[float]) -> dict[str, float | None]:
    """None where there is nothing to tell."""
    import numpy as np

    if not samples:
        return {"median": None, "p95": None, "max": None}
    median, p95, largest = np.percentile(samples, (50, 95, 100))
    return {"median": float(median), "p95": float(p95), "max": float(largest)}


def _write_trajectory(path: Path, pairs: Sequence[Pair], stride: int) -> None:
    from flockd.datasets.trajectory import integrate, tum_text
    from flockd.recording.editing import written_whole

    track, broken = integrate(pairs, stride)
    if broken is not None:
        complain(
            f"{path}: ends at frame {broken.before.index}, as the motion to frame {broken.after.index} could not be "
            f"estimated: {broken.reason}"
        )
    with written_whole(path) as draft:
        draft.write_text(tum_text(track), encoding="utf-8")


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
