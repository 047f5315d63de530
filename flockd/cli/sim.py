"""`flockd sim`: flies a simulated flock and reports on it."""

from __future__ import annotations

import argparse
import math
import re
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from flockd.cli import sim_fleet, sim_live
from flockd.cli.endpoint_options import ENDPOINT, add_operator_option
from flockd.cli.fleet_page import PORT
from flockd.cli.fleet_source import port_number
from flockd.cli.flight_summary import report_flight
from flockd.cli.output import Phases, complain
from flockd.cli.parser import Commands, positive_count, positive_number, seed
from flockd.core.choices import TRUTH_ROLES, AutopilotKind, CameraPreset, HeightSource, ScaleSource, SimulatedPerception
from flockd.core.errors import ConfigError, ConfigProblem, ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import Overrides
    from flockd.onboard.recording import Recorder
    from flockd.sim.scenario import ScenarioConfig

SCENARIO = "paper_flight.yaml"
COSTS = """\
costs, measured with five drones on a processor without 8-bit instructions, November 2026:
  time       12 s of processor time a simulated second, so 11 minutes on two free cores for the whole flight, and 10 s
             to begin; a flight of 10 s with three drones 66 s of processor time; with --perception truth a few
             seconds
  memory     1.1 GB on two processors, and 0.3 GB more for each further one, up to one a drone
  disk       31 MB for the report and what it is made of
  --record   another 4.5 MB a drone and simulated second: 2.5 GB for the whole flight
Try `--duration 10 --drones 3` first. Ctrl-C ends a flight early, with a report of what was flown and exit code 130."""
OPTIONS = {
    "duration": "duration_s",
    "seed": "seed",
    "flow": "drone.perception.flow",
    "scale": "drone.perception.scale",
    "height": "drone.perception.height",
    "wind": "vehicle.wind_m_s",
    "speed": "drone.mission.speed_m_s",
    "radius": "drone.mission.radius_m",
    "cameras": "cameras.preset",
}
"""Which key of the configuration an option sets."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd sim --duration 10 --drones 3",
        "flockd sim",
        "flockd sim --duration 20 --wind 3,-1 --speed 1.5 --radius 15 --out out/windy",
        "flockd sim --perception truth --json > truth.json",
        "flockd sim --live --perception truth",
        "flockd sim --live config/forest.yaml --drones 3",
        "flockd sim --perception truth --telemetry --drones 25 --duration 600",
        "flockd sim my_flight.yaml --flow dis --seed 7",
        "flockd sim config/fisheye_flight.yaml --cameras realistic --duration 20",
        "flockd sim --record --duration 20",
        "flockd sim --autopilot standin --drones 2 --duration 20",
        "flockd sim config/px4_flight.yaml --autopilot px4",
    )
    parser = commands("sim", "Fly a simulated flock, and write a report of the flight.", examples, COSTS)
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
        help="fly with a real `flockd run` for each drone, and this autopilot (default: with the simulator's own "
        "pilots); `px4` needs FLOCKD_PX4, the SITL build folder of PX4",
    )
    parser.add_argument(
        "--speed-factor",
        metavar="F",
        type=positive_number,
        help=f"with --autopilot: how fast simulated time passes (default: {sim_fleet.DEFAULT_SPEED_FACTOR})",
    )
    parser.add_argument("--flow", metavar="NAME", help="the model for optical flow, or `dis`")
    parser.add_argument("--scale", choices=get_args(ScaleSource), help="where the background's scale comes from")
    parser.add_argument(
        "--height", choices=get_args(HeightSource), help="what measures the height above ground that gives the scale"
    )
    parser.add_argument(
        "--cameras", choices=get_args(CameraPreset), help="as bad as real ones, or without any of their faults"
    )
    parser.add_argument("--drones", metavar="N", type=_flock_size, help="size of the flock")
    parser.add_argument("--duration", metavar="S", type=positive_number, help="seconds to fly; it changes the world")
    parser.add_argument("--wind", metavar="N,E", type=_wind, help="mean wind in m/s, to the north and to the east")
    parser.add_argument("--speed", metavar="V", type=positive_number, help="desired speed of the flock in m/s")
    parser.add_argument(
        "--radius", metavar="R", type=positive_number, help="of the circle in m, measured at the flock's centre"
    )
    parser.add_argument("--seed", metavar="N", type=seed, help="of the world and of all noise")
    parser.add_argument(
        "--swap",
        metavar="ROLE,...",
        type=_roles,
        default=frozenset(),
        help=f"use the exact values of these roles instead of a network's: {', '.join(TRUTH_ROLES)}",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="a new folder; default: out/SCENARIO-PERCEPTION-seedN, or -AUTOPILOT-, with -2, -3, ... if there is one",
    )
    parser.add_argument(
        "--no-gate",
        dest="gated",
        action="store_false",
        help="fly what the pilots ask for, without their safety gates: to study the flocking law alone",
    )
    parser.add_argument("--force", action="store_true", help="overwrite an earlier flight in that folder")
    parser.add_argument(
        "--live",
        action="store_true",
        help="fly on the fleet page in the browser, in real time where the computer can: send drones places, pause, "
        "slow down, disturb, begin again; until Ctrl-C, without a report",
    )
    parser.add_argument(
        "--port", metavar="N", type=port_number, help=f"with --live: of the page (default: {PORT}; 0: any)"
    )
    parser.add_argument(
        "--no-browser", dest="browser", action="store_false", help="with --live: print the address, and open no browser"
    )
    add_operator_option(parser)
    parser.add_argument(
        "--telemetry",
        action="store_true",
        help="publish over zenoh while flying, with pictures, and take orders; with --perception truth in real time",
    )
    parser.add_argument(
        "--telemetry-at", metavar="ENDPOINT",
        help="where --telemetry and --live listen, or where the daemons of --autopilot connect to "
        f"(default: {ENDPOINT})",
    )  # fmt: skip
    parser.add_argument(
        "--record",
        action="store_true",
        help="write a recording of each drone to DIR/recordings, 4.5 MB a drone and simulated second",
    )
    told = parser.add_mutually_exclusive_group()
    told.add_argument("--quiet", action="store_true", help="print only the path of the report, and no progress")
    told.add_argument("--verbose", action="store_true", help="say what is flown, and each phase with its time")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=_run)


def _wind(text: str) -> tuple[float, float]:
    try:
        north, east = (float(number) for number in text.split(","))
    except ValueError:
        north = east = math.nan
    if not (math.isfinite(north) and math.isfinite(east)):
        raise argparse.ArgumentTypeError(f"{text!r} is not two numbers such as 2.0,-1.5")
    return north, east


def _flock_size(text: str) -> int:
    from flockd.sim.scenario import MAX_DRONES

    count = positive_count(text)
    if count > MAX_DRONES:
        raise argparse.ArgumentTypeError(f"{text!r} is more than the {MAX_DRONES} drones that can be simulated")
    return count


def _roles(text: str) -> frozenset[str]:
    roles = frozenset(text.split(","))
    unknown = sorted(roles - set(TRUTH_ROLES))
    if unknown:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not a role; the roles are {', '.join(TRUTH_ROLES)}")
    return roles


def _run(args: argparse.Namespace) -> int:
    _check_options(args)
    args.settings = _settings_of(args)
    scenario = _scenario(args)
    if args.live:
        return sim_live.fly(args, scenario, _plain(scenario.scenario))
    directory = _folder(scenario, args)
    try:
        return _fly_into(directory, scenario, args)
    except BaseException:
        with suppress(OSError):
            directory.rmdir()  # nothing was flown, so that the folder is empty
        raise


def _fly_into(directory: Path, scenario: ScenarioConfig, args: argparse.Namespace) -> int:
    from flockd.review.report.flight_folder import RECORDINGS

    if args.verbose:
        for line in _settings(scenario, directory, args):
            complain(line)
    if args.autopilot is not None:
        return sim_fleet.fly(args, scenario, directory)
    from flockd.sim.flock.swarm import fly

    with ExitStack() as stack:
        shown = None
        if args.telemetry:
            from flockd.onboard.telemetry.publisher import ZenohTelemetry
            from flockd.sim.flock.repeater import Repeater
            from flockd.sim.flock.shown_flock import ShownFlock

            endpoint = args.telemetry_at or ENDPOINT
            zenoh = stack.enter_context(ZenohTelemetry(_plain(scenario.scenario), listen=[endpoint]))
            shown = ShownFlock(scenario, zenoh, stack.enter_context(Repeater(zenoh)))
            if not args.quiet:
                complain(f"the flock is at {endpoint}: `flockd fleet` shows it in a browser and sends it places")
        phases = stack.enter_context(Phases(quiet=args.quiet, verbose=args.verbose))
        flight = fly(
            scenario,
            perception=args.perception,
            swap=args.swap,
            gated=args.gated,
            shown=shown,
            recorders=_recorders(scenario, args.swap, directory / RECORDINGS, stack) if args.record else (),
            progress=phases.of("flying", "steps"),
            preparing=phases.of("loading networks and building the world", "parts"),
        )
    code = report_flight(directory, flight, args)
    if flight.log.metadata.interrupted:
        complain(
            f"interrupted after {flight.log.metadata.duration_s:g} s of {scenario.duration_s:g} s; "
            "the report is of what was flown"
        )
        return ExitCode.INTERRUPTED
    return code


def _settings(scenario: ScenarioConfig, directory: Path, args: argparse.Namespace) -> list[str]:
    """What is flown, for --verbose."""
    from flockd.core.config.mission import describe

    drone, wind = scenario.drone, scenario.vehicle.wind_m_s
    missions = ", ".join(dict.fromkeys(describe(vehicle.mission or drone.mission) for vehicle in scenario.vehicles))
    networks = ", ".join(f"{role} {name}" for role, name in drone.perception.networks.items())
    lines = [
        f"scenario: {scenario.scenario}, seed {scenario.seed}, {scenario.duration_s:g} s, "
        f"{len(scenario.vehicles)} drones, a step every {drone.step_s:g} s",
        f"mission: {missions}; wind {wind[0]:g} m/s north, {wind[1]:g} m/s east",
        f"folder: {directory}",
    ]
    return lines if args.perception == "truth" else [*lines, f"networks: {networks}"]


def _recorders(
    scenario: ScenarioConfig, swap: frozenset[str], directory: Path, stack: ExitStack
) -> tuple[Recorder, ...]:
    """A recorder for each drone that flockd flies."""
    from flockd.flight.inference.hashes import model_hashes
    from flockd.onboard.recording import Recorder

    directory.mkdir(exist_ok=True)
    facts = {"scenario": scenario.scenario, "seed": str(scenario.seed), "true_roles": ", ".join(sorted(swap))}
    return tuple(
        stack.enter_context(
            Recorder(
                directory / f"drone{i + 1}.mcap",
                drone=f"drone{i + 1}",
                config=scenario.drone_of(i),
                models=model_hashes(scenario.drone.perception),
                facts=facts,
                on_event=complain,
            )
        )
        for i, vehicle in enumerate(scenario.vehicles)
        if not vehicle.by_hand
    )


def _check_options(args: argparse.Namespace) -> None:
    sim_live.check_options(args)
    sim_fleet.check_options(args)
    if args.perception == "truth":
        idle = [option for option in ("flow", "scale", "height", "cameras", "swap", "record") if getattr(args, option)]
        if idle:
            raise UsageError(f"--{idle[0]} has no meaning without networks; drop it or --perception truth")


def _scenario(args: argparse.Namespace) -> ScenarioConfig:
    """The scenario with the options over it."""
    from flockd.core.data import data_path
    from flockd.sim.flock.start import with_drones
    from flockd.sim.scenario import load_scenario

    overrides: Overrides = {
        key: getattr(args, option) for option, key in OPTIONS.items() if getattr(args, option) is not None
    }
    try:
        scenario = load_scenario(args.scenario or data_path("config") / SCENARIO, overrides)
    except ConfigError as error:
        raise ConfigError([_of_option(problem) for problem in error.problems]) from error
    if args.drones is not None:
        scenario = with_drones(scenario, args.drones)
    if all(vehicle.by_hand for vehicle in scenario.vehicles):
        raise UsageError(f"--drones {args.drones} leaves only drones that are flown by hand; fly more")
    return scenario


def _of_option(problem: ConfigProblem) -> ConfigProblem:
    """With the option's name where an option gave the value."""
    from flockd.core.config.loader import OVERRIDE

    options = {key: option for option, key in OPTIONS.items()}
    if problem.file != OVERRIDE or problem.key not in options:
        return problem
    return replace(problem, file=f"--{options[problem.key]}", key="")


