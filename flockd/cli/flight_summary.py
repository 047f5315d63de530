"""A flight's summary on the terminal: its key figures, or JSON."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.output import Phases, say, say_json, say_table
from flockd.core.errors import ExitCode

if TYPE_CHECKING:
    from flockd.sim.flock.swarm import Flight


def report_flight(directory: Path, flight: Flight, args: argparse.Namespace) -> int:
    """Saves a flight, writes its report with progress, and shows its summary as --json and --quiet say."""
    from flockd.review.report.flight_folder import REPORT_NAME, save_flight, write_report_files

    metadata = flight.log.metadata.model_copy(update={"settings": args.settings})
    log = replace(flight.log, metadata=metadata)
    with Phases(quiet=args.quiet) as phases:
        save_flight(directory, log, flight.key_frames)
        summary = write_report_files(directory, log, phases.of("writing the report", "figures"))
    if args.quiet and not args.json:
        say(f"{directory / REPORT_NAME}")
        return ExitCode.DONE
    return show_summary(directory, summary, as_json=args.json)


def show_summary(directory: Path, summary: Mapping[str, Any], *, as_json: bool) -> int:
    """Prints the summary as JSON, or its key figures and where the report is."""
    from flockd.review.report.flight_folder import REPORT_NAME

    if as_json:
        say_json(summary)
        return ExitCode.DONE
    say_table((), _key_figures(summary).items(), right=True)
    say(f"report: {directory / REPORT_NAME}")
    return ExitCode.DONE


def _key_figures(summary: Mapping[str, Any]) -> dict[str, str]:
    from flockd.review.report.summary import sizes_text

    flock, neighbours, own = summary["flock"], summary["neighbours"], summary["own_account"]
    figures = {
        "autopilot": summary["autopilot"] or "",
        "drones": f"{summary['drones']}",
        "flown": f"{summary['duration_s']:g} s",
        "speed": _number(summary["realtime_factor"], "x real time", 2),
        "closest two drones": _number(flock["min_distance_m"], "m", 2),
        "slowed by safety gates": _slowed(summary),
        "asked for Hold": _held(summary["handed_over"]),
        "order at the end": _order(flock),
        "union at the end": _number(flock["union_tail"], "of 1", 2),
        "mission": _mission(summary["mission"]),
        "obstacles": _obstacles(summary["obstacles"]),
        "own motion estimated": "" if summary["has_truth"] else _number(own["own_motion_ratio"], "of the steps", 3),
        "size of the others learned": sizes_text(summary),
        "neighbours known within 10 m": _number(neighbours["recall_within_10m"], "of 1", 3),
        "false neighbours": _number(neighbours["false_per_drone_minute"], "a drone and minute", 2),
    }
    return {name: value for name, value in figures.items() if value}


def _order(flock: Mapping[str, Any]) -> str:
    """Of a flock that flies; one drone has none, and a recording without truth tells nothing of it."""
    if flock["order_tail"] is None and flock["union_tail"] is not None:
        return "none, as the flock hovers"
    return _number(flock["order_tail"], "of 1", 3)


def _slowed(summary: Mapping[str, Any]) -> str:
    """For how long, and by what."""
    from flockd.review.report.summary import causes_text

    share = summary["slowed_share"]
    if share is None:
        return "" if summary["gated"] is None else "flown without gates"
    return f"{100 * share:.1f} % of the time" + (f": {causes_text(summary)}" if share else "")


def _held(handed_over: Mapping[str, Any]) -> str:
    """Of how many drones the supervisors did, and why."""
    if not handed_over["drones"]:
        return ""
    return f"{handed_over['drones']} drones, the first at {handed_over['first_s']:.1f} s: {handed_over['reasons'][0]}"


def _mission(mission: Mapping[str, Any]) -> str:
    """Whether the flock's middle, or who leads it by hand, arrived, for a mission with a goal."""
    if mission["arrived"] is None:
        return ""
    when = f"first there after {mission['time_s']:g} s" if mission["time_s"] is not None else "never there"
    return f"{mission['who']} {mission['final_error_m']:.2f} m from the last goal at the end, {when}"


def _obstacles(obstacles: Mapping[str, Any]) -> str:
    """How often and how nearly drones hit obstacles."""
    if obstacles["collisions"] is None:
        return ""
    return f"{obstacles['collisions']} collisions, {obstacles['min_clearance_m']:.2f} m at the nearest"


def _number(value: float | None, unit: str, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f} {unit}"
