"""`flockd foxglove`: the fleet in Foxglove's app."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack, suppress

from flockd.cli.fleet_source import (
    HERE,
    add_source_options,
    for_others,
    in_a_link,
    ip_address,
    open_source,
    places,
    port_number,
)
from flockd.cli.output import say
from flockd.cli.parser import Commands
from flockd.core.errors import ExitCode

PORT = 8765
"""Which the app proposes."""
_NOTES = """\
In the app: Open connection, Foxglove WebSocket, the printed address; then import `config/foxglove_layout.json` as a
layout. The app can only watch. Pictures come from daemons, on a drone or with `flockd sim --autopilot`."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd foxglove",
        "flockd foxglove --connect tcp/10.0.0.11:7447 --connect tcp/10.0.0.12:7447",
        "flockd foxglove --recordings out/paper-flight-learned-seed1/recordings",
    )
    parser = commands("foxglove", "Serve the fleet to Foxglove's app: live, or from recordings.", examples, _NOTES)
    parser.add_argument("--port", metavar="N", type=port_number, default=PORT, help=f"(default: {PORT}; 0: any)")
    parser.add_argument(
        "--listen", metavar="ADDRESS", type=ip_address, default=HERE, dest="server_address",
        help=f"of the server, such as 0.0.0.0 for other computers too (default: {HERE})",
    )  # fmt: skip
    add_source_options(parser)
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    """Until Ctrl-C."""
    from flockd.fleet.foxglove.server import FoxgloveServer

    with ExitStack() as stack, suppress(KeyboardInterrupt):
        source = open_source(args, stack)
        server = stack.enter_context(FoxgloveServer(source, args.server_address, args.port))
        for line in [*_told(args.server_address, server.port), *places(args), "Ctrl-C ends it"]:
            say(line)
        sys.stdout.flush()  # whoever reads a pipe needs the address now
        server.wait()
    return ExitCode.DONE


def _told(address: str, port: int) -> list[str]:
    """What stands on the terminal once the app can connect."""
    warning = "whoever reaches this address sees the fleet"
    return [f"Foxglove finds the fleet at ws://{in_a_link(address)}:{port}", *for_others(address, warning)]
