"""`flockd calibrate camera`: a camera's intrinsics from images of a board."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from flockd.cli.calibrate_options import (
    add_shared,
    board_of,
    ended_by_ctrl_c,
    refuse_overwriting,
    source_name,
)
from flockd.cli.config import loaded
from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Commands, positive_count, positive_number, size
from flockd.cli.recording_options import opened
from flockd.core.choices import LENS_MODELS, PixelFormat
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.ground.calibration.board import BoardSpec
    from flockd.ground.calibration.image_sources import ImageStream
    from flockd.ground.calibration.views import Collector

MOST_VIEWS = 60
NAMED = 6
"""How many of the refused images are named one by one."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate camera --print-board board.pdf",
        "flockd calibrate camera pictures/ --camera front --picture coverage.png",
        "flockd calibrate camera clip.mp4 --every 5 --model wide_angle",
        "flockd calibrate camera drone1.mcap --camera left",
        "flockd calibrate camera /dev/video0 --size 640x480",
        "flockd calibrate camera --config my_drone.yaml --camera front",
    )
    description = "Measure a camera's lens from views of a ChArUco board."
    parser = commands("camera", description, examples)
    help_of_source = "a folder of images, a video, a recording or a /dev/video; by default --config's own camera, live"
    parser.add_argument("source", metavar="SOURCE", nargs="?", help=help_of_source)
    parser.add_argument("--camera", metavar="NAME", help="the camera's name in the rig")
    parser.add_argument("--model", choices=LENS_MODELS, help="default: pinhole, unless the other fits clearly better")
    parser.add_argument(
        "--views", metavar="N", type=positive_count, default=MOST_VIEWS, help="use N views at most (60)"
    )
    parser.add_argument("--max-blur", metavar="PX", type=positive_number, help="widest edge of a sharp view (4)")
    parser.add_argument(
        "--serial", metavar="TEXT", help="the camera's serial number, where the device does not give it"
    )
    parser.add_argument("--picture", metavar="FILE", type=Path, help="draw the coverage and the residuals (.png)")
    parser.add_argument("--size", metavar="WxH", type=size, default=(640, 480), help="of a /dev/video (640x480)")
    parser.add_argument(
        "--pixel-format", choices=get_args(PixelFormat), default="mjpeg", help="of a /dev/video (mjpeg)"
    )
    parser.add_argument(
        "--turn-deg", type=int, choices=(0, 90, 180, 270), default=0,
        help="of a /dev/video: clockwise, what makes up up in its images, as in the drone's file; --size is as turned",
    )  # fmt: skip
    parser.add_argument("--print-board", metavar="FILE", type=Path, help="write the board to print (.pdf, .png)")
    add_shared(parser, "the drone, for its camera's device and serial")
    parser.set_defaults(run=_camera)


def _camera(args: argparse.Namespace) -> int:
    board = board_of(args)
    if args.print_board is not None:
        return _print_board(args, board)
    from flockd.ground.calibration.board import BoardFinder
    from flockd.ground.calibration.fragment import measured_today
    from flockd.ground.calibration.intrinsics import simplest_that_fits
    from flockd.ground.calibration.lens_session import CalibratedLens, collect_views, fit_lenses, is_enough
    from flockd.ground.calibration.views import Collector

    collector = Collector(BoardFinder(board), args.views, args.max_blur)
    name, images = _images(args, lambda: is_enough(collector))
    out = args.out or Path(f"{name}.yaml")
    refuse_overwriting(args, out, args.picture)
    with progress("detecting the board", "images") as on_image, ended_by_ctrl_c(images.live):
        collect_views(images, name, collector, on_image, complain)
    lenses = fit_lenses(collector, args.model, source_name(args))
    lens = simplest_that_fits(lenses)
    measured = measured_today(
        camera=args.serial or images.identities[name],
        source=source_name(args),
        views=len(lens.views),
        residual_px=round(lens.rms_px, 4),
    )
    calibrated = CalibratedLens(name, collector, lens, lenses, measured)
    calibrated.write(out, args.picture)
    result = calibrated.as_json(out)
    if args.json:
        say_json(result)
    else:
        _say_lens(result, collector)
    return ExitCode.DONE


