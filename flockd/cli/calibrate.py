"""`flockd calibrate`: measures the lenses of cameras by a board, and their mountings by a flight."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import camera_of, loaded, opened, refuse_overwriting
from flockd.cli.output import complain, progress, say_facts, say_result
from flockd.cli.parser import Commands, Parser, commands_of, existing, flag, option, positive_number, size
from flockd.core.choices import LENS_MODELS
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from flockd.ground.calibration.board import BoardSpec
    from flockd.ground.calibration.image_sources import ImageStream


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate camera --print-board board.svg",
        "flockd calibrate camera pictures/ --camera front",
        "flockd calibrate rig --from-flight drone1.mcap",
        "flockd calibrate import camchain.yaml",
    )
    commands = commands_of(commands("calibrate", "Measure the cameras: lenses, mountings, time offsets.", examples))
    _add_camera(commands)
    _add_rig(commands)
    _add_import(commands)


def _add_shared(parser: Parser, out: str = "rig.yaml") -> None:
    option(parser, "--out FILE", f"write the result to this file (default: {out})", Path)
    flag(parser, "--force", "overwrite existing files")
    flag(parser, "--json", "print the result as JSON")


def _board_of(args: argparse.Namespace) -> BoardSpec:
    """The board of the options. Raises UsageError for one that cannot be."""
    from flockd.ground.calibration.board import BoardSpec, CalibrationError

    columns, rows = args.squares
    try:
        return BoardSpec(columns, rows, args.square_mm / 1000.0, legacy=args.legacy)
    except CalibrationError as error:
        raise UsageError(str(error)) from None


def _add_camera(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate camera --print-board board.svg",
        "flockd calibrate camera pictures/ --camera front",
        "flockd calibrate camera pictures/ --camera left --model wide_angle",
        "flockd calibrate camera --config my_drone.yaml --camera front",
    )
    description = "Measure a camera's lens from views of a ChArUco board."
    parser = commands("camera", description, examples, _camera)
    option(parser, "SOURCE", "a folder of images (default: the live camera of --config)", existing, nargs="?")
    option(parser, "--camera NAME", "the camera's name in the rig")
    option(parser, "--model", "lens model (default: the simplest that fits)", choices=LENS_MODELS)
    option(parser, "--print-board FILE", "write the board to print (.svg)", Path)
    option(parser, "--config FILE", "the drone whose camera is used", existing)
    _add_shared(parser, "CAMERA.yaml")
    board = parser.add_argument_group("the board", "as it was printed; measure it, printers shrink")
    option(board, "--squares CxR", "columns x rows (default: 7x5)", size, default=(7, 5))
    option(board, "--square-mm MM", "side of a square, mm (default: 36)", positive_number, default=36.0)
    flag(board, "--legacy", "the board was made by OpenCV before 4.6")


def _camera(args: argparse.Namespace) -> int:
    board = _board_of(args)
    if args.print_board is not None:
        return _print_board(args, board)
    from flockd.ground.calibration.board import BoardFinder
    from flockd.ground.calibration.fragment import measured_today
    from flockd.ground.calibration.lens_fit import (
        collect_views,
        fit_lenses,
        is_enough,
        lens_result,
        simplest_that_fits,
        write_lens,
    )
    from flockd.ground.calibration.views import Collector

    collector = Collector(BoardFinder(board))
    source = str(args.source or args.config)
    name, images = _images(args, lambda: is_enough(collector))
    out = args.out or Path(f"{name}.yaml")
    refuse_overwriting(args, out)
    with progress("detecting the board", "images") as on_image:
        try:
            collect_views(images, collector, on_image, complain)
        except KeyboardInterrupt:
            if not images.live:  # else what was seen until then is enough
                raise
    lenses = fit_lenses(collector, args.model, source)
    lens = simplest_that_fits(lenses)
    measured = measured_today(
        camera=images.identity, source=source, views=len(lens.views), residual_px=round(lens.rms_px, 4)
    )
    intrinsics = write_lens(name, lens, measured, out).model_dump(mode="json")
    numbers = lens_result(lens, lenses, collector)
    result = {"camera": name, "intrinsics": intrinsics, **numbers, "out": str(out)}
    assert collector.coverage is not None
    return say_facts(
        args, result, "## where corners of the board were seen:", *collector.coverage.text,
        f"written: {out}; copy its intrinsics into your drone's file, then run flockd config check on that",
    )  # fmt: skip


def _print_board(args: argparse.Namespace, board: BoardSpec) -> int:
    from flockd.core.data import written_whole
    from flockd.ground.calibration.board import board_svg, page_mm

    file: Path = args.print_board
    refuse_overwriting(args, file)
    if file.suffix.lower() != ".svg":
        raise UsageError(f"{file}: a board is written as .svg, which browsers print; give it such a name")
    with written_whole(file) as draft:
        draft.write_text(board_svg(board), encoding="utf-8")
    page = "{:.0f} x {:.0f} mm".format(*page_mm(board))
    told = (
        f"{file}: print it at 100 % on paper of {page} or more, glue it to something flat, and measure a square: "
        f"{args.square_mm:g} mm, or say with --square-mm how large it became"
    )
    return say_result(args, {"board": str(file), "page": page}, told)


def _images(args: argparse.Namespace, enough: Callable[[], bool]) -> tuple[str, ImageStream]:
    """The images of the one camera that is meant, and its name."""
    from flockd.ground.calibration import image_sources

    config = loaded(args.config)
    if args.source is None:
        if config is None:
            raise UsageError("no SOURCE was given; name a folder of images, or --config for its camera")
        name = camera_of(config, args.camera, args.config)
        return name, image_sources.from_camera(config, str(args.config), name, enough)
    name = args.camera or "camera" if config is None else camera_of(config, args.camera, args.config)
    if not re.fullmatch("[a-z0-9_-]+", name):
        raise UsageError(f"--camera {name}: a camera's name has small letters, digits, _ and - only")
    if args.source.is_dir():
        return name, image_sources.from_folder(args.source)
    told = "is no folder of images; name one, or for a live camera the drone with --config"
    raise UsageError(f"{args.source}: {told}")


def _add_rig(commands: Commands) -> None:
    """Adds the command."""
    description = "Correct the rig by a recorded flight: the cameras' mountings, time offset and focal lengths."
    parser = commands("rig", description, ("flockd calibrate rig --from-flight drone1.mcap",), _rig)
    option(parser, "--from-flight RECORDING", "a recording of the flight, with its images", existing, required=True)
    _add_shared(parser)


def _rig(args: argparse.Namespace) -> int:
    from flockd.ground.calibration.from_flight import corrected_rig, found_rig

    out = args.out or Path("rig.yaml")
    refuse_overwriting(args, out)
    recording = opened(args.from_flight)
    with progress("replaying", "steps") as tell:
        found = found_rig(recording, progress=tell)
    result = corrected_rig(recording, found, str(args.from_flight), out)
    advice = "put it in place of rig in your drone's file, then run flockd config check on that"
    return say_facts(args, result, f"written: {out}; {advice}")


def _add_import(commands: Commands) -> None:
    """Adds the command."""
    examples = ("flockd calibrate import camchain.yaml", "flockd calibrate import lens.yml --size 640x480 --nearest")
    description = "Import the lenses of Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage or COLMAP's list."
    parser = commands("import", description, examples, _import)
    option(parser, "FILE", "the other program's file", existing)
    option(parser, "--size WxH", "size of the images, if the file does not contain it", size)
    flag(parser, "--nearest", "use the nearest lens model if flockd lacks the file's")
    _add_shared(parser)


def _import(args: argparse.Namespace) -> int:
    from flockd.core.data import written_whole
    from flockd.ground.calibration.foreign import camera_of_lens, foreign_lenses
    from flockd.ground.calibration.fragment import rig_text

    out = args.out or Path("rig.yaml")
    refuse_overwriting(args, out)
    lenses = foreign_lenses(args.file, args.size)
    found = [camera_of_lens(lens, args.file, nearest=args.nearest) for lens in lenses]
    comment = (
        f"Lenses of {args.file.name}, written by `flockd calibrate import`. Copy each `intrinsics` to the camera in",
        "your drone's file, measure the mountings, then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text([one.camera for one in found], comment), encoding="utf-8")
    cameras = [
        {**one.camera.model_dump(mode="json", exclude={"extrinsics"}), "off_deg": one.off_deg, "rms_deg": one.rms_deg}
        for one in found
    ]
    result = {"cameras": cameras, "out": str(out)}
    advice = "copy each camera's intrinsics into your drone's file, then run flockd config check on that"
    return say_facts(args, result, f"written: {out}; {advice}")
