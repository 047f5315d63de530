"""Checks limits of the flight, other processes with this drone's autopilot, and the fleet."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.config.document import key_text
from flockd.core.config.real_drone import beyond_envelope
from flockd.core.errors import UnavailableError
from flockd.fleet.watcher import FleetWatcher
from flockd.ground.doctor import Finding, failed, passed, warned

LISTEN_S = 3.0
"""Time to wait for others, which try to connect every second."""


def check_limits(config: DroneConfig) -> Iterator[Finding]:
    """The limits of the flight, and what is outside the proven envelope; ``config``: as `flockd run` flies it."""
    speed, layer = f"{config.flocking.max_speed_m_s:g} m/s at most", config.safety.first_flight_layer
    if layer is None:
        yield passed("first flight", f"off: {speed}")
    else:
        height = f"{config.mission.height_m:g} m above the ground at home"
        yield passed("first flight", f"on: layer {layer}, {height}, {speed}")
    for key, text in beyond_envelope(config).items():
        measured, _, fix = text.partition("; ")
        yield warned(key_text(key), measured, fix)
    if config.perception.drone_size_m is None and config.flocking.size == "off":
        measured = "not given: the networks' estimate gives ranges, often a quarter wrong for unknown airframes"
        fix = "measure the drones from tip to tip and write perception.drone_size_m, or flocking.size: learn"
        yield warned("drone size", measured, fix)


def check_instance(taken: UnavailableError | None) -> Iterator[Finding]:
    """Whether another process owns the link to the autopilot: the error it is refused with."""
    if taken is None:
        yield passed("instance", "no other flockd on this computer has this drone's autopilot")
        return
    fix = "stop it while you examine (`systemctl stop flockd`), if the drone does not fly"
    yield failed("instance", str(taken).rpartition("; ")[0], fix)


def check_fleet(config: DroneConfig, listen_s: float = LISTEN_S) -> Iterator[Finding]:
    """Whether this drone's name is free in its fleet. Raises UnavailableError for endpoints that cannot be used."""
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
        fix = "start the program that listens there (a router, `flockd status --listen`), or fix telemetry.connect"
        yield warned("zenoh", measured, fix)
    else:
        yield passed("zenoh", f"fleet {wanted.fleet} at {where}: {seen}")
