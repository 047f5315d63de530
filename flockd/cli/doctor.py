"""`flockd doctor`: examines a drone on the ground before it flies."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import add_force, load_to_fly
from flockd.cli.output import progress, say, say_json, tables_console
from flockd.cli.parser import Commands, flag, option, positive_number
from flockd.core.errors import ExitCode, UnavailableError
from flockd.core.printable import printable

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.ground.doctor import Finding

SECONDS = 4.0
STYLES = {"FAILURE": "bold red", "WARNING": "yellow", "PASS": "green"}
"""The worst first."""


def add(commands: Commands) -> None:
    """Adds the command."""
    from flockd.ground.doctor import CHECKS

    examples = (
        "flockd doctor --config config/quadrotor.yaml",
        "sudo -u flockd flockd doctor --config /etc/flockd/drone.yaml --record /var/lib/flockd",
        "flockd doctor --config config/quadrotor.yaml --only cameras --seconds 30",
        "flockd doctor --config config/simulator.yaml --json",
    )
    description = (
        "Examine a drone on the ground: cameras, models, autopilot, computer, telemetry. Changes nothing: "
        "never arms, switches modes or sends setpoints."
    )
    parser = commands("doctor", description, examples, _run)
    option(parser, "--config FILE", "the drone's configuration", Path, required=True)
    option(parser, "--record DIR", "where `flockd run` is to record flights", Path)
    option(parser, "--seconds S", f"watch the cameras this long ({SECONDS:g})", positive_number, default=SECONDS)
    option(parser, "--only CHECK", f"only this one, of {', '.join(CHECKS)}", action="append", choices=CHECKS)
    flag(parser, "--json", "print JSON")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    from flockd.ground.doctor import Level

    config = load_to_fly(args.config, force=args.force)
    logging.getLogger("flockd.onboard.autopilot").setLevel(logging.CRITICAL)  # what MAVSDK has to tell, the findings do
    found = _examine(config, args)
    if args.json:
        say_json(_as_json(config.name, found))
    else:
        _print(config.name, found)
    failed = any(finding.level is Level.FAILURE for findings in found.values() for finding in findings)
    return ExitCode.CHECK_FAILED if failed else ExitCode.DONE


def _examine(config: DroneConfig, args: argparse.Namespace) -> Mapping[str, Sequence[Finding]]:
    """As the owner of the drone's link, if no other process is it."""
    from flockd.ground.doctor import CHECKS, Examined, plan, run_checks
    from flockd.onboard.autopilot.link_owner import only_owner

    with ExitStack() as stack:
        taken: UnavailableError | None = None
        try:
            stack.enter_context(only_owner(config.autopilot))
        except UnavailableError as error:
            taken = error
        drone = Examined(config, args.record, args.seconds, taken)
        checks = plan(drone, args.only or CHECKS)
        return run_checks(checks, stack.enter_context(progress("examining", "checks")))


def _as_json(drone: str, found: Mapping[str, Sequence[Finding]]) -> dict[str, object]:
    rows = [
        {"check": check, "about": f.about, "level": str(f.level), "measured": f.measured, "mend": f.fix or None}
        for check, findings in found.items()
        for f in findings
    ]
    return {"drone": drone, "ok": all(row["level"] != "FAILURE" for row in rows), "findings": rows}


def _print(drone: str, found: Mapping[str, Sequence[Finding]]) -> None:
    """The worst first, each with its fix below."""
    from rich.table import Table
    from rich.text import Text

    findings = sorted((f for group in found.values() for f in group), key=lambda f: list(STYLES).index(f.level))
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        told = Text(printable(finding.measured))
        if finding.fix:
            told.append(f"\nfix: {printable(finding.fix)}", style="italic")
        table.add_row(Text(finding.level, STYLES[finding.level]), finding.about, told)
    tables_console().print(table)
    counts = {level: sum(finding.level == level for finding in findings) for level in STYLES}
    say(
        f"\n{drone}: {_plural(counts['FAILURE'], 'failure')}, {_plural(counts['WARNING'], 'warning')}, "
        f"{counts['PASS']} passed"
    )


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
