"""Limits of the flight, which secrets others may read, and who else is there: on this computer, on the fleet."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.config.document import key_text
from flockd.core.config.real_drone import beyond_envelope
from flockd.core.errors import UnavailableError
from flockd.core.secrets import masked
from flockd.fleet.watcher import FleetWatcher
from flockd.ground.doctor import Finding, failed, passed, warned
from flockd.onboard.telemetry.zenoh_session import SessionError, private_keys

LISTEN_S = 3.0
"""Others try again every second to reach this drone."""
_READABLE, _WRITABLE = 0o004, 0o022


def check_limits(config: DroneConfig) -> Iterator[Finding]:
    """``config`` as it is flown."""
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
        measured = "nobody says it: ranges follow from what the networks judge, often a quarter off for new airframes"
        fix = "measure the drones from tip to tip and write perception.drone_size_m, or flocking.size: learn"
        yield warned("drone size", measured, fix)


def check_instance(taken: UnavailableError | None) -> Iterator[Finding]:
    """Whether another process owns the link to the autopilot: the error it is refused with."""
    if taken is None:
        yield passed("instance", "no other flockd on this computer has this drone's autopilot")
        return
    fix = "stop it while you examine (`systemctl stop flockd`), if the drone does not fly"
    yield failed("instance", str(taken).rpartition("; ")[0], fix)


def check_secrets(config: DroneConfig, file: Path) -> Iterator[Finding]:
    """``file``: the configuration's."""
    values = config.model_dump(mode="json")
    yield _judge_file(file, "holds a password" if masked(values) != values else "")
    settings = config.telemetry.zenoh_config
    if settings is None:
        return
    yield _judge_file(Path(settings), "holds a password" if _holds_password(Path(settings)) else "")
    try:
        keys = private_keys(Path(settings))
    except SessionError as error:
        yield failed("secrets", str(error).rpartition("; ")[0], "correct the file of zenoh's settings")
        return
    for key in keys:
        yield _judge_file(key, "is a private key")


def _holds_password(file: Path) -> bool:
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False  # said by what follows
    return '"' in text and ("password:" in text or "_base64:" in text)


def _judge_file(file: Path, secret: str) -> Finding:
    """``secret``: what others must not read in it; empty where they may."""
    try:
        mode = file.stat().st_mode
    except OSError as error:
        fix = "examine as the user that flies: `sudo -u flockd flockd doctor ...`, or correct the path"
        return warned("secrets", f"{file} cannot be examined ({error.strerror})", fix)
    close = f"`sudo chgrp flockd {file}`, `sudo chmod 640 {file}`: for its owner and the service alone"
    if secret and mode & _READABLE:
        return failed("secrets", f"{file} {secret}, and every user of this computer may read it", close)
    if mode & _WRITABLE:
        return failed("secrets", f"{file} may be changed by others than its owner", f"`sudo chmod go-w {file}`")
    return passed("secrets", f"{file} {secret or 'holds no password'}, mode {mode & 0o777:o}")


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
