"""Options of the fleet page: where the fleet is found, and where the page is served."""

from __future__ import annotations

import argparse
import ipaddress
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.endpoint_options import ENDPOINT, add_endpoint_options, endpoints
from flockd.cli.output import complain, progress, say
from flockd.cli.parser import Parser
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from flockd.fleet.page.fleet_source import FleetSource


HERE = "127.0.0.1"
"""Where it is served unless told otherwise: for this computer alone."""


def add_server_options(parser: Parser, port: int) -> None:
    """Where it serves, and where its data come from: telemetry, or recordings."""
    parser.add_argument("--port", metavar="N", type=port_number, default=port, help=f"(default: {port}; 0: any)")
    parser.add_argument(
        "--listen", metavar="ADDRESS", type=ip_address, default=HERE, dest="server_address",
        help=f"of the server, such as 0.0.0.0 for other computers too (default: {HERE})",
    )  # fmt: skip
    parser.add_argument(
        "--recordings", metavar="FOLDER", type=Path, help="show the recordings in it on one time line, not telemetry"
    )
    add_endpoint_options(parser, "--drones-at")


def open_source(args: argparse.Namespace, stack: ExitStack) -> FleetSource:
    """As the options say; what has to be closed is left to ``stack``."""
    from flockd.fleet.page.live_fleet import LiveFleet
    from flockd.fleet.page.recorded_fleet import RecordedFleet
    from flockd.fleet.watcher import FleetWatcher

    if args.recordings is not None:
        if args.connect or args.drones_at or args.fleet or args.zenoh_config:
            raise UsageError(
                "--recordings goes without telemetry; drop --connect, --drones-at, --fleet, --zenoh-config"
            )
        with progress("reading", "MB") as tell_progress:
            return RecordedFleet(args.recordings, lambda done, total: tell_progress(done >> 20, total >> 20))
    listen, connect = endpoints(args)
    watcher = FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config)
    return stack.enter_context(LiveFleet(stack.enter_context(watcher)))


def announce(args: argparse.Namespace, sentence: str, warning: str) -> None:
    """Says where it is served, once it is.

    ``sentence`` has a place `{host}`; ``warning`` says what those who reach it may do, where other computers can.
    """
    where = ipaddress.ip_address(args.server_address)
    # For all addresses of this computer, the one at which it reaches itself.
    host = HERE if where.is_unspecified else f"[{where}]" if where.version == 6 else str(where)
    say(sentence.format(host=host))
    if not where.is_loopback:
        complain(f"{warning}; it travels unencrypted, so use a network that you trust")
        say(f"on other computers: the same with this computer's address in the place of {host}")
    if args.recordings is None and not args.connect and not args.drones_at:
        say(
            f"it looks for drones at {ENDPOINT}; for those that connect to this computer, as those of "
            f"`flockd sim --autopilot` do, start it with --drones-at {ENDPOINT}"
        )
    say("Ctrl-C ends it")
    sys.stdout.flush()  # whoever reads a pipe needs the address now


def port_number(text: str) -> int:
    """The port number that an option names."""
    if not (text.isascii() and text.isdecimal() and int(text) < 1 << 16):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, a whole number from 0 to 65535")
    return int(text)


def ip_address(text: str) -> str:
    """The IP address that an option names, at which something is served."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an IP address such as 127.0.0.1 or 0.0.0.0; for zenoh endpoints there is --drones-at"
        ) from error
