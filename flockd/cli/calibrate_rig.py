"""`flockd calibrate rig`: where cameras sit beside each other, how they are turned in the body, and their time."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.calibrate_options import (
    add_shared,
    board_of,
    ended_by_ctrl_c,
    measurement,
    refuse_overwriting,
    source_name,
)
from flockd.cli.config import loaded
from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Commands, positive_number
from flockd.cli.recording_options import opened
from flockd.errors import ConfigError, ConfigProblem, ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.calibration.alignment import Alignment
    from flockd.calibration.extrinsics import RigFit, SharedBoard
    from flockd.calibration.image_sources import ImageSet, ImageStream
    from flockd.config import DroneConfig
    from flockd.config.rig import CameraConfig
    from flockd.messages import UInt8Array, VehicleState

MAX_OFFSET_S = 0.3


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate rig --config my_drone.yaml",
        "flockd calibrate rig pictures/ --config my_drone.yaml --reference front",
        "flockd calibrate rig drone1.mcap --by motion",
    )
    description = (
        "Measure where cameras sit: beside each other, from a board that neighbours see together; or how they are "
        "turned in the body, and their time, from the autopilot's attitude in a recording."
    )
    parser = commands("rig", description, examples)
    help_of_source = "a folder with one of images for each camera, or a recording; by default --config's cameras, live"
    parser.add_argument("source", metavar="SOURCE", nargs="?", help=help_of_source)
    parser.add_argument("--by", choices=("board", "motion"), default="board", help="default: board")
    parser.add_argument("--reference", metavar="NAME", help="the camera that sits where --config says (the first)")
    help_of_offset = f"how far camera and autopilot may be apart ({MAX_OFFSET_S:g})"
    parser.add_argument("--max-offset", metavar="S", type=positive_number, default=MAX_OFFSET_S, help=help_of_offset)
    add_shared(parser, "the drone, with its cameras' intrinsics; a recording has its own")
    parser.set_defaults(run=_rig)


def _rig(args: argparse.Namespace) -> int:
    out = args.out or Path("rig.yaml")
    refuse_overwriting(args, out)
    return _by_motion(args, out) if args.by == "motion" else _by_board(args, out)


def _by_board(args: argparse.Namespace, out: Path) -> int:
    from flockd.calibration.extrinsics import calibrate_rig
    from flockd.geometry import build_rig

    config, images = _images(args)
    where, names = str(args.config or args.source), [camera.name for camera in config.rig.cameras]
    if len(names) < 2:
        raise UsageError(f"{where}: has one camera; a rig that is calibrated by a board has two or more")
    reference = args.reference or names[0]
    if reference not in names:
        raise UsageError(f"{where}: has no camera {reference!r}; choose --reference from {', '.join(names)}")
    boards = _boards(args, config, images)
    rig = build_rig(config.rig).cameras
    cameras = {name: one.camera for name, one in rig.items()}
    fit = calibrate_rig(cameras, boards, reference, rig[reference].T_body_camera)
    return _told(args, _rig_of_boards(args, config, images, fit, out))


def _images(args: argparse.Namespace) -> tuple[DroneConfig, ImageStream]:
    """And the drone they are of: that of --config before that of the recording."""
    from flockd.calibration import image_sources

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


def _boards(args: argparse.Namespace, config: DroneConfig, images: ImageStream) -> list[SharedBoard]:
    """Live, a person is told who saw it together, and ends it with Ctrl-C."""
    from flockd.calibration.board import BoardFinder
    from flockd.calibration.shared import SharedCollector

    collector = SharedCollector(BoardFinder(board_of(args)))
    told = ""
    with progress("detecting the board", "images") as tell, ended_by_ctrl_c(images.live):
        for number, one in enumerate(images.sets, start=1):
            collector.offer(one.name, _greys(args, config, one), moving=images.live)
            tell(number, images.count or number)
            said = "; ".join(f"{' and '.join(names)} saw {count}" for names, count in collector.links().items())
            if images.live and said != told:
                complain(f"boards seen together: {said}; Ctrl-C ends it")
                told = said
    return collector.boards


def _greys(args: argparse.Namespace, config: DroneConfig, one: ImageSet) -> dict[str, UInt8Array]:
    """By camera, (h, w). Raises ConfigError for an image of another size than the camera's."""
    import cv2
    import numpy as np

    greys = {}
    for camera in config.rig.cameras:
        if camera.name in one.images:
            image = one.images[camera.name]
            if image.shape[1::-1] != camera.size_px:
                width, height = camera.size_px
                message = (
                    f"of camera {camera.name!r} is {width} x {height}, and its picture {one.name} has "
                    f"{image.shape[1]} x {image.shape[0]} pixels; calibrate the lens for that size"
                )
                raise ConfigError([ConfigProblem(str(args.config or args.source), 0, "rig.cameras: size_px", message)])
            greys[camera.name] = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return greys


