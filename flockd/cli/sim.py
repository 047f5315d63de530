"""`flockd sim`: flies a simulated flock and reports on it."""

from __future__ import annotations

import argparse
import re
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from flockd.choices import ROLES, AutopilotKind, ScaleSource, SimulatedPerception
from flockd.cli import sim_fleet
from flockd.cli.flight_summary import show_summary
from flockd.cli.output import complain, progress
from flockd.cli.parser import Commands, positive_count, positive_number, seed
from flockd.errors import ConfigError, ConfigProblem, UsageError

if TYPE_CHECKING:
    from flockd.config import Overrides, ScenarioConfig
    from flockd.recording import Recorder

SCENARIO = "paper_flight.yaml"
RECORDINGS = "recordings"
OPTIONS = {
    "duration": "duration_s",
    "seed": "seed",
    "flow": "drone.perception.flow",
    "scale": "drone.perception.scale",
}
"""Which key of the configuration an option sets."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd sim",
        "flockd sim --duration 20 --drones 3 --out out/short",
        "flockd sim --perception truth --json > truth.json",
        "flockd sim my_flight.yaml --flow dis --seed 7",
        "flockd sim --record --duration 20",
        "flockd sim --autopilot standin --drones 2 --duration 20",
        "flockd sim config/px4_flight.yaml --autopilot px4",
    )
    parser = commands("sim", "Fly a simulated flock, and write a report of the flight.", examples)
    parser.add_argument("scenario", nargs="?", metavar="SCENARIO", type=Path, help="by default the paper's flight")
    parser.add_argument(
        "--perception",
        choices=get_args(SimulatedPerception),
        default="learned",
        help="fly on networks, or on the exact states of all drones (default: learned)",
    )
    parser.add_argument(
        "--autopilot",
        choices=get_args(AutopilotKind),
        help="fly with a real `flockd run` a drone, and this autopilot (default: with the simulator's own pilots); "
        "`px4` needs FLOCKD_PX4, the SITL build folder of PX4",
    )
    parser.add_argument(
        "--speed-factor",
        metavar="F",
        type=positive_number,
        help=f"with --autopilot: how fast simulated time passes (default: {sim_fleet.DEFAULT_SPEED_FACTOR})",
    )
    parser.add_argument("--flow", metavar="NAME", help="the model for optical flow, or `dis`")
    parser.add_argument("--scale", choices=get_args(ScaleSource), help="where the background's scale comes from")
    parser.add_argument("--drones", metavar="N", type=_flock_size, help="size of the flock")
    parser.add_argument("--duration", metavar="S", type=positive_number, help="seconds to fly")
    parser.add_argument("--seed", metavar="N", type=seed, help="of the world and of all noise")
    parser.add_argument(
        "--swap",
        metavar="ROLE,...",
        type=_roles,
        default=frozenset(),
        help=f"use the exact values of these roles instead of a network's: {', '.join(ROLES)}",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="default: out/SCENARIO-PERCEPTION-seedN, or -AUTOPILOT-"
    )
    parser.add_argument("--telemetry", action="store_true", help="publish over zenoh while flying")
    parser.add_argument("--record", action="store_true", help="write a recording of each drone to DIR/recordings")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=_run)


def _flock_size(text: str) -> int:
    from flockd.config.scenario import MAX_DRONES

    count = positive_count(text)
    if count > MAX_DRONES:
        raise argparse.ArgumentTypeError(f"{text!r} is more than the {MAX_DRONES} drones that can be simulated")
    return count


def _roles(text: str) -> frozenset[str]:
    roles = frozenset(text.split(","))
    unknown = sorted(roles - set(ROLES))
    if unknown:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not a role; the roles are {', '.join(ROLES)}")
    return roles


def _run(args: argparse.Namespace) -> int:
    from flockd.report.flight_folder import prepare_folder, save_flight, write_report_files

    _check_options(args)
    scenario = _scenario(args)
    directory = args.out or Path("out") / _folder_name(scenario, args)
    prepare_folder(directory)
    if args.autopilot is not None:
        return sim_fleet.fly(args, scenario, directory)
    from flockd.sim.swarm import fly

    with ExitStack() as stack:
        telemetry = None
        if args.telemetry:
            from flockd.telemetry.publisher import ZenohTelemetry

            telemetry = stack.enter_context(ZenohTelemetry(_plain(scenario.scenario)))
        tell_progress = stack.enter_context(progress("flying", "steps"))
        flight = fly(
            scenario,
            perception=args.perception,
            swap=args.swap,
            telemetry=telemetry,
            recorders=_recorders(scenario, args.swap, directory / RECORDINGS, stack) if args.record else (),
            progress=tell_progress,
        )
    save_flight(directory, flight.log, flight.key_frames)
    return show_summary(directory, write_report_files(directory, flight.log), as_json=args.json)


def _recorders(
    scenario: ScenarioConfig, swap: frozenset[str], directory: Path, stack: ExitStack
) -> tuple[Recorder, ...]:
    """A recorder for each drone, over an earlier flight's recordings."""
    from flockd.inference.hashes import model_hashes
    from flockd.recording import Recorder

    directory.mkdir(exist_ok=True)
    for earlier in directory.iterdir():
        if re.fullmatch(r"drone\d+(\.\d+)?\.mcap", earlier.name):
            earlier.unlink()
    facts = {"scenario": scenario.scenario, "seed": str(scenario.seed), "true_roles": ", ".join(sorted(swap))}
    return tuple(
        stack.enter_context(
            Recorder(
                directory / f"drone{i + 1}.mcap",
                drone=f"drone{i + 1}",
                config=scenario.drone,
                models=model_hashes(scenario.drone.perception),
                facts=facts,
                on_event=complain,
            )
        )
        for i in range(len(scenario.vehicles))
    )


def _check_options(args: argparse.Namespace) -> None:
    sim_fleet.check_options(args)
    if args.perception == "truth":
        idle = [option for option in ("flow", "scale", "swap", "telemetry", "record") if getattr(args, option)]
        if idle:
            raise UsageError(f"--{idle[0]} has no meaning without networks; drop it or --perception truth")


def _scenario(args: argparse.Namespace) -> ScenarioConfig:
    """The scenario with the options over it."""
    from flockd.config import load_scenario
    from flockd.data import data_path
    from flockd.sim.start import with_drones

    overrides: Overrides = {
        key: getattr(args, option) for option, key in OPTIONS.items() if getattr(args, option) is not None
    }
    try:
        scenario = load_scenario(args.scenario or data_path("config") / SCENARIO, overrides)
    except ConfigError as error:
        raise ConfigError([_of_option(problem) for problem in error.problems]) from error
    return scenario if args.drones is None else with_drones(scenario, args.drones)


def _of_option(problem: ConfigProblem) -> ConfigProblem:
    """With the option's name where an option gave the value."""
    from flockd.config.loader import OVERRIDE

    options = {key: option for option, key in OPTIONS.items()}
    if problem.file != OVERRIDE or problem.key not in options:
        return problem
    return replace(problem, file=f"--{options[problem.key]}", key="")


def _folder_name(scenario: ScenarioConfig, args: argparse.Namespace) -> str:
    swapped = "".join(f"-true-{role}" for role in sorted(args.swap))
    flown = args.autopilot or f"{args.perception}{swapped}"
    return f"{_plain(scenario.scenario)}-{flown}-seed{scenario.seed}"


def _plain(name: str) -> str:
    """A scenario's name as part of a path and of a telemetry key."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-") or "flight"