def _print_board(args: argparse.Namespace, board: BoardSpec) -> int:
    from flockd.ground.calibration.errors import CalibrationError
    from flockd.ground.calibration.paper import board_file, page_of
    from flockd.onboard.recording.editing import written_whole

    file: Path = args.print_board
    refuse_overwriting(args, file)
    try:
        data = board_file(board, file.suffix)
    except CalibrationError as error:
        raise UsageError(f"{file}: {error}") from None
    with written_whole(file) as draft:
        draft.write_bytes(data)
    if args.json:
        say_json({"board": str(file), "page": page_of(board)})
    else:
        say(
            f"{file}: print it at 100 % on {page_of(board)}, glue it to something flat, and measure a square: "
            f"{args.square_mm:g} mm, or say with --square-mm how large it became"
        )
    return ExitCode.DONE


def _images(args: argparse.Namespace, enough: Callable[[], bool]) -> tuple[str, ImageStream]:
    """The images of the one camera that is meant, and its name."""
    from flockd.ground.calibration import image_sources
    from flockd.ground.datasets.video import SUFFIXES

    config = loaded(args.config)
    path = None if args.source is None else Path(args.source)
    if path is None:
        if config is None:
            raise UsageError("no SOURCE was given; name images, a recording or a device, or --config for its camera")
        name = _name_in(config, args, str(args.config))
        return name, image_sources.from_cameras(
            image_sources.with_one_camera(config, name), str(args.config), args.seconds, enough
        )
    if path.suffix.lower() == ".mcap":
        found, recorded = image_sources.from_recording(opened(path), args.every)
        return _name_in(recorded, args, str(path)), found
    name = args.camera or "camera" if config is None else _name_in(config, args, str(args.config))
    if not re.fullmatch("[a-z0-9_-]+", name):
        raise UsageError(f"--camera {name}: a camera's name has small letters, digits, _ and - only")
    if path.is_relative_to("/dev"):
        live = image_sources.device_config(str(path), name, args.size, args.pixel_format, args.turn_deg)
        return name, image_sources.from_cameras(live, str(path), args.seconds, enough)
    if path.is_dir():
        return name, image_sources.from_folder(path, name)
    if path.suffix.lower() in SUFFIXES and path.is_file():
        return name, image_sources.from_video(path, name, args.every)
    fault = "is no folder, video or recording; name one of these" if path.exists() else "does not exist; check the path"
    raise UsageError(f"{path}: {fault}")


def _name_in(config: DroneConfig, args: argparse.Namespace, where: str) -> str:
    names = [camera.name for camera in config.rig.cameras]
    name: str | None = args.camera or (names[0] if len(names) == 1 else None)
    if name is None or name not in names:
        said = "has several cameras" if name is None else f"has no camera {name!r}"
        raise UsageError(f"{where}: {said}; choose with --camera from {', '.join(names)}")
    return name


def _say_lens(result: Mapping[str, Any], collector: Collector) -> None:
    lens, rms = result["intrinsics"], result["residual_px"]
    views = rms["views"].values()
    say(f"{result['camera']}: {result['views']} views of the board, {' x '.join(map(str, result['size_px']))} pixels")
    _say_refused(collector)
    for view, value in result["dropped"].items():
        say(f"dropped: {view}: its residual is {value:.2f} px, it does not fit the others")
    others = [f"{name} {one['rms_px']:.3f} px" for name, one in result["models"].items() if name != lens["model"]]
    beside = f" (residual with {', '.join(others)})" if others else ""
    say(f"model: {lens['model']}{beside}")
    for key, value in result["sigma_px"].items():
        say(f"  {key} {lens[key]:.2f} +- {value:.2f} px")
    say(f"  distortion {' '.join(f'{k:.5f}' for k in lens['distortion'])}")
    across, down = (f"{angle:.1f}" if angle is not None else "?" for angle in result["field_of_view_deg"])
    say(f"  field of view {across} x {down} degrees")
    say(f"residual: rms {rms['rms']:.3f} px; of a view {min(views):.3f} to {max(views):.3f}; max {rms['max']:.2f}")
    assert collector.coverage is not None
    say(f"coverage: {100 * result['coverage']:.0f} % of the image; ## where corners of the board were seen")
    for line in collector.coverage.text:
        say(f"  {line}")
    for sentence in result["advice"]:
        say(f"better: {sentence}")
    say(f"written: {result['out']}; copy its intrinsics into your drone's file, then run flockd config check on that")


def _say_refused(collector: Collector) -> None:
    for reason, count in collector.counts().items():
        names = [
            one.name if one.edge_px is None else f"{one.name} (edges {one.edge_px:.1f} px wide)"
            for one in collector.refused
            if one.why == reason
        ]
        more = f" and {count - NAMED} more" if count > NAMED else ""
        limit = f", as edges wider than {collector.max_edge_px:.1f} px are" if reason == "blurred" else ""
        say(f"refused: {count} {reason}{limit}: {', '.join(names[:NAMED])}{more}")
