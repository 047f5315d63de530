"""`flockd fleet`: a page of the fleet, and commands that ask its drones to fly elsewhere, hold, land, or go on."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from contextlib import suppress
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
`flockd status` shows what becomes of it. Exit code 1: a drone refused, or did not answer."""


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
    parser.add_argument("--json", action="store_true", help="print the replies as JSON, by drone")


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
    """Asks all, again and again for ``repeat_s``; says what each answered, later only what has changed."""
    from flockd.fleet.watcher import FleetWatcher

    listen, connect = endpoints(args)
    with FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config) as watcher:
        drones = _drones(watcher, args.drones, ", ".join([*listen, *connect]))
        began_s = time.monotonic()
        answers = _answers(watcher, drones, command, order, args.operator)
        _show(answers, as_json=args.json)
        with suppress(KeyboardInterrupt):
            while time.monotonic() + REPEAT_S <= began_s + repeat_s:
                time.sleep(REPEAT_S)
                before, answers = answers, _answers(watcher, drones, command, order, args.operator)
                _show(
                    {drone: answer for drone, answer in answers.items() if answer != before[drone]}, as_json=args.json
                )
    refused = any(not answer["accepted"] for answer in answers.values())
    return ExitCode.CHECK_FAILED if refused else ExitCode.DONE


def _drones(watcher: FleetWatcher, wanted: str, places: str) -> tuple[str, ...]:
    """The keys `fleet/drone` of drones that are alive: as soon as all named ones are found; of all, after a while."""
    from flockd.fleet.fleet_status import by_name

    names = [] if wanted == ALL else wanted.split(",")
    until_s = time.monotonic() + FIND_S
    while True:
        alive = [one for one in watcher.drones() if one.alive and (wanted == ALL or one.drone in names)]
        missing = [name for name in names if name not in {one.drone for one in alive}]
        if time.monotonic() >= until_s or (names and not missing):
            break
        time.sleep(AGAIN_S)
    if missing or not alive:
        who = f"{' and '.join(missing)} {'was' if len(missing) == 1 else 'were'} not" if missing else "no drone was"
        raise UnavailableError(f"{who} found at {places}; no request was sent; check `flockd status`")
    return tuple(sorted((f"{one.fleet}/{one.drone}" for one in alive), key=by_name))


def _answers(
    watcher: FleetWatcher, drones: tuple[str, ...], command: str, order: MissionOrder | None, operator: str
) -> dict[str, dict[str, object]]:
    from flockd.onboard.telemetry.order_messages import order_message

    answers: dict[str, dict[str, object]] = {}
    for drone in drones:
        answer = watcher.ask(drone, command, operator, None if order is None else {**order_message(order)})
        answers[drone] = {"accepted": False, "sentence": NO_ANSWER} if answer is None else {**answer}
    return answers


def _show(answers: dict[str, dict[str, object]], *, as_json: bool) -> None:
    if as_json and answers:
        say_json(answers)
        return
    for drone, answer in answers.items():
        tell = say if answer["accepted"] else complain
        tell(f"{drone}: {answer['sentence']}")
