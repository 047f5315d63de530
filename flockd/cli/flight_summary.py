"""A flight's summary on the terminal: the report's headline and key figures, or JSON."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.output import Phases, say, say_json, say_table
from flockd.core.errors import ExitCode

if TYPE_CHECKING:
    from flockd.review.flight_log.log import FlightLog
    from flockd.sim.flock.swarm import Flight


def report_flight(directory: Path, flight: Flight, args: argparse.Namespace) -> int:
    """Saves a flight, writes its report with progress, and shows its summary as --json and --quiet say."""
    from flockd.review.report.flight_folder import REPORT_NAME, save_flight, write_report_files

    with Phases(quiet=args.quiet) as phases:
        save_flight(directory, flight.log, flight.key_frames)
        summary = write_report_files(directory, flight.log, phases.of("writing the report", "figures"))
    if args.quiet and not args.json:
        say(f"{directory / REPORT_NAME}")
        return ExitCode.DONE
    return show_summary(directory, flight.log, summary, as_json=args.json)


def show_summary(directory: Path, log: FlightLog, summary: Mapping[str, Any], *, as_json: bool) -> int:
    """Prints the summary as JSON, or what stands above the report's figures, and where that is."""
    from flockd.review.report.flight_folder import REPORT_NAME
    from flockd.review.report.page_texts import facts, headline

    if as_json:
        say_json(summary)
        return ExitCode.DONE
    say(headline(summary))
    say_table((), [(one["name"], f"{one['value']} {one['unit']}", one["remark"]) for one in facts(summary, log)])
    say(f"report: {directory / REPORT_NAME}")
    return ExitCode.DONE
