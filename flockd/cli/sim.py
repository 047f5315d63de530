"""`flockd sim`: flies a simulated flock and reports on it; live on the fleet page, or with real daemons."""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, get_args

from flockd.cli.fleet import HERE, PORT, serve_page
from flockd.cli.options import ENDPOINT, add_operator_option, add_settings
from flockd.cli.output import Phases, complain, report_flight, say
from flockd.cli.parser import (
    Commands,
    existing,
    flag,
    number,
    option,
    port_number,
    positive_count,
    positive_number,
    whole_number,
)
from flockd.core.choices import AutopilotKind, SimulatedPerception
from flockd.core.errors import ConfigError, ConfigProblem, ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import Overrides
    from flockd.core.config.document import Value
    from flockd.fleet.page.page_server import PageServer
    from flockd.onboard.recording import Recorder
    from flockd.sim.scenario import ScenarioConfig

SCENARIO = "paper_flight.yaml"
COSTS = """\
costs, with five drones on a processor without 8-bit instructions:
  time       12 s of processor time a simulated second, so 11 minutes on two free cores for the whole flight, and 10 s
             to begin; a flight of 10 s with three drones 66 s of processor time; with --perception truth a few
             seconds
  memory     1.9 GB
  disk       31 MB for the report, its figures and the data behind them
  --record   another 4.5 MB a drone and simulated second: 2.5 GB for the whole flight
Try `--duration 10 --drones 3` first. Ctrl-C ends a flight early, with a report of what was flown and exit code 130."""
OPTIONS = {"duration": "duration_s", "seed": "seed"}
"""Which key of the scenario an option sets."""
SITL = "px4_sitl.yaml"
DEFAULT_SPEED_FACTOR = 0.25
"""Two cores then keep up with five drones."""
DRONES_A_CORE = 1.7
"""By sight in real time: a second of a drone takes 0.43 s of a processor (AMD EPYC), and a browser needs some too."""
SPEED_FACTORS = (0.02, 10.0)
"""What a daemon's configuration allows."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd sim --duration 10 --drones 3",
        "flockd sim",
        "flockd sim --duration 20 --set vehicle.wind_m_s=[3,-1] --set drone.mission.speed_m_s=1.5 --out out/windy",
        "flockd sim --perception truth --json > truth.json",
        "flockd sim --live",
        "flockd sim --live config/forest.yaml --drones 3",
        "flockd sim --live --video flock.mp4",
        "flockd sim --perception truth --telemetry --drones 25 --duration 600",
        "flockd sim my_flight.yaml --set drone.perception.flow=dis --seed 7",
        "flockd sim config/fisheye_flight.yaml --set cameras.preset=realistic --duration 20",
        "flockd sim --record --duration 20",
        "flockd sim --autopilot fake --drones 2 --duration 20",
        "flockd sim config/px4_flight.yaml --autopilot px4",
    )
    parser = commands("sim", "Fly a simulated flock, and write a report of the flight.", examples, _run, notes=COSTS)
    option(parser, "SCENARIO", "the scenario's file (default: the paper's flight)", existing, nargs="?")
    option(
        parser,
        "--perception",
        "fly by sight, or on the exact states of all drones (default: learned)",
        choices=get_args(SimulatedPerception),
        default="learned",
    )
    option(
        parser,
        "--autopilot",
        "fly with a real `flockd run` for each drone, and this autopilot (default: with the simulator's own "
        "pilots); `px4` needs FLOCKD_PX4, the SITL build folder of PX4",
        choices=get_args(AutopilotKind),
    )
    option(
        parser,
        "--speed-factor F",
        f"with --autopilot: how fast simulated time passes (default: {DEFAULT_SPEED_FACTOR})",
        number("a number from {:g} to {:g}".format(*SPEED_FACTORS), *SPEED_FACTORS),
    )
    add_settings(parser, "use this value of the scenario, or of its drone below `drone.`")
    option(
        parser,
        "--drones N",
        "size of the flock (default: the scenario's; --live by sight: three on two processors, five on three)",
        _flock_size,
    )
    option(parser, "--duration S", "seconds to fly; the world is as large as the flight needs", positive_number)
    option(parser, "--seed N", "seed of the world and of all noise", whole_number("a whole number, 0 or more"))
    option(
        parser,
        "--out DIR",
        "a new folder (default: out/SCENARIO-PERCEPTION-seedN, or -AUTOPILOT-; with -2, -3, ... if that exists)",
        Path,
    )
    parser.add_argument(
        "--no-gate",
        dest="gated",
        action="store_false",
        help="fly the pilots' commands without their safety gates, to study the flocking law",
    )
    flag(parser, "--force", "overwrite an earlier flight in that folder")
    flag(
        parser,
        "--live",
        "show the flight on the fleet page in the browser, with the drones' cameras, in real time if the computer is "
        "fast enough; the page commands the drones and the simulation. Flies until Ctrl-C, and writes no report",
    )
    option(parser, "--video FILE", "with --live: write an .mp4 of the flock and of what drone 1 sees", Path)
    option(parser, "--port N", f"with --live: port of the page (default: {PORT}; 0: any)", port_number)
    add_operator_option(parser)
    flag(
        parser,
        "--telemetry",
        "publish over zenoh while flying, with pictures, and take orders; with --perception truth, in real time",
    )
    option(
        parser,
        "--telemetry-at ENDPOINT",
        f"where --telemetry and --live listen, or where the daemons of --autopilot connect to (default: {ENDPOINT})",
    )
    flag(parser, "--record", "write a recording of each drone to DIR/recordings, 4.5 MB a drone and simulated second")
    flag(parser, "--quiet", "print only the path of the report, and no progress")
    flag(parser, "--json", "print the summary as JSON")


def _flock_size(text: str) -> int:
    from flockd.sim.scenario import MAX_DRONES

    count = positive_count(text)
    if count > MAX_DRONES:
        raise argparse.ArgumentTypeError(f"{text!r} is more than the {MAX_DRONES} drones that can be simulated")
    return count


def _run(args: argparse.Namespace) -> int:
    _check_options(args)
    scenario = _scenario(args)
    if args.live:
        return _fly_live(args, scenario, _plain(scenario.scenario))
    directory = _folder(scenario, args)
    try:
        return _fly_into(directory, scenario, args)
    except BaseException:
        with suppress(OSError):
            directory.rmdir()  # nothing was flown, so that the folder is empty
        raise


def _fly_into(directory: Path, scenario: ScenarioConfig, args: argparse.Namespace) -> int:
    from flockd.review.report.flight_folder import RECORDINGS

    if args.autopilot is not None:
        return _fly_fleet(args, scenario, directory)
    from flockd.sim.flock.swarm import fly

    with ExitStack() as stack:
        shown = None
        if args.telemetry:
            from flockd.onboard.telemetry.publisher import ZenohTelemetry
            from flockd.sim.flock.flock_telemetry import FlockTelemetry, Repeater

            endpoint = args.telemetry_at or ENDPOINT
            zenoh = stack.enter_context(ZenohTelemetry(_plain(scenario.scenario), listen=[endpoint]))
            shown = FlockTelemetry(scenario, zenoh, stack.enter_context(Repeater(zenoh)))
            if not args.quiet:
                complain(f"the flock is at {endpoint}: `flockd fleet` shows it in a browser and sends it places")
        phases = stack.enter_context(Phases(quiet=args.quiet))
        if args.perception == "learned":
            phases.say("loading networks and building the world")
        flight = fly(
            scenario,
            perception=args.perception,
            gated=args.gated,
            shown=shown,
            recorders=_recorders(scenario, directory / RECORDINGS, stack) if args.record else (),
            progress=phases.of("flying", "steps"),
        )
    code = report_flight(directory, flight, args)
    if flight.log.metadata.interrupted:
        complain(
            f"interrupted after {flight.log.metadata.duration_s:g} s of {scenario.duration_s:g} s; "
            "the report is of what was flown"
        )
        return ExitCode.INTERRUPTED
    return code


def _recorders(scenario: ScenarioConfig, directory: Path, stack: ExitStack) -> tuple[Recorder, ...]:
    """A recorder for each drone that flockd flies."""
    from flockd.flight.inference.manifest_file import model_hashes
    from flockd.onboard.recording import Recorder

    directory.mkdir(exist_ok=True)
    facts = {"scenario": scenario.scenario, "seed": str(scenario.seed)}
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
    """Raises UsageError for options that do not go with each other."""
    live, fleet, own = args.live, args.autopilot is not None, "which have their own; drop it"
    wrong = {
        "--live has --telemetry in it; drop one of them": live and args.telemetry,
        "--live keeps nothing; fly with --record and without --live": live and args.record,
        "--live has no summary; drop --json": live and args.json,
        "--live writes nothing; drop --out": live and args.out,
        "--live writes nothing; drop --force": live and args.force,
        "--live flies with the simulator's own pilots; drop --autopilot": live and fleet,
        "--live flies on until Ctrl-C; drop --duration": live and args.duration,
        "--port is for --live; add that, or drop it": args.port is not None and not live,
        "--video is for --live; add that, or drop it": args.video is not None and not live,
        "--speed-factor is for real daemons; drop it, or name their --autopilot": args.speed_factor and not fleet,
        "--telemetry-at is for --telemetry, --live and --autopilot; add one of them, or drop it": (
            args.telemetry_at is not None and not (args.telemetry or live or fleet)
        ),
        f"--perception truth has no meaning with real daemons, {own}": fleet and args.perception == "truth",
        f"--telemetry has no meaning with real daemons, {own}": fleet and args.telemetry,
    }
    if args.perception == "truth":
        idle = [f"--set {key}" for key, _ in args.settings if key.startswith(("drone.perception.", "cameras."))]
        idle += ["--record"] if args.record else []
        wrong |= {f"{one} has no meaning without networks; drop it or --perception truth": True for one in idle}
    if args.video is not None:
        from flockd.ground.pictures.copies import VIDEO

        wrong[f"--video {args.video}: does not end in {VIDEO}; name a file that does"] = args.video.suffix != VIDEO
        wrong[f"--video {args.video}: exists; name another file"] = args.video.exists()
        wrong[f"--video {args.video}: there is no folder {args.video.parent}; make it"] = not args.video.parent.is_dir()
    for sentence, is_so in wrong.items():
        if is_so:
            raise UsageError(sentence)


def _scenario(args: argparse.Namespace) -> ScenarioConfig:
    """The scenario with the options over it."""
    from flockd.core.data import data_path
    from flockd.sim.flock.start import with_drones
    from flockd.sim.scenario import load_scenario

    options = {key: getattr(args, option) for option, key in OPTIONS.items() if getattr(args, option) is not None}
    twice = [key for key, _ in args.settings if key in options or (key == "vehicles" and args.drones is not None)]
    if twice:
        raise UsageError(f"--set {twice[0]} says what an option says too; leave one out")
    overrides: Overrides = {**{key: _value(key, text) for key, text in args.settings}, **options}
    try:
        scenario = load_scenario(args.scenario or data_path("config") / SCENARIO, overrides)
    except ConfigError as error:
        raise ConfigError([_of_option(problem) for problem in error.problems]) from error
    drones: int | None = args.drones
    if args.live and args.scenario is None and drones is None and args.perception == "learned":
        drones = min(len(scenario.vehicles), max(2, int(DRONES_A_CORE * (os.cpu_count() or 1))))
    if drones is not None:
        scenario = with_drones(scenario, drones)
    if all(vehicle.by_hand for vehicle in scenario.vehicles):
        raise UsageError(f"--drones {args.drones} leaves only drones that are flown by hand; fly more")
    for sentence in scenario.warnings():
        complain(f"warning: {sentence}")
    return scenario


def _value(key: str, text: str) -> Value:
    """What was written behind --set, as a file would hold it."""
    import yaml

    def with_tuples(value: Any) -> Value:
        if isinstance(value, dict):
            return {str(name): with_tuples(inner) for name, inner in value.items()}
        return tuple(with_tuples(inner) for inner in value) if isinstance(value, list) else value

    try:
        return with_tuples(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise UsageError(f"--set {key}: {text!r} is not YAML ({str(error).splitlines()[0]}); quote it") from error


def _of_option(problem: ConfigProblem) -> ConfigProblem:
    """With the option's name where an option gave the value."""
    from flockd.core.config.loader import OVERRIDE

    options = {key: option for option, key in OPTIONS.items()}
    if problem.file != OVERRIDE:
        return problem
    option = options.get(problem.key)
    return replace(problem, file="--set") if option is None else replace(problem, file=f"--{option}", key="")


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
    told = {
        name: re.sub("[^A-Za-z0-9_.,+-]+", "-", Path(text).name).strip("-") for name, text in _settings(args).items()
    }
    set_otherwise = "".join(f"-{k}" if v == "yes" else f"-{k}_{v}" for k, v in told.items() if k != "seed")
    return f"{_plain(scenario.scenario)}-{args.autopilot or args.perception}{set_otherwise}-seed{scenario.seed}"


