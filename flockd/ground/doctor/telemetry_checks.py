"""Telemetry: whether its endpoints can be used, and who else is on the fleet."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.fleet.watcher import FleetWatcher
from flockd.ground.doctor.finding import Finding, failed, passed, warned

LISTEN_S = 3.0
"""Others try again every second to reach this drone."""


def check_fleet(config: DroneConfig, listen_s: float = LISTEN_S) -> Iterator[Finding]:
    """Raises UnavailableError for endpoints or settings that cannot be used."""
    wanted = config.telemetry
    settings = None if wanted.zenoh_config is None else Path(wanted.zenoh_config)
    with FleetWatcher(wanted.fleet, listen=wanted.listen, connect=wanted.connect, settings=settings) as watcher:
        time.sleep(listen_s)
        names = sorted(drone.drone for drone in watcher.drones())
        reached = watcher.reached()
    where = ", ".join([*wanted.listen, *wanted.connect]) or "no endpoint"
    if config.name in names:
        measured = f"another process flies as {wanted.fleet}/{config.name}"
        fix = "give this drone another `name`, or stop the other one; names in a fleet must differ"
        yield failed("zenoh", measured, fix)
        return
    seen = f"sees {', '.join(names)}" if names else "sees no other drone"
    if wanted.connect and not reached:
        measured = f"nothing listens at {', '.join(wanted.connect)}"
        fix = "start what is to listen there (a router, `flockd status --listen`), or fix telemetry.connect"
        yield warned("zenoh", measured, fix)
    else:
        yield passed("zenoh", f"fleet {wanted.fleet} at {where}: {seen}")
