"""`flockd calibrate rig`: where cameras sit beside each other, and what a flight found of them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.calibrate_options import (
    add_shared,
    board_of,
    ended_by_ctrl_c,
    refuse_overwriting,
    source_name,
)
from flockd.cli.config import loaded
from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Commands
from flockd.cli.recording_options import opened
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.ground.calibration.image_sources import ImageStream
    from flockd.ground.calibration.rig_session import RigSession


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate rig --config my_drone.yaml",
        "flockd calibrate rig pictures/ --config my_drone.yaml --reference front",
        "flockd calibrate rig --from-flight drone1.mcap",
    )
    description = (
        "Measure the cameras' mountings: relative poses, from a board that two of them see at once; or what a "
        "flight found of orientation in the body, time offset and focal length."
    )
    parser = commands("rig", description, examples)
    help_of_source = (
        "a folder with a folder of images for each camera, or a recording; by default --config's cameras, live"
    )
    parser.add_argument("source", metavar="SOURCE", nargs="?", help=help_of_source)
    parser.add_argument(
        "--reference", metavar="NAME", help="the camera whose mounting --config gives (default: the first)"
    )
    parser.add_argument(
        "--from-flight", metavar="RECORDING", type=Path, help="take over what this flight found of its own rig"
    )
    add_shared(parser, "the drone, with its cameras' intrinsics; a recording has its own")
    parser.set_defaults(run=_rig)


def _rig(args: argparse.Namespace) -> int:
    out = args.out or Path("rig.yaml")
    refuse_overwriting(args, out)
    return _by_board(args, out) if args.from_flight is None else _from_flight(args, out)


def _by_board(args: argparse.Namespace, out: Path) -> int:
    from flockd.ground.calibration.board import BoardFinder
    from flockd.ground.calibration.shared import SharedCollector

    session = _session(args)
    names = [camera.name for camera in session.config.rig.cameras]
    if len(names) < 2:
        raise UsageError(f"{session.where}: has one camera; a rig that is calibrated by a board has two or more")
    reference = args.reference or names[0]
    if reference not in names:
        raise UsageError(f"{session.where}: has no camera {reference!r}; choose --reference from {', '.join(names)}")
    collector = SharedCollector(BoardFinder(board_of(args)))
    with progress("detecting the board", "images") as on_image, ended_by_ctrl_c(session.images.live):
        session.collect_boards(
            collector, on_image, lambda links: complain(f"boards seen together: {links}; Ctrl-C ends it")
        )
    return _report(args, session.by_board(collector.boards, reference, out))


def _from_flight(args: argparse.Namespace, out: Path) -> int:
    from flockd.core.errors import ConfigError
    from flockd.ground.calibration.from_flight import corrected_rig

    if args.source is not None:
        raise UsageError("--from-flight names the recording; drop SOURCE")
    recording, config = opened(args.from_flight), loaded(args.config)
    if config is not None and config.rig != recording.config.rig:
        message = f"is not the rig that {args.from_flight} was flown with, which is what it found the errors of"
        raise ConfigError.at(str(args.config), f"{message}; drop --config", "rig")
    result = corrected_rig(recording, str(args.from_flight), out)
    if args.json:
        say_json(result)
        return ExitCode.DONE
    for name, one in result["cameras"].items():
        taken = " and ".join(one["taken"]) or "nothing"
        say(f"{name}: {one['found']}; taken over: {taken}")
    return _written(result)


def _session(args: argparse.Namespace) -> RigSession:
    from flockd.ground.calibration.rig_session import RigSession

    config, images = _images(args)
    return RigSession(config, str(args.config or args.source), source_name(args), images)


def _images(args: argparse.Namespace) -> tuple[DroneConfig, ImageStream]:
    """And the drone they are of: that of --config before that of the recording."""
    from flockd.ground.calibration import image_sources

    config = loaded(args.config)
    path = None if args.source is None else Path(args.source)
    if path is not None and not path.is_dir():
        found, recorded = image_sources.from_recording(opened(path), args.every)
        return config or recorded, found
    if config is None:
        raise UsageError("the cameras' intrinsics are not known; name the drone's file with --config")
    if path is None:
        return config, image_sources.from_cameras(config, str(args.config), args.seconds, lambda: False)
    return config, image_sources.from_folders(path, [camera.name for camera in config.rig.cameras])


def _report(args: argparse.Namespace, result: Mapping[str, Any]) -> int:
    if args.json:
        say_json(result)
        return ExitCode.DONE
    for name, one in result["cameras"].items():
        x, y, z = one["position_m"]
        if name == result["reference"]:
            say(f"{name}: is the reference and keeps its mounting")
            continue
        say(
            f"{name}: yaw {one['yaw_deg']:.2f} pitch {one['pitch_deg']:.2f} roll {one['roll_deg']:.2f} +- "
            f"{one['sigma_deg']:.2f} deg"
        )
        say(f"  position {x:.4f} {y:.4f} {z:.4f} +- {one['sigma_m']:.4f} m")
        say(f"  residual {one['residual_px']:.3f} px rms over {one['boards']} shared boards")
    for board, value in result["dropped"].items():
        say(f"dropped: {board}: its residual is {value:.2f} px, it does not fit the others")
    return _written(result)


def _written(result: Mapping[str, Any]) -> int:
    if result["time_offset_s"] is not None:
        say(f"time offset of the rig: {1000 * result['time_offset_s']:.1f} ms")
    for note in result["notes"]:
        say(f"note: {note}")
    say(f"written: {result['out']}; put it in place of rig in your drone's file, then run flockd config check on that")
    return ExitCode.DONE
