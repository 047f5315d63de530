"""Where the drones of a fleet are found: options of the commands that watch them and of those that ask them."""

from __future__ import annotations

import argparse
from pathlib import Path

from flockd.cli.parser import Parser

ENDPOINT = "tcp/127.0.0.1:7447"


def add_endpoint_options(parser: Parser, listen: str = "--listen") -> None:
    """Adds the fleet's name and the endpoints; ``listen``: the option for where drones connect to."""
    parser.add_argument("--fleet", metavar="NAME", help="only this one; by default every fleet that is heard")
    parser.add_argument(
        "--connect", metavar="ENDPOINT", action="append", help=f"of a drone or a router; by default {ENDPOINT}"
    )
    parser.add_argument(listen, metavar="ENDPOINT", action="append", dest="drones_at", help="where drones connect to")
    parser.add_argument("--zenoh-config", metavar="FILE", type=Path, help="zenoh's own settings, as for TLS")


def endpoints(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Where to listen and what to connect to, as the options say; else the default alone."""
    listen, connect = args.drones_at or [], args.connect or []
    return listen, connect if connect or listen else [ENDPOINT]
