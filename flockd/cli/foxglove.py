"""`flockd foxglove`: the fleet in Foxglove's app."""

from __future__ import annotations

import argparse
import re
from contextlib import ExitStack, suppress

from flockd.cli.fleet_source import add_server_options, announce, open_source
from flockd.cli.output import complain
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
    parser.add_argument(
        "--allow-origin", metavar="ORIGIN", type=_origin, action="append", default=[],
        help="whose web pages may connect too, such as http://localhost:8080; Foxglove's own app may, others may not",
    )  # fmt: skip
    parser.set_defaults(run=_run)


def _origin(text: str) -> str:
    if re.fullmatch(r"[a-z][a-z0-9+.-]*://[^/?#\s]+", text) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no origin such as https://example.org or http://localhost:8080")
    return text


def _run(args: argparse.Namespace) -> int:
    """Until Ctrl-C."""
    from flockd.fleet.foxglove.server import FoxgloveServer

    with ExitStack() as stack, suppress(KeyboardInterrupt):
        source = open_source(args, stack)
        server = stack.enter_context(
            FoxgloveServer(source, args.server_address, args.port, origins=args.allow_origin, on_refusal=complain)
        )
        announce(
            args,
            f"Foxglove finds the fleet at ws://{{host}}:{server.port}",
            "whoever reaches this address sees the fleet",
        )
        server.wait()
    return ExitCode.DONE
