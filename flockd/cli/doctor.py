"""`flockd doctor`: examines a drone on the ground before it flies."""

from __future__ import annotations

import argparse
import asyncio
import functools
import logging
import signal
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import add_force, load_to_fly
from flockd.cli.output import progress, say, say_json, tables_console
from flockd.cli.parser import Commands, flag, option, positive_number
from flockd.core.errors import ExitCode, UnavailableError, UsageError
from flockd.core.printable import printable

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.ground.doctor import Finding

SECONDS = 4.0
BENCH_MINUTES = 10.0
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
        "flockd doctor --config my_drone.yaml --bench",
    )
    description = (
        "Examine a drone on the ground: cameras, models, autopilot, computer, telemetry. Changes nothing: "
        "never arms, switches modes or sends setpoints."
    )
    parser = commands("doctor", description, examples, _run)
    option(parser, "--config FILE", "the drone's configuration", Path, required=True)
    option(parser, "--record DIR", "where `flockd run` is to record flights", Path)
    option(parser, "--unit FILE", "the systemd unit; by default the installed one", Path)
    option(parser, "--seconds S", f"watch the cameras this long ({SECONDS:g})", positive_number, default=SECONDS)
    option(parser, "--only CHECK", f"only this one, of {', '.join(CHECKS)}", action="append", choices=CHECKS)
    flag(
        parser,
        "--bench",
        "propellers off: run the whole line, from cameras to commands, send nothing, and report on it",
    )
    option(parser, "--minutes M", f"how long --bench runs ({BENCH_MINUTES:g})", positive_number)
    flag(parser, "--json", "print JSON")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    from flockd.ground.doctor import Level

    config = load_to_fly(args.config, force=args.force)
    if args.minutes is not None and not args.bench:
        raise UsageError("--minutes is for --bench; add it")
    if args.bench and args.only:
        raise UsageError("--bench is a run of its own, and --only chooses among the checks; drop one of them")
    if args.unit is not None and not args.unit.is_file():
        raise UsageError(f"{args.unit}: is no file; name the unit with --unit")
    logging.getLogger("flockd.onboard.autopilot").setLevel(logging.CRITICAL)  # what MAVSDK has to tell, the findings do
    if args.bench:
        found: Mapping[str, Sequence[Finding]] = {"bench": _bench(config, args)}
    else:
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
        drone = Examined(config, args.config, args.record, args.unit, args.seconds, taken)
        checks = plan(drone, args.only or CHECKS)
        return run_checks(checks, stack.enter_context(progress("examining", "checks")))


def _bench(config: DroneConfig, args: argparse.Namespace) -> Sequence[Finding]:
    """Ctrl-C ends it early, with a report of what was seen until then."""
    from flockd.ground.doctor.bench import bench, judged
    from flockd.onboard.autopilot.link_owner import only_owner
    from flockd.onboard.simulated_time import event_loop_at

    seconds = 60.0 * (args.minutes or BENCH_MINUTES)
    stop = asyncio.Event()

    async def run() -> Sequence[Finding]:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
        with progress("on the bench", "s") as tell:
            samples = await bench(
                config, str(args.config), seconds, stop=stop, on_second=lambda done: tell(done, int(seconds))
            )
        return tuple(judged(config, samples, seconds))

    event_loop = functools.partial(event_loop_at, config.speed_factor)
    with only_owner(config.autopilot), asyncio.Runner(loop_factory=event_loop) as runner:
        return runner.run(run())


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
