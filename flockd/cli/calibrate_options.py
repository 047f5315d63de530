"""What both commands of `flockd calibrate` have in common: options, the board, and where numbers come from."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.parser import Parser, positive_count, positive_number, size
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from flockd.ground.calibration.board import BoardSpec

SECONDS = 120.0
MARKER_SHARE = 0.75


def add_shared(parser: Parser, help_of_config: str) -> None:
    """Adds what both commands have."""
    parser.add_argument("--config", metavar="FILE", type=Path, help=help_of_config)
    parser.add_argument("--out", metavar="FILE", type=Path, help="where the result goes (CAMERA.yaml or rig.yaml)")
    parser.add_argument("--force", action="store_true", help="overwrite what is there")
    parser.add_argument("--every", metavar="N", type=positive_count, default=1, help="take every Nth frame (1)")
    parser.add_argument("--seconds", metavar="S", type=positive_number, default=SECONDS, help="of a live camera (120)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    board = parser.add_argument_group("the board", "as it was printed; measure it, printers shrink")
    board.add_argument("--squares", metavar="CxR", type=size, default=(7, 5), help="columns x rows (7x5)")
    board.add_argument("--square-mm", metavar="MM", type=positive_number, default=36.0, help="of a square's side (36)")
    board.add_argument("--marker-mm", metavar="MM", type=positive_number, help="of a marker's side (0.75 of a square)")
    board.add_argument("--dictionary", metavar="NAME", default="4x4_50", help="of the markers (4x4_50)")


def board_of(args: argparse.Namespace) -> BoardSpec:
    """The board of the options. Raises UsageError for one that cannot be."""
    from flockd.ground.calibration.board import BoardSpec
    from flockd.ground.calibration.errors import CalibrationError

    square_m = args.square_mm / 1000.0
    marker_m = args.marker_mm / 1000.0 if args.marker_mm else MARKER_SHARE * square_m
    try:
        return BoardSpec(args.squares[0], args.squares[1], square_m, marker_m, args.dictionary)
    except CalibrationError as error:
        raise UsageError(str(error)) from None


def refuse_overwriting(args: argparse.Namespace, *files: Path | None) -> None:
    """Raises UsageError where a result would take a file's place: before the work, not after it."""
    for file in files:
        if file is not None and file.exists() and not args.force:
            raise UsageError(f"{file}: exists; name another file, or overwrite it with --force")
        if file is not None and not file.parent.is_dir():
            raise UsageError(f"{file.parent}: is no folder; make it first, or name another file")


@contextmanager
def ended_by_ctrl_c(live: bool) -> Iterator[None]:
    """What was seen until then is enough."""
    try:
        yield
    except KeyboardInterrupt:
        if not live:
            raise


def source_name(args: argparse.Namespace) -> str:
    """Where the images come from."""
    return str(args.source or args.config)
