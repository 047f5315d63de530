"""`flockd doctor`: examines a drone on the ground before it flies."""

from __future__ import annotations

import argparse
import json
import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import add_force, load_to_fly, refuse
from flockd.cli.output import Phases, progress, say, say_json, tables_console
from flockd.cli.parser import Commands, existing, flag, number, option
from flockd.core.errors import ExitCode, UnavailableError, UsageError
from flockd.core.printable import printable

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.ground.doctor import Finding

SECONDS, LEAST_S = 4.0, 2.0
"""Of watching cameras; and the least, in which the bench makes a few steps."""
BENCH = "bench.yaml"
MADE_UP = "autopilot and images are made up: this examines the computer, and no camera, autopilot or drone"
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
        "flockd doctor --bench --demo",
        "flockd doctor --bench --demo --config config/quadrotor.yaml",
    )
    description = (
        "Examine a drone on the ground: cameras, models, autopilot, computer, telemetry. Changes nothing: "
        "never arms, switches modes or sends setpoints."
    )
    parser = commands("doctor", description, examples, _run)
    option(parser, "--config FILE", "the drone's configuration; with --demo by default the simulator's", existing)
    option(parser, "--record DIR", "check this folder, in which `flockd run` will record", Path)
    seconds = number(f"a number of seconds from {LEAST_S:g} to 3600", LEAST_S, 3600)
    told = f"watch the cameras for S seconds (default: {SECONDS:g}), or fly the bench so long (default: 15)"
    option(parser, "--seconds S", told, seconds)
    option(parser, "--only CHECK", f"run only this check, one of {', '.join(CHECKS)}", action="append", choices=CHECKS)
    flag(parser, "--bench", "run the daemon and time its steps; needs --demo, and the extra `sim`")
    flag(parser, "--demo", "use a simulated autopilot and rendered images instead of hardware")
    flag(parser, "--json", "print JSON")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    from flockd.ground.doctor import Level

    if args.bench != args.demo:
        own = "run `flockd run` with propellers off, and watch `flockd status`"
        raise UsageError(f"--bench and --demo go together; add the other one, or, for the bench of a drone, {own}")
    if args.bench:
        refuse(args, ("record", "only", "force"), "has no meaning with --demo; drop it")
        drone, found = "bench", _fly_bench(args)
    elif args.config is None:
        raise UsageError("--config is missing; name the drone's file, or try `flockd doctor --bench --demo`")
    else:
        config = load_to_fly(args.config, force=args.force)
        # What MAVSDK has to tell, the findings do.
        logging.getLogger("flockd.onboard.autopilot").setLevel(logging.CRITICAL)
        drone, found = config.name, _examine(config, args)
    if args.json:
        say_json(_as_json(drone, found))
    else:
        _print(drone, found)
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
        drone = Examined(config, args.record, args.seconds or SECONDS, taken)
        checks = plan(drone, args.only or CHECKS)
        return run_checks(checks, stack.enter_context(progress("examining", "checks")))


def _fly_bench(args: argparse.Namespace) -> Mapping[str, Sequence[Finding]]:
    """A daemon in real time, with the simulator's autopilot and images. That it does not fly is a failure: on a slow
    computer its pilot is never ready."""
    from flockd.cli.sim import SITL
    from flockd.core.config import load_drone
    from flockd.core.data import data_path
    from flockd.core.messages import PilotOutput
    from flockd.ground.doctor import failed, passed, warned
    from flockd.ground.doctor.model_checks import FASTER, judge_steps
    from flockd.onboard.message_json import from_json
    from flockd.onboard.recording.mcap_file import read_entries
    from flockd.onboard.recording.streams import OUTPUT
    from flockd.sim.scenario import load_scenario
    from flockd.sim.sitl.fleet import fly_fleet

    scenario = load_scenario(data_path("config") / BENCH, {} if args.seconds is None else {"duration_s": args.seconds})
    if args.config is not None:
        drone = load_drone(args.config).model_copy(update={"mission": scenario.drone.mission})
        scenario = scenario.model_copy(update={"drone": drone})
    again = f"examine the drone itself: flockd doctor --config {args.config or 'FILE'}"
    made_up, stop = warned("made up", MADE_UP, again), "stop other programs, and try again"
    with tempfile.TemporaryDirectory(prefix="flockd-bench-") as folder, Phases(quiet=args.json) as phases:
        phases.say(f"{MADE_UP}; starting the daemon, and taking off")
        try:
            flight = fly_fleet(
                scenario, load_drone(data_path("config") / SITL), kind="fake", speed_factor=1.0,
                logs=Path(folder, "logs"), recordings=Path(folder), environment=os.environ,
                progress=phases.of("flying", "s"),
            )  # fmt: skip
        except UnavailableError as error:
            return {"bench": (made_up, failed("daemon", str(error), f"{stop}; if steps take too long, {FASTER}"))}
        entries = (entry for file in Path(folder).glob("*.mcap") for entry in read_entries(file))
        outputs = [from_json(PilotOutput, json.loads(one.data)) for one in entries if one.stream.topic == OUTPUT.topic]
    fleet = flight.log.metadata.fleet
    assert fleet is not None
    faults = [*fleet.handed_over.values(), *(f"exit code {code}" for code in fleet.exit_codes.values() if code)]
    saw = sum(any(neighbour.confirmed for neighbour in output.neighbours) for output in outputs)
    told = f"flew {scenario.duration_s:g} s in offboard; of {len(outputs)} steps {saw} saw the drone beside it"
    timed = [(sum(output.stages_ms.values()) / 1e3, output) for output in outputs]
    daemon = passed("daemon", told)
    if faults:
        daemon = failed("daemon", f"did not fly to the end: {'; '.join(faults)}", stop)
    if len(timed) < 2:  # the first one warms up
        return {"bench": (made_up, daemon)}
    return {"bench": (made_up, daemon, judge_steps(scenario.drone, timed, os.getloadavg()[0], os.cpu_count() or 1))}


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