def _rig_of_boards(
    args: argparse.Namespace, config: DroneConfig, images: ImageStream, fit: RigFit, out: Path
) -> dict[str, Any]:
    from flockd.calibration.fragment import extrinsics_of

    source = f"{source_name(args)}, against {fit.reference}"
    cameras, told = [], {}
    for camera in config.rig.cameras:
        mounting = fit.mountings[camera.name]
        extrinsics = camera.extrinsics
        if camera.name != fit.reference:
            measured = measurement(
                camera=_identity(camera, images),
                source=source,
                views=mounting.boards,
                residual_px=round(mounting.rms_px, 4),
            )
            extrinsics = extrinsics_of(mounting.T_body_camera, measured)
        cameras.append(camera.model_copy(update={"extrinsics": extrinsics}))
        told[camera.name] = {
            **extrinsics.model_dump(mode="json", exclude={"measured"}),
            "sigma_deg": mounting.sigma_deg,
            "sigma_m": mounting.sigma_m,
            "residual_px": mounting.rms_px,
            "boards": mounting.boards,
        }
    notes = [
        f"{fit.reference} sits where {args.config or args.source} says, and the others beside it: a board cannot tell "
        "where in the body that is, but `--by motion` tells how it is turned"
    ]
    _write_rig(out, cameras, config.rig.time_offset_s)
    return {
        "by": "board",
        "reference": fit.reference,
        "residual_px": fit.rms_px,
        "dropped": dict(fit.dropped),
        "cameras": told,
        "time_offset_s": None,
        "notes": notes,
        "out": str(out),
    }


def _identity(camera: CameraConfig, images: ImageStream) -> str:
    measured = camera.intrinsics.measured
    return measured.camera if measured else images.identities.get(camera.name, camera.name)


def _by_motion(args: argparse.Namespace, out: Path) -> int:
    import numpy as np

    from flockd.calibration.alignment import Attitudes, align
    from flockd.calibration.errors import CalibrationError
    from flockd.calibration.turns import Follower
    from flockd.geometry import build_rig

    if args.source is None or Path(args.source).is_dir():
        raise UsageError("motion is measured in a recording, which knows the autopilot's attitude; name one as SOURCE")
    config, images = _images(args)
    rig = build_rig(config.rig).cameras
    followers = {name: Follower(one.camera, one.T_body_camera.rotation) for name, one in rig.items()}
    states: list[VehicleState] = []
    with progress("tracking features", "steps") as tell:
        for number, one in enumerate(images.sets, start=1):
            assert one.vehicle is not None  # a recording has one in each step
            if not states or one.vehicle.time_s > states[-1].time_s:
                states.append(one.vehicle)
            for name, grey in _greys(args, config, one).items():
                followers[name].add(one.times_s[name], grey, one.vehicle.R_ned_body)
            tell(number, images.count)
    attitudes = Attitudes(
        np.array([state.time_s for state in states]), np.array([state.R_ned_body for state in states])
    )
    found: dict[str, Alignment] = {}
    for name, follower in followers.items():
        try:
            found[name] = align(follower.turns, attitudes, args.max_offset)
        except CalibrationError as error:
            lost = ", ".join(f"{reason}: {count} times" for reason, count in follower.lost.items())
            raise CalibrationError(
                f"{args.source}: camera {name!r}: {error}" + (f" (not followed: {lost})" if lost else "")
            ) from None
    return _told(args, _rig_of_motion(args, config, images, found, out))


