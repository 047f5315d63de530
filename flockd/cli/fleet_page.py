"""`flockd fleet` without a command: serves the fleet page."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.endpoint_options import add_operator_option
from flockd.cli.fleet_source import add_server_options, announce, open_source
from flockd.cli.parser import Parser
from flockd.core.errors import ExitCode, UnavailableError

if TYPE_CHECKING:
    from flockd.fleet.page.fleet_source import FleetSource
    from flockd.fleet.page.page_connections import PageConnections
    from flockd.fleet.page.page_server import PageServer

PORT = 8470


def add_options(parser: Parser) -> None:
    """Adds the page's options, and those that say where its data come from."""
    add_server_options(parser, PORT)
    parser.add_argument("--watch-only", action="store_true", help="the page passes no command on")
    parser.add_argument(
        "--key-file", metavar="FILE", type=Path,
        help="keep the key of the page's address in it, so that open pages go on after a new start (default: a new key "
        "at each start)",
    )  # fmt: skip
    add_operator_option(parser)
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    import aiohttp.web  # noqa: F401 - before anything is opened: it is of an extra

    with ExitStack() as stack:
        source = open_source(args, stack)
        with suppress(KeyboardInterrupt):
            asyncio.run(_serve(args, source))
    return ExitCode.DONE


async def _serve(args: argparse.Namespace, source: FleetSource) -> None:
    from flockd.fleet.page.page_access import PageAccess, lasting_key
    from flockd.fleet.page.page_server import PageServer

    access = PageAccess(None if args.key_file is None else lasting_key(args.key_file))
    page = PageServer(source, access, may_command=not args.watch_only, operator=args.operator)

    def served(port: int) -> None:
        sentence = f"the fleet page is at http://{{host}}:{port}/?key={access.key}"
        announce(args, sentence, "whoever has this address with its key may do what this computer may")

    await serve_page(page, args.server_address, args.port, served)


async def serve_page(page: PageServer, address: str, port: int, served: Callable[[int], None]) -> None:
    """Until it is cancelled, as Ctrl-C does. ``served``: is told the port, once there is somebody at it.

    Raises UnavailableError for an address or a port that cannot be used.
    """
    from aiohttp import web

    from flockd.fleet.page.page_connections import PageConnections

    runner = web.AppRunner(page.application(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        assert runner.server is not None
        connections = PageConnections(runner.server, page.trusted)
        served(await _listen(connections, address, port))
        await connections.run()
    finally:
        await runner.cleanup()


async def _listen(connections: PageConnections, address: str, port: int) -> int:
    """The port on which it listens."""
    try:
        server = await asyncio.get_running_loop().create_server(connections, address, port)
    except OSError as error:
        raise UnavailableError(f"the page cannot use {address} port {port} ({error.strerror}); name others") from error
    bound: int = server.sockets[0].getsockname()[1]
    return bound
