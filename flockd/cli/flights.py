"""The folder of a flight: its log, its summary, its report, and what a person is told of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.output import say, say_json
from flockd.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.flight_log.key_frames import KeyFrame
    from flockd.flight_log.log import FlightLog

LOG_NAME = "flight.npz"
FILMSTRIP_NAME = "filmstrip.npz"
SUMMARY_NAME = "summary.json"
REPORT_NAME = "report.html"
FLEET_LOGS = "logs"
"""What the programs of a fleet wrote and flew with."""


def prepare(directory: Path) -> None:
    """Makes the folder; raises UsageError when it holds something else than an earlier flight."""
    check(directory)
    directory.mkdir(parents=True, exist_ok=True)


def check(directory: Path) -> None:
    """Raises UsageError when a folder holds something else than an earlier flight."""
    if directory.exists() and not directory.is_dir():
        raise UsageError(f"{directory}: is a file; name a folder with --out")
    marks = (directory / LOG_NAME, directory / FLEET_LOGS / "drone1.yaml")  # the second of a fleet that never took off
    if directory.is_dir() and any(directory.iterdir()) and not any(mark.is_file() for mark in marks):
        raise UsageError(f"{directory}: holds other files than a flight's; name a new or empty folder with --out")


def save(directory: Path, log: FlightLog, filmstrip: Sequence[KeyFrame]) -> None:
    """Writes the flight's log, and its pictures if there are any, over those of an earlier flight."""
    from flockd.flight_log.key_frames import save_key_frames

    log.save(directory / LOG_NAME)
    (directory / FILMSTRIP_NAME).unlink(missing_ok=True)
    if filmstrip:
        save_key_frames(directory / FILMSTRIP_NAME, filmstrip)


def write_findings(directory: Path, log: FlightLog) -> dict[str, Any]:
    """Writes the summary and the report beside the flight's log, and returns the summary."""
    from flockd.report.page import write_report
    from flockd.report.summary import summarise, write_summary

    summary = summarise(log)
    write_summary(summary, directory / SUMMARY_NAME)
    write_report(directory)
    return summary


def tell(directory: Path, summary: Mapping[str, Any], *, as_json: bool) -> int:
    """Prints the summary as JSON, or its key figures and where the report is."""
    if as_json:
        say_json(summary)
        return ExitCode.DONE
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(justify="left")
    table.add_column(justify="right")
    for name, value in _key_figures(summary).items():
        table.add_row(name, value)
    Console(markup=False, highlight=False).print(table)
    say(f"report: {directory / REPORT_NAME}")
    return ExitCode.DONE


def _key_figures(summary: Mapping[str, Any]) -> dict[str, str]:
    flock, neighbours, own = summary["flock"], summary["neighbours"], summary["own_account"]
    figures = {
        "autopilot": summary["autopilot"] or "",
        "drones": f"{summary['drones']}",
        "flown": f"{summary['duration_s']:g} s",
        "speed": _number(summary["realtime_factor"], "x real time", 2),
        "closest two drones": _number(flock["min_distance_m"], "m", 2),
        "order at the end": _number(flock["order_tail"], "of 1", 3),
        "union at the end": _number(flock["union_tail"], "of 1", 2),
        "own motion estimated": "" if summary["has_truth"] else _number(own["own_motion_ratio"], "of the steps", 3),
        "neighbours known within 10 m": _number(neighbours["recall_within_10m"], "of 1", 3),
        "false neighbours": _number(neighbours["false_per_drone_minute"], "a drone and minute", 2),
    }
    return {name: value for name, value in figures.items() if value}


def _number(value: float | None, unit: str, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f} {unit}"
