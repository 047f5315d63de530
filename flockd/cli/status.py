"""`flockd status`: a live table of the fleet, the worst first."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from flockd.cli.options import add_endpoint_options, endpoints
from flockd.cli.output import cell, noted_table, say_json, tables_console
from flockd.cli.parser import Commands, duration, flag, option
from flockd.core.errors import ExitCode, UnavailableError

if TYPE_CHECKING:
    from rich.text import Text

    from flockd.fleet.watcher import Watched

LISTEN_S = 3.0
REFRESH_S = 0.5
MAX_SHOWN = 1e6
"""Larger numbers, which only a faulty peer sends, are shown by their exponent."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd status",
        "flockd status --connect tcp/10.0.0.11:7447 --connect tcp/10.0.0.12:7447",
        "flockd status --listen tcp/0.0.0.0:7447 --fleet meadow",
        "flockd status --json --seconds 2",
    )
    parser = commands("status", "Show the state of each drone of a fleet, the worst first.", examples, _run)
    add_endpoint_options(parser)
    option(parser, "--seconds S", "listen for S seconds and print once, instead of a live table", duration)
    flag(parser, "--json", "print JSON, once")


def _run(args: argparse.Namespace) -> int:
    from flockd.fleet.drone_rows import status_rows
    from flockd.fleet.watcher import FleetWatcher

    listen, connect = endpoints(args)
    once = args.json or args.seconds is not None or not sys.stdout.isatty()
    with FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config) as watcher:
        if not once:
            return _show_live(watcher.drones)
        time.sleep(args.seconds or LISTEN_S)
        drones = watcher.drones()
    rows = status_rows(drones, time.monotonic())
    if args.json:
        say_json(rows)
    elif rows:
        tables_console().print(_table(rows))
    if not rows:
        places = ", ".join([*listen, *connect])
        raise UnavailableError(
            f"no drone was found at {places} within {args.seconds or LISTEN_S:g} s; name a drone's endpoint "
            "with --connect, or listen for drones with --listen"
        )
    return ExitCode.DONE


def _table(rows: list[dict[str, Any]]) -> Text:
    heads = ("drone", "state", "mode", "height", "battery", "sees", "load")
    return noted_table(heads, [(_cells(row), _notes(row)) for row in rows])


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    return (
        cell(f"{row['fleet']}/{row['drone']}"),
        row["state"],
        cell(row["flight_mode"] or ""),
        _number(row["height_m"], ".1f", " m"),
        _number(row["battery_share"], ".0%", ""),
        _number(row["neighbours"], "d", ""),
        _number(row["load"], ".0%", ""),
    )


def _notes(row: dict[str, Any]) -> list[str]:
    """Its mission, and each fault."""
    mission = [f"mission: {cell(row['mission'])}"] if row["mission"] else []
    return [*mission, *(cell(matter) for matter in row["matters"])]


def _number(value: float | None, form: str, unit: str) -> str:
    if value is None:
        return ""
    return f"{value:{form}}{unit}" if abs(value) < MAX_SHOWN else f"{value:.2g}"


def _show_live(drones: Callable[[], Iterable[Watched]]) -> int:
    """Until Ctrl-C."""
    from rich.live import Live

    from flockd.fleet.drone_rows import status_rows

    with suppress(KeyboardInterrupt), Live(console=tables_console(), auto_refresh=False) as live:
        while True:
            rows = status_rows(drones(), time.monotonic())
            live.update(_table(rows) if rows else "no drone was heard yet", refresh=True)
            time.sleep(REFRESH_S)
    return ExitCode.DONE
