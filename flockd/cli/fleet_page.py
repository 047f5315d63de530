"""`flockd fleet` without a command: serves the fleet page."""

from __future__ import annotations

import argparse
import asyncio
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

from flockd.cli.fleet_source import add_server_options, announce, open_source
from flockd.cli.parser import Parser
from flockd.core.errors import ExitCode, UnavailableError

if TYPE_CHECKING:
    from aiohttp import web

    from flockd.fleet.page.fleet_source import FleetSource

PORT = 8470


def add_options(parser: Parser) -> None:
    """Adds the page's options, and those that say where its data come from."""
    add_server_options(parser, PORT)
    parser.add_argument("--watch-only", action="store_true", help="the page passes no command on")
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
        port = await _listen(runner, args.server_address, args.port)
        sentence = f"the fleet page is at http://{{host}}:{port}/?key={access.key}"
        announce(args, sentence, "whoever has this address with its key may do what this computer may")
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
