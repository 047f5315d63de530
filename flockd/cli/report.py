"""`flockd report`: the report of a flight, from its log or from its recordings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

from flockd.cli.options import opened, refuse
from flockd.cli.output import complain, progress, show_summary
from flockd.cli.parser import Commands, existing, flag, option
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flockd.review.flight_log.key_frames import KeyFrame
    from flockd.review.flight_log.log import FlightLog

SUFFIX = ".report"
"""Ending of the folder beside a recording that its report goes to."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd report out/paper_flight-learned-seed0",
        "flockd report recordings",
        "flockd report kestrel-20261120T101500Z.mcap --out reports/kestrel",
        "flockd report drone1.mcap --without-pictures --json",
    )
    description = "Write the summary and the report of a flight, from its folder or from recordings."
    parser = commands("report", description, examples, _run)
    parser.add_argument(
        "flight",
        metavar="RECORDING",
        type=existing,
        help="a recording, a folder of them (each drone's newest), or the folder of a flight of `flockd sim`",
    )
    flag(parser, "--force", "overwrite an earlier report, or a flight in --out")
    option(parser, "--out DIR", f"folder of a recording's report (default: NAME{SUFFIX} beside it)", Path)
    flag(parser, "--without-pictures", "do not run the networks again for the report's images")
    flag(parser, "--json", "print the summary as JSON")


def _run(args: argparse.Namespace) -> int:
    from flockd.review.flight_log.log import FlightLog
    from flockd.review.report.flight_folder import (
        LOG_NAME,
        REPORT_NAME,
        prepare_report_folder,
        save_flight,
        write_report_files,
    )
    from flockd.review.report.summary import summarise

    directory: Path = args.flight
    if (directory / LOG_NAME).is_file():
        why = f"is for recordings, and {directory} is a flight's folder, whose report is written into it; drop it"
        refuse(args, ("out", "without_pictures"), why)
        try:
            log = FlightLog.load(directory / LOG_NAME)
        except (ValueError, EOFError, BadZipFile) as error:
            why = "no NumPy archive" if "pickle" in str(error) else str(error)  # numpy advises to load it all the same
            told = f"is not a whole flight log ({why}); fly again with `flockd sim`"
            raise UsageError(f"{directory / LOG_NAME}: {told}") from error
        if (directory / REPORT_NAME).is_file() and not args.force:
            complain(f"{directory / REPORT_NAME}: is left as it was; --force writes it again")
            return show_summary(directory, log, summarise(log), as_json=args.json)
    else:
        paths = _recordings(directory)
        named = paths[0] if len(paths) == 1 else directory
        directory = args.out or named.with_name(named.resolve().name.removesuffix(".mcap") + SUFFIX)
        with prepare_report_folder(directory, force=args.force):
            log, pictures = _flight(paths, pictured=not args.without_pictures)
        save_flight(directory, log, pictures)
    with progress("writing the report", "figures") as tell_progress:
        summary = write_report_files(directory, log, tell_progress)
    return show_summary(directory, log, summary, as_json=args.json)


def _recordings(path: Path) -> tuple[Path, ...]:
    """The recording that was named, or each drone's newest in the folder that was."""
    from flockd.review.report.flight_folder import LOG_NAME

    if not path.is_dir():
        return (path,)
    from flockd.review.flight_log.from_recordings import newest_recordings

    found, older = newest_recordings(path)
    if older:
        newest = ", ".join(one.name for one in found)
        complain(
            f"{path}: also holds {older} of earlier flights; this is of the newest, {newest}; name another for its own"
        )
    if not found:
        raise UsageError(f"{path}: holds neither a flight's {LOG_NAME} nor recordings; name another folder")
    return found


def _flight(paths: Sequence[Path], *, pictured: bool) -> tuple[FlightLog, tuple[KeyFrame, ...]]:
    from flockd.review.flight_log.from_recordings import flight_log, key_frames
    from flockd.review.replay.recorded_flight import damage_warnings, replay_warnings

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
