"""Options of the fleet page and of the Foxglove server: where the fleet is found, and where they serve it."""

from __future__ import annotations

import argparse
import ipaddress
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.output import complain, progress
from flockd.cli.parser import Parser
from flockd.cli.status import ENDPOINT
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from flockd.fleet.page.fleet_source import FleetSource


HERE = "127.0.0.1"
"""Where they serve unless told otherwise: for this computer alone."""


def add_source_options(parser: Parser) -> None:
    """Telemetry, or recordings."""
    parser.add_argument(
        "--recordings", metavar="FOLDER", type=Path, help="show the recordings in it on one time line, not telemetry"
    )
    parser.add_argument("--fleet", metavar="NAME", help="only this one; by default every fleet that publishes")
    parser.add_argument(
        "--connect", metavar="ENDPOINT", action="append", help=f"of a drone or a router; by default {ENDPOINT}"
    )
    parser.add_argument("--drones-at", metavar="ENDPOINT", action="append", help="where drones connect to")
    parser.add_argument("--zenoh-config", metavar="FILE", type=Path, help="zenoh's own settings, as for TLS")


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
    connect, listen = args.connect or [], args.drones_at or []
    if not connect and not listen:
        connect = [ENDPOINT]
    watcher = FleetWatcher(args.fleet, listen=listen, connect=connect, settings=args.zenoh_config)
    return stack.enter_context(LiveFleet(stack.enter_context(watcher)))


def places(args: argparse.Namespace) -> list[str]:
    """What stands on the terminal about where drones are looked for; nothing where the options say it."""
    if args.recordings is not None or args.connect or args.drones_at:
        return []
    return [
        f"it looks for drones at {ENDPOINT}; for those that connect to this computer, as those of "
        f"`flockd sim --autopilot` do, start it with --drones-at {ENDPOINT}"
    ]


def in_a_link(address: str) -> str:
    """An IP address as it stands there; for all addresses of this computer, the one at which it reaches itself."""
    where = ipaddress.ip_address(address)
    return HERE if where.is_unspecified else f"[{address}]" if where.version == 6 else address


def for_others(address: str, warning: str) -> list[str]:
    """What stands on the terminal where other computers reach this address, too; `warning`: who may do what then."""
    if ipaddress.ip_address(address).is_loopback:
        return []
    complain(f"{warning}; it travels unencrypted, so use a network that you trust")
    return [f"on other computers: the same with this computer's address in the place of {in_a_link(address)}"]


def port_number(text: str) -> int:
    """Of an option."""
    if not (text.isascii() and text.isdecimal() and int(text) < 1 << 16):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, a whole number from 0 to 65535")
    return int(text)


def ip_address(text: str) -> str:
    """Of an option, at which something is served."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an IP address such as 127.0.0.1 or 0.0.0.0; for zenoh endpoints there is --drones-at"
        ) from error
