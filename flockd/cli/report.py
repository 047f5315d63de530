"""`flockd report`: the report of a flight, from its log or from its recordings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

from flockd.cli.flight_summary import show_summary
from flockd.cli.output import complain, progress
from flockd.cli.parser import Commands
from flockd.cli.recording_options import opened
from flockd.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flockd.flight_log.key_frames import KeyFrame
    from flockd.flight_log.log import FlightLog

SUFFIX = ".report"
"""Of the folder beside a recording that its report goes to."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd report out/paper_flight-learned-seed0",
        "flockd report out/short/recordings",
        "flockd report kestrel-20261120T101500Z.mcap --out reports/kestrel",
        "flockd report drone1.mcap --without-pictures --json",
    )
    description = "Write the summary and the report of a flight, from its folder or from recordings."
    parser = commands("report", description, examples)
    parser.add_argument(
        "flight",
        metavar="RECORDING",
        type=Path,
        help="a recording, a folder of one flight's, or what `flockd sim` wrote",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"of a recording's report; default: NAME{SUFFIX}")
    parser.add_argument(
        "--without-pictures",
        action="store_true",
        help="do not run the networks again for the report's images",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    from flockd.report.flight_folder import LOG_NAME, check_folder, prepare_folder, save_flight, write_report_files

    if (args.flight / LOG_NAME).is_file():
        return _again(args)
    paths = _recordings(args.flight)
    directory = args.out or args.flight.with_name(args.flight.resolve().name.removesuffix(".mcap") + SUFFIX)
    check_folder(directory)
    log, pictures = _flight(paths, pictured=not args.without_pictures)
    prepare_folder(directory)
    save_flight(directory, log, pictures)
    return show_summary(directory, write_report_files(directory, log), as_json=args.json)


def _again(args: argparse.Namespace) -> int:
    """The report of a flight whose folder has its log."""
    from flockd.report.flight_folder import LOG_NAME, write_report_files

    for option in ("out", "without_pictures"):
        if getattr(args, option):
            raise UsageError(f"--{option.replace('_', '-')} is for recordings, and {args.flight} has a flight's log")
    from flockd.flight_log.log import FlightLog

    path = args.flight / LOG_NAME
    try:
        log = FlightLog.load(path)
    except (ValueError, EOFError, BadZipFile) as error:
        raise UsageError(f"{path}: is not a whole flight log ({error}); fly again with `flockd sim`") from error
    return show_summary(args.flight, write_report_files(args.flight, log), as_json=args.json)


def _recordings(path: Path) -> tuple[Path, ...]:
    """The recording that was named, or all in the folder that was."""
    from flockd.report.flight_folder import LOG_NAME

    if not path.is_dir():
        return (path,)
    from flockd.flight_log.from_recordings import recordings_in

    found = recordings_in(path)
    if not found:
        raise UsageError(f"{path}: holds neither a flight's {LOG_NAME} nor recordings; name another folder")
    return found


def _flight(paths: Sequence[Path], *, pictured: bool) -> tuple[FlightLog, tuple[KeyFrame, ...]]:
    from flockd.flight_log.from_recordings import flight_log, key_frames
    from flockd.replay.fidelity import damage_warnings, replay_warnings

    recordings = [opened(path) for path in paths]
    for recording in recordings:
        for fault in damage_warnings(recording):
            complain(fault)
    with progress("reading", "steps") as tell_progress:
        log = flight_log(recordings, tell_progress)
    if not pictured:
        return log, ()
    first = min(recordings, key=lambda recording: (log.metadata.names or []).index(recording.drone))
    for change in replay_warnings(first, first.config, first.start_s):
        complain(change)
    with progress("computing the images again", "steps") as tell_progress:
        return log, key_frames(first, log, tell_progress)