def _settings(args: argparse.Namespace) -> dict[str, str]:
    """The options' values that differ from the scenario's file, as text."""
    values = {option: getattr(args, option) for option in (*OPTIONS, "drones")}
    settings = {option: f"{value:g}" for option, value in values.items() if value is not None}
    settings |= {key.rpartition(".")[2]: value for key, value in args.settings}
    return settings if args.gated else {**settings, "no-gate": "yes"}


def _plain(name: str) -> str:
    """A scenario's name as part of a path and of a telemetry key."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-") or "flight"


def _fly_live(args: argparse.Namespace, scenario: ScenarioConfig, fleet: str) -> int:
    """Until Ctrl-C."""
    import aiohttp.web  # noqa: F401 - before anything is opened: it is of an extra

    from flockd.fleet.live_fleet import LiveFleet
    from flockd.fleet.page.page_access import PageAccess
    from flockd.fleet.page.page_server import PageServer
    from flockd.fleet.simulation import SimulationLink, key_of
    from flockd.fleet.watcher import FleetWatcher
    from flockd.onboard.telemetry.publisher import ZenohTelemetry
    from flockd.sim.flock.flight_film import flight_film
    from flockd.sim.flock.flock_telemetry import FlockTelemetry, Repeater
    from flockd.sim.flock.live_flight import LiveControls, fly_live
    from flockd.sim.flock.swarm import eyes_of

    endpoint = args.telemetry_at or ENDPOINT
    with suppress(KeyboardInterrupt), ExitStack() as stack:
        zenoh = stack.enter_context(ZenohTelemetry(fleet, listen=[endpoint]))
        controls = LiveControls(scenario, zenoh.identity, by_sight=args.perception != "truth")
        zenoh.reply_to(f"{key_of(fleet)}/**", controls.reply)
        watcher = stack.enter_context(FleetWatcher(fleet, listen=[], connect=[endpoint]))
        source = stack.enter_context(LiveFleet(watcher))
        access, link = PageAccess(), stack.enter_context(SimulationLink(fleet, watcher))
        page = PageServer(source, access, may_command=True, operator=args.operator, simulation=link)
        port = stack.enter_context(_served(page, PORT if args.port is None else args.port))
        say(f"open this in a browser: http://{HERE}:{port}/?key={access.key}")
        if not args.quiet:
            complain(f"other programs find it at {endpoint}; Ctrl-C ends it")
            if args.perception == "learned":
                complain(f"loading networks and building the world; {len(scenario.vehicles)} drones fly (`--drones`)")
        sys.stdout.flush()  # whoever reads a pipe needs the address now
        eyes = None if args.perception == "truth" else eyes_of(scenario)
        shown = FlockTelemetry(scenario, zenoh, stack.enter_context(Repeater(zenoh)))  # nothing is heard of it before
        first = min(shown.pictures)
        film = stack.enter_context(flight_film(scenario, shown.pictures[first], args.video)) if args.video else None
        with suppress(KeyboardInterrupt):  # which ends the film in order
            fly_live(scenario, shown, controls, eyes, gated=args.gated, film=film)
    return ExitCode.DONE


@contextmanager
def _served(page: PageServer, port: int) -> Iterator[int]:
    """Serves the page on a thread of its own. Gives its port; raises what stopped its start."""
    loop, begun = asyncio.new_event_loop(), Future[int]()
    task = loop.create_task(serve_page(page, HERE, port, begun.set_result))

    def run() -> None:
        with suppress(asyncio.CancelledError):
            try:
                loop.run_until_complete(task)
            except Exception as error:  # noqa: BLE001 - raised again where it was started
                begun.set_exception(error)
        loop.close()

    thread = threading.Thread(target=run, name="fleet page server", daemon=True)
    thread.start()
    bound = begun.result()
    try:
        yield bound
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()


def _fly_fleet(args: argparse.Namespace, scenario: ScenarioConfig, directory: Path) -> int:
    """Flies, writes the same report as the simulator, and says whether all flew to the end."""
    from flockd.core.config import load_drone
    from flockd.core.data import data_path
    from flockd.review.report.flight_folder import FLEET_LOGS, RECORDINGS
    from flockd.sim.sitl.fleet import fly_fleet

    if scenario.takeovers:
        raise UsageError("the scenario's `takeovers` are not flown with daemons; delete them, or drop --autopilot")
    with ExitStack() as stack:
        stack.enter_context(_ended_in_order())
        phases = stack.enter_context(Phases(quiet=args.quiet))
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
