"""`flockd fleet`: a page of the fleet, and commands that ask its drones to fly elsewhere, hold, land, or go on."""

from __future__ import annotations

import argparse
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

from flockd.cli import fleet_page
from flockd.cli.endpoint_options import add_endpoint_options, add_operator_option, endpoints
from flockd.cli.output import complain, say, say_json
from flockd.cli.parser import ALONE, Commands, Parser, add_commands, positive_number
from flockd.core.errors import ExitCode, UnavailableError, UsageError

if TYPE_CHECKING:
    from flockd.core.messages import MissionOrder
    from flockd.fleet.watcher import FleetWatcher

ALL = "all"
REPEAT_S = 1.0
"""Half of the time for which an operator's velocity holds."""
FIND_S, AGAIN_S = 3.0, 0.1
NO_ANSWER = "did not answer; this computer may not command it"
PLAIN = {
    "hold": "Make the drones' autopilots hold position: the drones stop, and flockd hands over.",
    "land": "Make the drones' autopilots land them where they are.",
    "resume": "Make drones ready again after their flight was ended in the air; their pilots then select offboard.",
}


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd fleet",
        "flockd fleet --connect tcp/10.0.0.11:7447 --connect tcp/10.0.0.12:7447",
        "flockd fleet --recordings out/paper_flight-learned-seed1/recordings",
        "flockd fleet goto all 20 -5 --height 4",
        "flockd fleet velocity drone1 0.5 0 --seconds 10",
        "flockd fleet hold all",
    )
    what = "Show the fleet on a page in the browser; with a command: ask drones to fly elsewhere, hold, land, or go on."
    parser = commands("fleet", what, examples, _NOTES)
    add_commands(parser, (_add_goto, _add_velocity, *(_plain(command) for command in PLAIN)))
    fleet_page.add_options(parser)
    parser.usage = ALONE


_NOTES = """\
Without a command it serves the page, and prints its address with a key: who has it may open the page.
A drone takes only what its `telemetry.commands` allows, and no goal outside its fence. Its answer says that it tries;
`flockd status` shows what becomes of it. Each drone is asked as soon as it is found, whatever the others do.
Exit code 1: a drone refused, did not answer, or was not found; 69: none was found."""


def _add_goto(commands: Commands) -> None:
    examples = (
        "flockd fleet goto all 20 -5",
        "flockd fleet goto drone1,drone2 20 -5 --height 4 --speed 0.5",
        "flockd fleet goto drone1 47.3977 8.5456 --degrees",
        "flockd fleet goto all 20 -5 --repeat",
    )
    notes = (
        "The goal takes the place of the mission until the flight ends. A drone whose mission is `operator` hovers\n"
        "two seconds after the last one: send it with --repeat, and Ctrl-C stops it."
    )
    parser = commands("goto", "Send drones to a place: they lead the centre of their flock there.", examples, notes)
    _add_drones(parser)
    parser.add_argument("north", metavar="NORTH", type=_number, help="metres north of the mission's origin")
    parser.add_argument("east", metavar="EAST", type=_number, help="metres east of it")
    parser.add_argument("--degrees", action="store_true", help="NORTH and EAST are latitude and longitude")
    parser.add_argument(
        "--height", metavar="M", type=_number, help="height above the ground at home (default: the present one)"
    )
    parser.add_argument("--speed", metavar="V", type=positive_number, help="in m/s (default: the mission's)")
    parser.add_argument("--repeat", action="store_true", help="send it every second until Ctrl-C")
    _add_connection(parser)
    parser.set_defaults(run=_goto)


def _add_velocity(commands: Commands) -> None:
    examples = ("flockd fleet velocity drone1 0.5 0 --seconds 10", "flockd fleet velocity all 0 -1 --height 6")
    parser = commands("velocity", "Make drones fly at a velocity for as long as it is sent.", examples)
    _add_drones(parser)
    parser.add_argument("north", metavar="NORTH", type=_number, help="m/s to the north")
    parser.add_argument("east", metavar="EAST", type=_number, help="m/s to the east")
    parser.add_argument(
        "--height", metavar="M", type=_number, help="height above the ground at home (default: the present one)"
    )
    parser.add_argument(
        "--seconds", metavar="S", type=positive_number, help="repeat it every second for S seconds (default: once)"
    )
    _add_connection(parser)
    parser.set_defaults(run=_velocity)


def _plain(command: str) -> Callable[[Commands], None]:
    def add(commands: Commands) -> None:
        parser = commands(command, PLAIN[command], (f"flockd fleet {command} all", f"flockd fleet {command} drone1"))
        _add_drones(parser)
        _add_connection(parser)
        parser.set_defaults(run=lambda args: _ask(args, command, None))

    return add


