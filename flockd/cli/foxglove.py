"""`flockd foxglove`: the fleet in Foxglove's app."""

from __future__ import annotations

import argparse
from contextlib import ExitStack, suppress

from flockd.cli.fleet_source import add_server_options, announce, open_source
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
        "flockd foxglove --recordings out/paper_flight-learned-seed1/recordings",
    )
    parser = commands("foxglove", "Serve the fleet to Foxglove's app: live, or from recordings.", examples, _NOTES)
    add_server_options(parser, PORT)
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    """Until Ctrl-C."""
    from flockd.fleet.foxglove.server import FoxgloveServer

    with ExitStack() as stack, suppress(KeyboardInterrupt):
        source = open_source(args, stack)
        server = stack.enter_context(FoxgloveServer(source, args.server_address, args.port))
        announce(
            args,
            f"Foxglove finds the fleet at ws://{{host}}:{server.port}",
            "whoever reaches this address sees the fleet",
        )
        server.wait()
    return ExitCode.DONE
