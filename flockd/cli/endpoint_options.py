"""Where the drones of a fleet are found: options of the commands that watch them and of those that ask them."""

from __future__ import annotations

import argparse
import getpass
import socket
from pathlib import Path

from flockd.cli.parser import Parser
from flockd.core.printable import printable

ENDPOINT = "tcp/127.0.0.1:7447"
LONGEST_OPERATOR = 40
"""The page adds its number, and where it is open."""


def add_endpoint_options(parser: Parser, listen: str = "--listen") -> None:
    """Adds the fleet's name and the endpoints; ``listen``: the option for where drones connect to."""
    parser.add_argument("--fleet", metavar="NAME", help="only this one; by default every fleet that is heard")
    parser.add_argument(
        "--connect", metavar="ENDPOINT", action="append", help=f"of a drone or a router; by default {ENDPOINT}"
    )
    parser.add_argument(listen, metavar="ENDPOINT", action="append", dest="drones_at", help="where drones connect to")
    parser.add_argument("--zenoh-config", metavar="FILE", type=Path, help="zenoh's own settings, as for TLS")


def add_operator_option(parser: Parser) -> None:
    """Adds who gives orders."""
    parser.add_argument(
        "--operator", metavar="NAME", type=_operator, default=_this_person(),
        help="who gives orders, as drones show and log it (default: USER@COMPUTER)",
    )  # fmt: skip


def _operator(text: str) -> str:
    if not 0 < len(text) <= LONGEST_OPERATOR or printable(text, lines=False) != text:
        raise argparse.ArgumentTypeError(f"{text!r} is no name of 1 to {LONGEST_OPERATOR} printable characters")
    return text


def _this_person() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # of a number without a name
        user = "somebody"
    return printable(f"{user}@{socket.gethostname()}", lines=False)[:LONGEST_OPERATOR]


def endpoints(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Where to listen and what to connect to, as the options say; else the default alone."""
    listen, connect = args.drones_at or [], args.connect or []
    return listen, connect if connect or listen else [ENDPOINT]
