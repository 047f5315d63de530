"""`flockd calibrate camera`: a camera's intrinsics from images of a board."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from flockd.choices import LENS_MODELS, PixelFormat
from flockd.cli.calibrate_options import (
    add_shared,
    board_of,
    ended_by_ctrl_c,
    measurement,
    pair,
    refuse_overwriting,
    source_name,
)
from flockd.cli.config import loaded
from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Commands, positive_count, positive_number
from flockd.cli.recording_options import opened
from flockd.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.calibration.board import BoardSpec
    from flockd.calibration.image_sources import ImageStream
    from flockd.calibration.intrinsics import Lens
    from flockd.calibration.views import Collector
    from flockd.config import DroneConfig
    from flockd.config.rig import MeasurementConfig

MOST_VIEWS = 60
ENOUGH_VIEWS, ENOUGH_SHARE = 20, 0.9
"""A live camera is looked through until there are so many views, which cover this share of the picture."""
NAMED = 6
"""How many of the refused pictures are named one by one."""


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
    parser.add_argument("--serial", metavar="TEXT", help="what identifies the camera, where it cannot be asked")
    parser.add_argument("--picture", metavar="FILE", type=Path, help="draw the coverage and the residuals (.png)")
    parser.add_argument("--size", metavar="WxH", type=pair, default=(640, 480), help="of a /dev/video (640x480)")
    parser.add_argument(
        "--pixel-format", choices=get_args(PixelFormat), default="mjpeg", help="of a /dev/video (mjpeg)"
    )
    parser.add_argument("--print-board", metavar="FILE", type=Path, help="write the board to print (.pdf, .png)")
    add_shared(parser, "the drone, for its camera's device and serial")
    parser.set_defaults(run=_camera)


def _camera(args: argparse.Namespace) -> int:
    board = board_of(args)
    if args.print_board is not None:
        return _print_board(args, board)
    from flockd.calibration.board import BoardFinder
    from flockd.calibration.intrinsics import simplest_that_fits
    from flockd.calibration.views import Collector

    collector = Collector(BoardFinder(board), args.views, args.max_blur)
    name, images = _images(args, lambda: _is_enough(collector))
    out = args.out or Path(f"{name}.yaml")
    refuse_overwriting(args, out, args.picture)
    _collect(images, name, collector)
    lenses = _lenses(args, collector)
    lens = simplest_that_fits(lenses)
    measured = measurement(
        camera=args.serial or images.identities[name],
        source=source_name(args),
        views=len(lens.views),
        residual_px=round(lens.rms_px, 4),
    )
    _write_lens(args, out, name, collector, lens, measured)
    result = _lens_result(collector, lens, lenses, name, out, measured)
    if args.json:
        say_json(result)
    else:
        _say_lens(result, collector)
    return ExitCode.DONE


def _print_board(args: argparse.Namespace, board: BoardSpec) -> int:
    from flockd.calibration.errors import CalibrationError
    from flockd.calibration.paper import board_file, page_of
    from flockd.recording.editing import written_whole

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
    """Of the one camera that is meant, and its name."""
    from flockd.calibration import image_sources
    from flockd.datasets.video import SUFFIXES

    config = loaded(args.config)
    path = None if args.source is None else Path(args.source)
    if path is None:
        if config is None:
            raise UsageError("no SOURCE was given; name images, a recording or a device, or --config for its camera")
        name = _name_in(config, args, str(args.config))
        return name, image_sources.from_cameras(_only(config, name), str(args.config), args.seconds, enough)
    if path.suffix.lower() == ".mcap":
        found, recorded = image_sources.from_recording(opened(path), args.every)
        return _name_in(recorded, args, str(path)), found
    name = args.camera or "camera" if config is None else _name_in(config, args, str(args.config))
    if not re.fullmatch("[a-z0-9_-]+", name):
        raise UsageError(f"--camera {name}: a camera's name has small letters, digits, _ and - only")
    if path.is_relative_to("/dev"):
        live = image_sources.device_config(str(path), name, args.size, args.pixel_format)
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


def _only(config: DroneConfig, name: str) -> DroneConfig:
    """The same drone with one camera."""
    rig = config.rig.model_copy(update={"cameras": tuple(one for one in config.rig.cameras if one.name == name)})
    source = config.source
    if source is not None and source.cameras:
        source = source.model_copy(update={"cameras": tuple(one for one in source.cameras if one.name == name)})
    return config.model_copy(update={"rig": rig, "source": source})


def _collect(images: ImageStream, name: str, collector: Collector) -> None:
    """Shows the collector everything; live, a person is told what to do next, and may end it with Ctrl-C."""
    told = ""
    with progress("detecting the board", "images") as tell, ended_by_ctrl_c(images.live):
        for number, one in enumerate(images.sets, start=1):
            if name in one.images:
                collector.offer(one.name, one.images[name], moving=images.live)
            tell(number, images.count or number)
            if images.live and (said := _next_step(collector)) != told:
                complain(said)
                told = said


def _next_step(collector: Collector) -> str:
    """For a person who holds a board before a live camera."""
    assert collector.coverage is not None
    assert collector.size is not None
    from flockd.calibration.intrinsics import rough_tilts_deg

    head = f"{len(collector.views)} views, {100 * collector.coverage.share:.0f} % covered"
    if not collector.views:
        return f"{head}: hold the board before the camera, and hold it still"
    advice = collector.coverage.advice(rough_tilts_deg(collector.views, collector.size, "wide_angle"))
    return f"{head}: {advice[0] if advice else 'go on, or end it with Ctrl-C'}"


def _is_enough(collector: Collector) -> bool:
    if len(collector.views) < ENOUGH_VIEWS or collector.coverage is None or collector.size is None:
        return False
    from flockd.calibration.intrinsics import rough_tilts_deg

    tilts = rough_tilts_deg(collector.views, collector.size, "wide_angle")
    return collector.coverage.share >= ENOUGH_SHARE and not collector.coverage.advice(tilts)


def _lenses(args: argparse.Namespace, collector: Collector) -> list[Lens]:
    """Of the model that was asked for, or of both as far as they fit, the simpler one first."""
    from flockd.calibration.errors import CalibrationError
    from flockd.calibration.intrinsics import calibrate

    counts = collector.counts()
    if collector.size is None:
        raise CalibrationError(f"{source_name(args)}: holds no image of the camera; name another source")
    if not collector.views:
        why = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        raise CalibrationError(
            f"{source_name(args)}: the board is in none of the {sum(counts.values())} images ({why}); check "
            "--squares and --dictionary, and that it fills a good part of the image"
        )
    found, faults = [], []
    for model in (args.model,) if args.model else LENS_MODELS:
        try:
            found.append(calibrate(collector.views, collector.size, model))
        except CalibrationError as error:
            faults.append(error)
    if not found:
        raise CalibrationError(f"{source_name(args)}: {faults[0]}")
    return found


def _write_lens(
    args: argparse.Namespace, out: Path, name: str, collector: Collector, lens: Lens, measured: MeasurementConfig
) -> None:
    import cv2
    import numpy as np

    from flockd.calibration.coverage import Plot, draw
    from flockd.calibration.fragment import intrinsics_of, rig_text
    from flockd.calibration.views import all_pixels
    from flockd.config.rig import CameraConfig
    from flockd.recording.editing import written_whole

    assert collector.coverage is not None
    camera = CameraConfig(name=name, size_px=lens.camera.size, intrinsics=intrinsics_of(lens, measured))
    comment = (
        f"The lens of camera {name}, written by `flockd calibrate camera`. Copy `intrinsics` to the camera of this",
        "name in your drone's file, then run `flockd config check` on that; this file too is a drone with one camera.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text((camera,), comment), encoding="utf-8")
    if args.picture is not None:
        residuals = np.concatenate(lens.residuals())
        title = f"{name}: {100 * collector.coverage.share:.0f} % covered, rms {lens.rms_px:.3f} px (lines: x 50)"
        picture = draw(collector.coverage, Plot(all_pixels(lens.views), residuals), title)
        with written_whole(args.picture) as draft:
            draft.write_bytes(bytes(cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]))


def _lens_result(
    collector: Collector, lens: Lens, lenses: Sequence[Lens], name: str, out: Path, measured: MeasurementConfig
) -> dict[str, Any]:
    from flockd.calibration.fragment import intrinsics_of

    assert collector.coverage is not None
    rms = lens.rms_of_views_px
    advice = list(collector.coverage.advice(lens.tilts_deg))
    if not lens.reaches_corners:
        advice.append("show the board in the corners of the image: the fitted lens does not reach them")
    sigma = {key: float(value) for key, value in zip(("fx", "fy", "cx", "cy"), lens.sigma, strict=False)}
    return {
        "camera": name,
        "size_px": list(lens.camera.size),
        "intrinsics": intrinsics_of(lens, measured).model_dump(mode="json"),
        "sigma_px": sigma,
        "field_of_view_deg": [angle if math.isfinite(angle) else None for angle in lens.field_of_view_deg],
        "residual_px": {"rms": lens.rms_px, "max": lens.max_px, "views": dict(zip(_names(lens), rms, strict=True))},
        "models": {one.model: {"rms_px": one.rms_px} for one in lenses},
        "coverage": collector.coverage.share,
        "views": len(lens.views),
        "refused": collector.counts(),
        "blurred": {one.name: one.edge_px for one in collector.refused if one.why == "blurred"},
        "dropped": {view.name: value for view, value in lens.dropped},
        "advice": advice,
        "out": str(out),
    }


def _names(lens: Lens) -> list[str]:
    return [view.name for view in lens.views]


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
    say(f"coverage: {100 * result['coverage']:.0f} %")
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