def _folder(scenario: ScenarioConfig, args: argparse.Namespace) -> Path:
    """A folder for this flight alone."""
    from flockd.review.report.flight_folder import new_folder, prepare_folder

    if args.out is None and not args.force:
        return new_folder(Path("out") / _folder_name(scenario, args))
    directory: Path = args.out or Path("out") / _folder_name(scenario, args)
    moved = prepare_folder(directory, force=args.force)
    if moved is not None:
        complain(f"{directory}: held an interrupted flight, which is in {moved} now")
    return directory


def _folder_name(scenario: ScenarioConfig, args: argparse.Namespace) -> str:
    set_otherwise = "".join(
        f"-{option}" if value == "yes" else f"-{option}_{re.sub('[^A-Za-z0-9_.,+-]+', '-', Path(value).name)}"
        for option, value in args.settings.items()
        if option != "seed"
    )
    return f"{_plain(scenario.scenario)}-{args.autopilot or args.perception}{set_otherwise}-seed{scenario.seed}"


def _settings_of(args: argparse.Namespace) -> dict[str, str]:
    """What options set otherwise than the scenario's file, as text; what differs between two flights of it."""
    values = {option: getattr(args, option) for option in (*OPTIONS, "drones")}
    settings = {option: _as_text(value) for option, value in values.items() if value is not None}
    if args.swap:
        settings["swap"] = ",".join(sorted(args.swap))
    return settings if args.gated else {**settings, "no-gate": "yes"}


def _as_text(value: object) -> str:
    if isinstance(value, tuple):
        return ",".join(_as_text(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _plain(name: str) -> str:
    """A scenario's name as part of a path and of a telemetry key."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-") or "flight"
