"""What commands that read a recording have in common: opening it, a part of it, and files that must not exist."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.output import progress
from flockd.cli.parser import Parser, positive_number
from flockd.core.errors import FlockdError, UsageError

if TYPE_CHECKING:
    from flockd.onboard.recording.reader import Recording


def require(*paths: Path) -> None:
    """Raises FlockdError for what is not there, before anything is imported that takes seconds."""
    for path in paths:
        if not path.exists():
            raise FlockdError(f"{path}: does not exist; check the path")


def add_stretch(parser: Parser) -> None:
    """Adds --start and --end, in seconds from the recording's first step."""
    parser.add_argument("--start", metavar="S", type=_seconds, default=0.0, help="seconds from the first step")
    parser.add_argument("--end", metavar="S", type=positive_number, help="seconds from the first step")


def _seconds(text: str) -> float:
    return 0.0 if text in {"0", "0.0"} else positive_number(text)


def stretch(recording: Recording, args: argparse.Namespace) -> tuple[float, float]:
    """From when to when, on the recording's clock, --start and --end ask for. Raises UsageError for nothing."""
    rounding_s = 1e-6
    end_s = recording.duration_s if args.end is None else args.end
    begin, end = recording.start_s + args.start - rounding_s, recording.start_s + end_s + rounding_s
    if not any(begin <= time_s <= end for _, time_s in recording.contents.steps):
        raise UsageError(
            f"{recording.path}: has no step from {args.start:g} s to {end_s:g} s, as it is "
            f"{recording.duration_s:g} s long; choose --start and --end within it"
        )
    return begin, end


def opened(path: Path) -> Recording:
    """The recording, checked as a whole, with a progress bar. Raises RecordingError."""
    from flockd.onboard.recording.reader import Recording

    with progress("checking", "bytes") as tell:
        return Recording(path, tell)


def refuse_existing(path: Path, option: str = "--out") -> None:
    """Raises UsageError when there is something at `path`, or no folder for it."""
    if path.exists():
        raise UsageError(f"{path}: exists; name a new file with {option}")
    if not path.parent.is_dir():
        raise UsageError(f"{path.parent}: is no folder; make it first, or name another file with {option}")
