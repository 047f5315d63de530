"""`flockd sim --autopilot`: flies the scenario with real daemons, and sees to it that none is left behind."""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from flockd.cli.flight_summary import report_flight
from flockd.cli.output import Phases, complain
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.sim.scenario import ScenarioConfig

SITL = "px4_sitl.yaml"
DEFAULT_SPEED_FACTOR = 0.25
"""Two cores then keep up with five drones."""
SPEED_FACTORS = (0.02, 10.0)
"""What a daemon's configuration allows."""


def check_options(args: argparse.Namespace) -> None:
    """Raises UsageError for options that go with the simulator's own pilots, or with daemons, only."""
    if args.autopilot is None:
        if args.speed_factor is not None:
            raise UsageError("--speed-factor is for real daemons; drop it, or name their --autopilot")
        if args.telemetry_at is not None and not (args.telemetry or args.live):
            raise UsageError("--telemetry-at is for --telemetry, --live and --autopilot; add one of them, or drop it")
        return
    slowest, fastest = SPEED_FACTORS
    if args.speed_factor is not None and not slowest <= args.speed_factor <= fastest:
        raise UsageError(f"--speed-factor {args.speed_factor:g} is not from {slowest:g} to {fastest:g}; choose another")
    own = {"--perception truth": args.perception == "truth", "--swap": args.swap, "--telemetry": args.telemetry}
    idle = [option for option, given in own.items() if given]
    if idle:
        raise UsageError(f"{idle[0]} has no meaning with real daemons, which have their own; drop it")


def fly(args: argparse.Namespace, scenario: ScenarioConfig, directory: Path) -> int:
    """Flies, writes the same report as the simulator, and says whether all flew to the end."""
    from flockd.core.config import load_drone
    from flockd.core.data import data_path
    from flockd.review.report.flight_folder import FLEET_LOGS, RECORDINGS
    from flockd.sim.sitl.fleet import fly_fleet

    with ExitStack() as stack:
        stack.enter_context(_ended_in_order())
        phases = stack.enter_context(Phases(quiet=args.quiet, verbose=args.verbose))
        phases.say("starting autopilots and daemons, and taking off")
        sitl = load_drone(data_path("config") / SITL)
        if args.telemetry_at is not None:
            telemetry = sitl.telemetry.model_copy(update={"connect": (args.telemetry_at,)})
            sitl = sitl.model_copy(update={"telemetry": telemetry})
        flight = fly_fleet(
            scenario,
            sitl,
            kind=args.autopilot,
            speed_factor=args.speed_factor or DEFAULT_SPEED_FACTOR,
            logs=directory / FLEET_LOGS,
            recordings=directory / RECORDINGS if args.record else None,
            environment=os.environ,
            progress=phases.of("flying", "s"),
        )
    code = report_flight(directory, flight, args)
    fleet = flight.log.metadata.fleet
    assert fleet is not None
    faults = [f"{drone} did not fly to the end: {why}" for drone, why in fleet.handed_over.items()]
    faults += [f"the daemon of {drone} ended with exit code {code}" for drone, code in fleet.exit_codes.items() if code]
    for sentence in [*faults, *fleet.notes]:
        complain(f"{sentence}; see {directory / FLEET_LOGS}" if sentence in faults else sentence)
    if flight.log.metadata.interrupted:
        complain("interrupted; the report is of what was flown")
        return ExitCode.INTERRUPTED
    return ExitCode.CHECK_FAILED if faults else code


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """SIGTERM and a closed terminal end the fleet as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
