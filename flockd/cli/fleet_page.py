"""`flockd fleet` without a command: serves the fleet page."""

from __future__ import annotations

import argparse
import asyncio
import sys
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

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
from flockd.cli.parser import Parser
from flockd.core.errors import ExitCode, UnavailableError

if TYPE_CHECKING:
    from aiohttp import web

    from flockd.fleet.page.fleet_source import FleetSource

PORT = 8470


def add_options(parser: Parser) -> None:
    """Of the page, and where its data come from."""
    parser.add_argument(
        "--port", metavar="N", type=port_number, default=PORT, help=f"of the page (default: {PORT}; 0: any)"
    )
    parser.add_argument(
        "--listen", metavar="ADDRESS", type=ip_address, default=HERE, dest="page_address",
        help=f"of the page, such as 0.0.0.0 for other computers too (default: {HERE})",
    )  # fmt: skip
    parser.add_argument("--watch-only", action="store_true", help="the page passes no command on")
    add_source_options(parser)
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    import aiohttp.web  # noqa: F401 - before anything is opened: it is of an extra

    with ExitStack() as stack:
        source = open_source(args, stack)
        with suppress(KeyboardInterrupt):
            asyncio.run(_serve(args, source))
    return ExitCode.DONE


async def _serve(args: argparse.Namespace, source: FleetSource) -> None:
    """Until it is cancelled, as Ctrl-C does."""
    from aiohttp import web

    from flockd.fleet.page.page_access import PageAccess
    from flockd.fleet.page.page_server import PageServer

    access = PageAccess()
    application = PageServer(source, access, may_command=not args.watch_only).application()
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        port = await _listen(runner, args.page_address, args.port)
        for line in [*_told(args.page_address, port, access.key), *places(args), "Ctrl-C ends it"]:
            say(line)
        sys.stdout.flush()  # whoever reads a pipe needs the address now
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


async def _listen(runner: web.AppRunner, address: str, port: int) -> int:
    """The port on which it listens."""
    from aiohttp import web

    try:
        await web.TCPSite(runner, address, port).start()
    except OSError as error:
        raise UnavailableError(f"the page cannot use {address} port {port} ({error.strerror}); name others") from error
    bound: int = runner.addresses[0][1]
    return bound


def _told(address: str, port: int, key: str) -> list[str]:
    """What stands on the terminal once the page can be opened."""
    warning = "whoever has this address with its key may do what this computer may"
    return [f"the fleet page is at http://{in_a_link(address)}:{port}/?key={key}", *for_others(address, warning)]