def _rig_of_motion(
    args: argparse.Namespace, config: DroneConfig, images: ImageStream, found: Mapping[str, Alignment], out: Path
) -> dict[str, Any]:
    from flockd.calibration.fragment import extrinsics_of
    from flockd.geometry import RigidTransform, build_rig

    rig = build_rig(config.rig)
    offset_s = sum(one.time_offset_s / one.sigma_s**2 for one in found.values())
    offset_s /= sum(1.0 / one.sigma_s**2 for one in found.values())
    cameras, told = [], {}
    for camera in config.rig.cameras:
        one = found[camera.name]
        T_body_camera = RigidTransform(one.R_body_camera, rig.cameras[camera.name].T_body_camera.translation)
        measured = measurement(
            camera=_identity(camera, images),
            source=f"{args.source}, by motion",
            views=one.turns,
            residual_deg=round(one.rms_deg, 4),
        )
        extrinsics = extrinsics_of(T_body_camera, measured)
        cameras.append(camera.model_copy(update={"extrinsics": extrinsics}))
        told[camera.name] = {
            **extrinsics.model_dump(mode="json", exclude={"measured"}),
            "sigma_deg": one.sigma_deg,
            "residual_deg": one.rms_deg,
            "turns": one.turns,
            "time_offset_s": one.time_offset_s,
            "sigma_s": one.sigma_s,
        }
    notes = [
        "position_m is kept from the configuration: attitude says nothing of where a camera sits; measure it, or show "
        "neighbouring cameras a board"
    ]
    worst = max(found, key=lambda name: abs(found[name].time_offset_s - offset_s))
    apart_s = abs(found[worst].time_offset_s - offset_s)
    if apart_s > max(5e-3, 4.0 * found[worst].sigma_s):
        notes.append(
            f"the time of camera {worst!r} is {1000 * apart_s:.0f} ms off the others'; the offset is their mean"
        )
    _write_rig(out, cameras, round(offset_s, 4))
    return {
        "by": "motion",
        "reference": None,
        "cameras": told,
        "time_offset_s": offset_s,
        "notes": notes,
        "out": str(out),
    }


def _write_rig(out: Path, cameras: Sequence[CameraConfig], time_offset_s: float) -> None:
    from flockd.calibration.fragment import rig_text
    from flockd.recording.editing import written_whole

    comment = (
        "The cameras of a drone, written by `flockd calibrate rig`. Put this in place of `rig` in your drone's file,",
        "then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text(cameras, comment, time_offset_s), encoding="utf-8")


def _told(args: argparse.Namespace, result: Mapping[str, Any]) -> int:
    if args.json:
        say_json(result)
        return ExitCode.DONE
    for name, one in result["cameras"].items():
        x, y, z = one["position_m"]
        if name == result["reference"]:
            say(f"{name}: is the reference, and stays where it is")
            continue
        say(
            f"{name}: yaw {one['yaw_deg']:.2f} pitch {one['pitch_deg']:.2f} roll {one['roll_deg']:.2f} +- "
            f"{one['sigma_deg']:.2f} deg"
        )
        if result["by"] == "board":
            say(f"  position {x:.4f} {y:.4f} {z:.4f} +- {one['sigma_m']:.4f} m")
            say(f"  residual {one['residual_px']:.3f} px rms over {one['boards']} shared boards")
        else:
            say(f"  residual {one['residual_deg']:.3f} deg rms over {one['turns']} turns")
            say(f"  time offset {1000 * one['time_offset_s']:.1f} +- {1000 * one['sigma_s']:.1f} ms")
    for board, value in result.get("dropped", {}).items():
        say(f"dropped: {board}: its residual is {value:.2f} px, it does not fit the others")
    if result["time_offset_s"] is not None:
        say(f"time offset of the rig: {1000 * result['time_offset_s']:.1f} ms")
    for note in result["notes"]:
        say(f"note: {note}")
    say(f"written: {result['out']}; put it in place of rig in your drone's file, then run flockd config check on that")
    return ExitCode.DONE
