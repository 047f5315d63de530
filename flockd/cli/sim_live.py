"""`flockd sim --live`: flies the scenario in real time, and shows it on the fleet page with its controls."""

from __future__ import annotations

import argparse
import asyncio
import html
import os
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.endpoint_options import ENDPOINT
from flockd.cli.fleet_page import PORT, serve_page
from flockd.cli.fleet_source import HERE
from flockd.cli.output import Phases, complain, say
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.fleet.page.page_server import PageServer
    from flockd.sim.scenario import ScenarioConfig

_KEEPS = {
    "telemetry": "--live has --telemetry in it; drop one of them",
    "record": "--live keeps nothing; fly with --record and without --live",
    "json": "--live has no summary; drop --json",
    "out": "--live writes nothing; drop --out",
    "force": "--live writes nothing; drop --force",
    "autopilot": "--live flies with the simulator's own pilots; drop --autopilot",
    "duration": "--live flies on until Ctrl-C; drop --duration",
}
"""Options that do not go with it, and what to do."""


def check_options(args: argparse.Namespace) -> None:
    """Raises UsageError for options that go without --live, or with it, only."""
    if args.live:
        for option, sentence in _KEEPS.items():
            if getattr(args, option):
                raise UsageError(sentence)
    elif args.port is not None or not args.browser:
        raise UsageError(f"--{'no-browser' if not args.browser else 'port'} is for --live; add that, or drop it")


def fly(args: argparse.Namespace, scenario: ScenarioConfig, fleet: str) -> int:
    """Until Ctrl-C."""
    import aiohttp.web  # noqa: F401 - before anything is opened: it is of an extra

    from flockd.fleet.page.live_fleet import LiveFleet
    from flockd.fleet.page.page_access import PageAccess
    from flockd.fleet.page.page_server import PageServer
    from flockd.fleet.simulation import SimulationLink, key_of
    from flockd.fleet.watcher import FleetWatcher
    from flockd.onboard.telemetry.publisher import ZenohTelemetry
    from flockd.sim.flock.live_controls import LiveControls, answered
    from flockd.sim.flock.live_flight import fly_live
    from flockd.sim.flock.repeater import Repeater
    from flockd.sim.flock.shown_flock import ShownFlock

    endpoint = args.telemetry_at or ENDPOINT
    with suppress(KeyboardInterrupt), ExitStack() as stack:
        zenoh = stack.enter_context(ZenohTelemetry(fleet, listen=[endpoint]))
        controls = LiveControls(scenario, zenoh.identity, by_sight=args.perception != "truth")
        zenoh.reply_to(f"{key_of(fleet)}/**", answered(controls))
        shown = ShownFlock(scenario, zenoh, stack.enter_context(Repeater(zenoh)))
        watcher = stack.enter_context(FleetWatcher(fleet, listen=[], connect=[endpoint]))
        source = stack.enter_context(LiveFleet(watcher))
        access, link = PageAccess(), stack.enter_context(SimulationLink(fleet, watcher))
        page = PageServer(source, access, may_command=True, operator=args.operator, simulation=link)
        port = stack.enter_context(_served(page, PORT if args.port is None else args.port))
        address = f"http://{HERE}:{port}/?key={access.key}"
        say(f"the flock is at {address}")
        if not args.quiet:
            complain(f"other programs find it at {endpoint}; Ctrl-C ends it")
        sys.stdout.flush()  # whoever reads a pipe needs the address now
        if args.browser and _has_screen():
            stack.enter_context(_opened(address))
        with Phases(quiet=args.quiet, verbose=args.verbose) as phases:
            fly_live(
                scenario,
                shown,
                controls,
                perception=args.perception,
                swap=args.swap,
                gated=args.gated,
                preparing=phases.of("loading networks and building the world", "parts"),
            )
    return ExitCode.DONE


def _has_screen() -> bool:
    """Whether a browser has somewhere to open: not a text browser in this terminal."""
    return sys.platform in {"darwin", "win32"} or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def _opened(address: str) -> Iterator[None]:
    """Opens the address in the browser by a page that this user alone may read, while this lasts.

    The address has the key in it, and all users of a computer may see the command lines of all its processes.
    """
    with tempfile.NamedTemporaryFile("w", prefix="flockd-", suffix=".html", encoding="utf-8") as page:
        page.write(f'<meta http-equiv="refresh" content="0; url={html.escape(address)}">')
        page.flush()
        webbrowser.open(Path(page.name).as_uri())
        yield


@contextmanager
def _served(page: PageServer, port: int) -> Iterator[int]:
    """Serves the page on a thread of its own. Gives its port; raises what its start did."""
    loop = asyncio.new_event_loop()
    begun: list[int] = []
    failed: list[BaseException] = []
    known = threading.Event()

    def served(at: int) -> None:
        begun.append(at)
        known.set()

    async def serve() -> None:
        try:
            await serve_page(page, HERE, port, served)
        except Exception as error:  # noqa: BLE001 - raised again where it was started
            failed.append(error)
        finally:
            known.set()

    task = loop.create_task(serve())

    def run() -> None:
        asyncio.set_event_loop(loop)
        with suppress(asyncio.CancelledError):
            loop.run_until_complete(task)
        loop.close()

    thread = threading.Thread(target=run, name="fleet page server", daemon=True)
    thread.start()
    known.wait()
    if failed:
        raise failed[0]
    try:
        yield begun[0]
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