def _add_drones(parser: Parser) -> None:
    parser.add_argument("drones", metavar="DRONES", help=f"names with commas between them, or `{ALL}`")


def _add_connection(parser: Parser) -> None:
    add_endpoint_options(parser)
    add_operator_option(parser)
    parser.add_argument("--json", action="store_true", help="print the last replies as JSON, by drone")


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return number


def _goto(args: argparse.Namespace) -> int:
    import numpy as np

    from flockd.core.messages import MissionOrder

    place = np.array([args.north, args.east])
    if args.degrees and not (abs(args.north) <= 90 and abs(args.east) <= 180):
        raise UsageError(f"{args.north:g} {args.east:g} is no latitude and longitude; swap them, or drop --degrees")
    where = {"place_deg": place} if args.degrees else {"place": place}
    order = MissionOrder(height_m=args.height, speed_m_s=args.speed, **where)
    return _ask(args, "goto", order, repeat_s=math.inf if args.repeat else 0.0)


def _velocity(args: argparse.Namespace) -> int:
    import numpy as np

    from flockd.core.messages import MissionOrder

    order = MissionOrder(velocity=np.array([args.north, args.east]), height_m=args.height)
    return _ask(args, "velocity", order, repeat_s=args.seconds or 0.0)


def _ask(args: argparse.Namespace, command: str, order: MissionOrder | None, repeat_s: float = 0.0) -> int:
    """Asks each drone as soon as it is found, whatever others do, again and again for ``repeat_s``.

    Says what each answers, later only what has changed.
    """
    from flockd.fleet.watcher import MAX_DRONES, FleetWatcher
    from flockd.onboard.telemetry.order_messages import order_message

    listen, connect = endpoints(args)
    message = None if order is None else {**order_message(order)}
    answers: dict[str, dict[str, object]] = {}
    over = threading.Event()

    def ask(drone: str) -> None:
        until_s = time.monotonic() + repeat_s
        while not over.is_set():
            reply = watcher.ask(drone, command, args.operator, message)
            answer = {"accepted": False, "sentence": NO_ANSWER} if reply is None else {**reply}
            if answer != answers.get(drone) and not args.json:
                (say if answer["accepted"] else complain)(f"{drone}: {answer['sentence']}")
            answers[drone] = answer
            if time.monotonic() + REPEAT_S > until_s or over.wait(REPEAT_S):
                return

    names = [] if args.drones == ALL else args.drones.split(",")
    asked: dict[str, Future[None]] = {}
    with (
        FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config) as watcher,
        ThreadPoolExecutor(MAX_DRONES) as threads,
    ):
        try:
            for drone in _found(watcher, names):
                asked[drone] = threads.submit(ask, drone)
            for one in asked.values():
                one.result()
        except KeyboardInterrupt:
            over.set()
            if not repeat_s:
                raise
    return _verdict(args, answers, names, ", ".join([*listen, *connect]))


def _found(watcher: FleetWatcher, names: list[str]) -> Iterator[str]:
    """The keys `fleet/drone` of drones that are alive, each when it is found.

    Until all that are named are found; without names, and where some are not found, for a while.
    """
    found: set[str] = set()
    until_s = time.monotonic() + FIND_S
    while True:
        alive = {
            f"{one.fleet}/{one.drone}" for one in watcher.drones() if one.alive and (one.drone in names or not names)
        }
        yield from sorted(alive - found)
        found |= alive
        if time.monotonic() >= until_s or (names and not _missing(names, found)):
            return
        time.sleep(AGAIN_S)


def _missing(names: list[str], drones: Iterable[str]) -> list[str]:
    """Those that none of these keys is of."""
    there = {drone.partition("/")[2] for drone in drones}
    return [name for name in names if name not in there]


def _verdict(args: argparse.Namespace, answers: dict[str, dict[str, object]], names: list[str], places: str) -> int:
    """Says at the end who did not do it. Raises UnavailableError where nobody was found."""
    from flockd.fleet.fleet_status import by_name

    missing = _missing(names, answers)
    who = f"{' and '.join(missing)} {'was' if len(missing) == 1 else 'were'} not" if missing else "no drone was"
    if not answers:
        raise UnavailableError(f"{who} found at {places}; no request was sent; check `flockd status`")
    if args.json:
        say_json({drone: answers[drone] for drone in sorted(answers, key=by_name)})
    if missing:
        complain(f"{who} found at {places}; check `flockd status`")
    refused = any(not answer["accepted"] for answer in answers.values())
    return ExitCode.CHECK_FAILED if refused or missing else ExitCode.DONE
