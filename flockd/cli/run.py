"""`flockd run`: flies this drone until SIGTERM or Ctrl-C."""

from __future__ import annotations

import argparse
import asyncio
import functools
import logging
import os
import resource
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import add_force, load_to_fly
from flockd.cli.parser import Commands, existing, option
from flockd.core.errors import ExitCode, UnavailableError, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.onboard.daemon import Daemon, ServiceManager

WAITING_EVERY_S = 5.0
FILES_NEEDED = 128
IGNORED = (
    "SIGHUP is ignored; to fly with a changed configuration: `flockd config check %s`, then, with the drone on the "
    "ground, end flockd and start it again"
)
ADDRESSES_NEEDED_MB = 3072
"""What a flight takes, with some to spare. With less, libraries end the process on their own, some by an abort."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd run --config config/quadrotor.yaml",
        "flockd run --config /etc/flockd/drone1.yaml --record /var/lib/flockd",
    )
    description = "Fly this drone: from camera frames to setpoints for its autopilot, until SIGTERM or Ctrl-C."
    parser = commands("run", description, examples, _run)
    option(parser, "--config FILE", "the drone's configuration", existing, required=True)
    option(
        parser,
        "--record DIR",
        "write a recording of each flight to this folder, created if missing; see `recording` in the configuration",
        Path,
    )
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    _check_limits()
    from flockd.onboard.daemon import StderrLog

    log = StderrLog()
    dated = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "  # the journal dates its lines itself
    log.setFormatter(logging.Formatter(f"{dated}%(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[log])
    logging.getLogger("flockd.onboard.autopilot").setLevel(logging.WARNING)  # MAVSDK tells a lot of itself
    try:
        return _run_daemon(args)
    finally:
        log.close()  # before the last sentence


def _run_daemon(args: argparse.Namespace) -> int:
    """Runs the daemon until it is asked to end."""
    from flockd.onboard.autopilot.link_owner import only_owner
    from flockd.onboard.daemon import ServiceManager
    from flockd.onboard.simulated_time import event_loop_at

    service = ServiceManager(os.environ)
    config = load_to_fly(args.config, force=args.force)
    if args.record is not None:
        try:
            args.record.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise UsageError(f"{args.record}: is not a folder; name another with --record") from error
    event_loop = functools.partial(event_loop_at, config.speed_factor)
    with only_owner(config.autopilot), asyncio.Runner(loop_factory=event_loop) as runner:
        runner.run(_fly(config, args, service))
    return ExitCode.DONE


def _check_limits() -> None:
    """Takes as many file descriptors as it may have. Raises UnavailableError where a limit is too low for a flight."""
    files, most_files = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and files < FILES_NEEDED:
        if most_files != resource.RLIM_INFINITY and most_files < FILES_NEEDED:
            raise UnavailableError(
                f"this process may open {most_files} files, and a flight needs {FILES_NEEDED}; raise the limit "
                "(LimitNOFILE= of the service, or ulimit -n)"
            )
        resource.setrlimit(resource.RLIMIT_NOFILE, (FILES_NEEDED, most_files))
    addresses, _ = resource.getrlimit(resource.RLIMIT_AS)
    if addresses != resource.RLIM_INFINITY and addresses < ADDRESSES_NEEDED_MB << 20:
        raise UnavailableError(
            f"this process may use {addresses >> 20} MiB of addresses, and a flight needs {ADDRESSES_NEEDED_MB}; raise "
            "the limit (LimitAS= of the service, or ulimit -v); to bound memory, use MemoryMax="
        )


async def _fly(config: DroneConfig, args: argparse.Namespace, service: ServiceManager) -> None:
    """With SIGTERM and Ctrl-C for standstill, Hold and the end. A terminal that closes ends no flight."""
    from flockd.flight.inference.manifest_file import model_hashes
    from flockd.flight.perception import load_networks
    from flockd.onboard.daemon import Daemon, cameras_at_once
    from flockd.onboard.simulated_time import clock_at
    from flockd.onboard.worker import GOLDEN_S, within

    daemon = Daemon(
        config,
        str(args.config),
        load_networks=lambda: load_networks(config.perception, within(GOLDEN_S), at_once=cameras_at_once(config)),
        models=model_hashes(config.perception),
        recordings=args.record,
        service=service,
        clock=clock_at(config.speed_factor),
    )
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, daemon.ask_to_stop)
    loop.add_signal_handler(signal.SIGINT, daemon.ask_to_stop)
    loop.add_signal_handler(signal.SIGHUP, logging.getLogger("flockd").warning, IGNORED, args.config)
    waiting = asyncio.create_task(_say_what_it_waits_for(daemon, WAITING_EVERY_S * config.speed_factor))
    try:
        await daemon.run()
    finally:
        waiting.cancel()


async def _say_what_it_waits_for(daemon: Daemon, every_s: float) -> None:
    """Every few seconds of the event loop's clock, until it is ready."""
    while (what := daemon.waits_for()) is not None:
        logging.getLogger("flockd").info("waits for %s", what)
        await asyncio.sleep(every_s)
