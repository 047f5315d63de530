"""`flockd fleet`: a page of the fleet, and commands that ask its drones to fly elsewhere, hold, land, or go on."""

from __future__ import annotations

import argparse
import asyncio
import functools
import ipaddress
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import ENDPOINT, add_endpoint_options, add_operator_option, endpoints
from flockd.cli.output import complain, say, say_json
from flockd.cli.parser import (
    ALONE,
    Commands,
    Parser,
    commands_of,
    duration,
    flag,
    number,
    option,
    port_number,
    positive_number,
)
from flockd.core.errors import ExitCode, UnavailableError, UsageError

if TYPE_CHECKING:
    from flockd.fleet.page.page_server import PageServer
    from flockd.fleet.watcher import FleetWatcher

ALL = "all"
REPEAT_S = 1.0
"""Half of the time for which an operator's velocity holds."""
FIND_S, AGAIN_S = 3.0, 0.1
NO_ANSWER = "did not answer; this computer may not command it"
ENDED = "has ended, or cannot be reached any more; see `flockd status`"
PLAIN = {
    "hold": "Make the drones' autopilots hold position: the drones stop, and flockd hands over.",
    "land": "Make the drones' autopilots land them where they are.",
    "resume": "Make drones ready again after their flight was ended in the air; their pilots then select offboard.",
}
_NOTES = """\
Without a command it serves the page, and prints its address with a key: anyone with the key may open the page.
A drone accepts only the commands in its `telemetry.commands`, and no goal outside its fence. Its answer says that it
tries; `flockd status` shows the result. Each drone is asked as soon as it is found, independently of the others.
Exit code 1: a drone refused, did not answer, or was not found; 69: none was found."""
_number = number("a number")
PORT = 8470
HERE = "127.0.0.1"
"""Where it is served unless told otherwise: for this computer alone."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd fleet",
        "flockd fleet --connect tcp/10.0.0.11:7447 --connect tcp/10.0.0.12:7447",
        "flockd fleet goto all 20 -5 --height 4",
        "flockd fleet velocity drone1 0.5 0 --seconds 10",
        "flockd fleet hold all",
    )
    what = "Show the fleet on a page in the browser. With a command: send drones to a place, or make them hold or land."
    parser = commands("fleet", what, examples, notes=_NOTES)
    _add_orders(commands_of(parser))
    _add_page(parser)
    parser.usage = ALONE


def _add_orders(commands: Commands) -> None:
    examples: tuple[str, ...] = (
        "flockd fleet goto all 20 -5",
        "flockd fleet goto drone1,drone2 20 -5 --height 4 --speed 0.5",
        "flockd fleet goto drone1 47.3977 8.5456 --degrees",
        "flockd fleet goto all 20 -5 --repeat",
    )
    notes = (
        "The goal takes the place of the mission until the flight ends. A drone whose mission is `operator` hovers\n"
        "two seconds after the last one: send it with --repeat, and Ctrl-C stops it."
    )
    what = "Send drones to a place: they lead the centre of their flock there."
    parser = _ordering(commands("goto", what, examples, _goto, notes=notes))
    option(parser, "NORTH", "metres north of the mission's origin", _number)
    option(parser, "EAST", "metres east of it", _number)
    flag(parser, "--degrees", "read NORTH and EAST as latitude and longitude")
    option(parser, "--height M", "height above the ground at home (default: the present one)", _number)
    option(parser, "--speed V", "in m/s (default: the mission's)", positive_number)
    flag(parser, "--repeat", "send the goal every second until Ctrl-C")
    examples = ("flockd fleet velocity drone1 0.5 0 --seconds 10", "flockd fleet velocity all 0 -1 --height 6")
    what = "Make drones fly at a velocity: they stop two seconds after it was last sent."
    parser = _ordering(commands("velocity", what, examples, _velocity))
    option(parser, "NORTH", "m/s to the north", _number)
    option(parser, "EAST", "m/s to the east", _number)
    option(parser, "--height M", "height above the ground at home (default: the present one)", _number)
    option(parser, "--seconds S", "send the velocity every second for S seconds (default: once)", duration)
    for command, what in PLAIN.items():
        examples = (f"flockd fleet {command} all", f"flockd fleet {command} drone1")
        _ordering(commands(command, what, examples, functools.partial(_ask, command=command)))


def _ordering(parser: Parser) -> Parser:
    option(parser, "DRONES", f"names with commas between them, or `{ALL}`", _names)
    add_endpoint_options(parser)
    add_operator_option(parser)
    flag(parser, "--json", "print the last replies as JSON, by drone")
    return parser


def _names(text: str) -> list[str]:
    """None for all."""
    from flockd.onboard.telemetry.topics import is_name

    names = [] if text == ALL else [name.strip() for name in text.split(",")]
    for name in names:
        if not is_name(name):
            raise argparse.ArgumentTypeError(f"{name!r} is not a drone's name; write names with commas, or `{ALL}`")
        if name == ALL:
            raise argparse.ArgumentTypeError(f"{text!r} names `{ALL}` beside others; write one of both")
    return names


def _goto(args: argparse.Namespace) -> int:
    if args.degrees and not (abs(args.north) <= 90 and abs(args.east) <= 180):
        raise UsageError(f"{args.north:g} {args.east:g} is not a latitude and longitude; swap them, or drop --degrees")
    north, east = ("latitude_deg", "longitude_deg") if args.degrees else ("north_m", "east_m")
    order = {north: args.north, east: args.east, "height_m": args.height, "speed_m_s": args.speed}
    return _ask(args, "goto", order, repeat_s=math.inf if args.repeat else 0.0)


def _velocity(args: argparse.Namespace) -> int:
    order = {"velocity_ne": [args.north, args.east], "height_m": args.height}
    return _ask(args, "velocity", order, repeat_s=args.seconds or 0.0)


def _ask(
    args: argparse.Namespace, command: str, order: Mapping[str, object] | None = None, repeat_s: float = 0.0
) -> int:
    """Asks each drone as soon as it is found, whatever others do, again and again for ``repeat_s``.

    ``order``: an `OrderMessage`, with None for what was not said. Says what each drone answers, later only what has
    changed.
    """
    from flockd.fleet.watcher import MAX_DRONES, FleetWatcher

    listen, connect = endpoints(args)
    message = None if order is None else {key: value for key, value in order.items() if value is not None}
    answers: dict[str, dict[str, object]] = {}
    over = threading.Event()

    def ask(drone: str) -> None:
        until_s = time.monotonic() + repeat_s
        while not over.is_set():
            reply = watcher.ask(drone, command, args.operator, message)
            answer = {"accepted": False, "sentence": NO_ANSWER} if reply is None else {**reply}
            if reply is None and drone not in _alive(watcher):
                answer["sentence"] = ENDED
            if answer != answers.get(drone) and not args.json:
                (say if answer["accepted"] else complain)(f"{drone}: {answer['sentence']}")
            answers[drone] = answer
            if time.monotonic() + REPEAT_S > until_s or over.wait(REPEAT_S):
                return

    names: list[str] = args.drones
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
    """Yields the keys `fleet/drone` of drones that are alive, as they are found. Ends when all that are named are
    found; without names, and where some are not found, after a while."""
    found: set[str] = set()
    until_s = time.monotonic() + FIND_S
    while True:
        alive = {key for key in _alive(watcher) if not names or key.partition("/")[2] in names}
        yield from sorted(alive - found)
        found |= alive
        if time.monotonic() >= until_s or (names and not _missing(names, found)):
            return
        time.sleep(AGAIN_S)


def _alive(watcher: FleetWatcher) -> set[str]:
    """Keys `fleet/drone` of the drones whose processes run and can be reached."""
    return {f"{one.fleet}/{one.drone}" for one in watcher.drones() if one.alive}


def _missing(names: list[str], drones: Iterable[str]) -> list[str]:
    """Names that no key belongs to."""
    there = {drone.partition("/")[2] for drone in drones}
    return [name for name in names if name not in there]


def _verdict(args: argparse.Namespace, answers: dict[str, dict[str, object]], names: list[str], places: str) -> int:
    """Says at the end which drones did not do it. Raises UnavailableError where none was found."""
    from flockd.fleet.drone_rows import by_name

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


def _add_page(parser: Parser) -> None:
    option(parser, "--port N", f"port of the page (default: {PORT}; 0: any)", port_number, default=PORT)
    option(
        parser,
        "--listen ADDRESS",
        f"address of the page; 0.0.0.0 admits other computers (default: {HERE})",
        _ip_address,
        default=HERE,
        dest="server_address",
    )
    add_endpoint_options(parser, "--drones-at")
    flag(parser, "--watch-only", "refuse all commands from the page")
    option(
        parser,
        "--key-file FILE",
        "keep the page's key in this file, so that open pages still work after a restart (default: a new key "
        "at each start)",
        Path,
    )
    add_operator_option(parser)
    parser.set_defaults(run=_show_page)


def _show_page(args: argparse.Namespace) -> int:
    import aiohttp.web  # noqa: F401 - before anything is opened: it is of an extra

    from flockd.fleet.live_fleet import LiveFleet
    from flockd.fleet.page.page_access import PageAccess, lasting_key
    from flockd.fleet.page.page_server import PageServer
    from flockd.fleet.watcher import FleetWatcher

    listen, connect = endpoints(args)
    with (
        FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config) as watcher,
        LiveFleet(watcher) as source,
        suppress(KeyboardInterrupt),
    ):
        access = PageAccess(None if args.key_file is None else lasting_key(args.key_file))
        page = PageServer(source, access, may_command=not args.watch_only, operator=args.operator)
        announced = functools.partial(announce, args, access.key)
        asyncio.run(serve_page(page, args.server_address, args.port, announced))
    return ExitCode.DONE


async def serve_page(page: PageServer, address: str, port: int, served: Callable[[int], None]) -> None:
    """Serves the page until it is cancelled. ``served`` is called with the port once the page can be opened.

    Raises UnavailableError for an address or a port that cannot be used.
    """
    from aiohttp import web

    from flockd.fleet.page.page_access import PageConnections

    runner = web.AppRunner(page.application(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        assert runner.server is not None
        connections = PageConnections(runner.server, page.trusted)
        try:
            server = await asyncio.get_running_loop().create_server(connections, address, port)
        except OSError as error:
            told = f"the page cannot use {address} port {port} ({error.strerror}); name others"
            raise UnavailableError(told) from error
        served(server.sockets[0].getsockname()[1])
        await connections.run()
    finally:
        await runner.cleanup()


def announce(args: argparse.Namespace, key: str, port: int) -> None:
    """Prints the page's address, and a warning where other computers can reach it."""
    where = ipaddress.ip_address(args.server_address)
    # For all addresses of this computer, the one at which it reaches itself.
    host = HERE if where.is_unspecified else f"[{where}]" if where.version == 6 else str(where)
    say(f"the fleet page is at http://{host}:{port}/?key={key}")
    if not where.is_loopback:
        complain(
            "whoever has this address with its key may do what this computer may; it travels unencrypted, so use a "
            "network that you trust"
        )
        say(f"on other computers: the same with this computer's address in the place of {host}")
    if not args.connect and not args.drones_at:
        say(
            f"it looks for drones at {ENDPOINT}; for those that connect to this computer, as those of "
            f"`flockd sim --autopilot` do, start it with --drones-at {ENDPOINT}"
        )
    say("Ctrl-C ends it")
    sys.stdout.flush()  # whoever reads a pipe needs the address now


def _ip_address(text: str) -> str:
    """The IP address that an option names, at which something is served."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an IP address such as 127.0.0.1 or 0.0.0.0; for zenoh endpoints there is --drones-at"
        ) from error
