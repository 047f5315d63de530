"""Examines a drone on the ground: each check says what it measured, how well that is, and how to fix it. Each is
bounded in time: one that hangs or breaks is a failure."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.core.errors import FlockdError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.core.errors import UnavailableError


class Level(StrEnum):
    """How well it is."""

    PASS = "PASS"
    WARNING = "WARNING"
    """It flies, but not as well or as safely as it could, or the check could not tell."""
    FAILURE = "FAILURE"
    """Do not fly."""


@dataclass(frozen=True)
class Finding:
    """The result of one check of one thing."""

    level: Level
    about: str
    """Which camera, model, parameter ..."""
    measured: str
    fix: str
    """What to do; empty where nothing is to be done."""


def passed(about: str, measured: str) -> Finding:
    """All is well."""
    return Finding(Level.PASS, about, measured, "")


def warned(about: str, measured: str, fix: str) -> Finding:
    """It could be better."""
    return Finding(Level.WARNING, about, measured, fix)


def failed(about: str, measured: str, fix: str) -> Finding:
    """It must not be like this."""
    return Finding(Level.FAILURE, about, measured, fix)


def graded(about: str, measured: str, fix: str, *, failure: bool = False, warning: bool = False) -> Finding:
    """Failed or warned where one of these holds, the worse first; else passed."""
    if failure or warning:
        return Finding(Level.FAILURE if failure else Level.WARNING, about, measured, fix)
    return passed(about, measured)


def failed_from_error(about: str, sentence: str) -> Finding:
    """The failure that an error's sentence describes: our sentences end in what to do, after the last semicolon."""
    measured, _, fix = sentence.rpartition("; ")
    return failed(about, measured or fix, fix if measured else "correct it, and run `flockd doctor` again")


_LIMITS_S = {
    "limits": 5.0,
    "rig": 120.0,
    "instance": 5.0,
    "memory": 5.0,
    "disk": 20.0,
    "temperature": 10.0,
    "clock": 10.0,
    "zenoh": 20.0,
    "autopilot": 60.0,
    "cameras": 20.0,
    "models": 180.0,
}
"""How long each may take, the cameras beside what they are watched. Memory before the models are loaded, and those
last, as they heat up the computer."""
CHECKS = tuple(_LIMITS_S)
BESIDE_A_FLIGHT = frozenset({"limits", "instance", "memory", "disk", "temperature", "clock"})
"""Checks that leave alone what a drone flies with: its autopilot, cameras and endpoints, and its computer's time."""


@dataclass(frozen=True)
class Check:
    """One check of the doctor."""

    name: str
    run: Callable[[], Iterable[Finding]]
    """Changes nothing; what it finds counts even if it hangs later."""
    limit_s: float
    """Much longer than the check should take."""


@dataclass(frozen=True)
class Examined:
    """A drone, and what its checks need to know."""

    config: DroneConfig
    recordings: Path | None
    """Where flights are recorded; None: in the service's folder, where there is one."""
    seconds: float
    """How long the cameras are watched."""
    taken: UnavailableError | None
    """Why this process may not own the drone's link; None: it owns it. Without it, whatever would touch the drone is
    not examined."""


def plan(drone: Examined, only: Collection[str] = CHECKS) -> tuple[Check, ...]:
    """The checks of these names, of `CHECKS`, in their order."""
    return tuple(
        Check(name, partial(_check, name, drone), limit_s + (drone.seconds if name == "cameras" else 0.0))
        for name, limit_s in _LIMITS_S.items()
        if name in only
    )


def _check(name: str, drone: Examined) -> Iterable[Finding]:
    """Imports what checks only when it runs: a library that does not load fails its check alone."""
    config = drone.config
    if drone.taken is not None and name not in BESIDE_A_FLIGHT:
        fix = "see `instance`, and examine again once that process has ended"
        return (warned(name, "not examined: another flockd has this drone, and may be flying it", fix),)
    match name:
        case "memory" | "disk" | "temperature" | "clock":
            from flockd.ground.doctor import computer_checks as computer

            if name == "disk":
                return computer.check_disk(config, drone.recordings)
            if name == "clock":
                return computer.check_clock()
            return computer.check_memory(config) if name == "memory" else computer.check_temperature(config)
        case "autopilot":
            from flockd.ground.doctor.autopilot_checks import check_autopilot

            return check_autopilot(config)
        case "rig" | "cameras":
            from flockd.ground.doctor import camera_checks as cameras

            if name == "rig":
                return cameras.check_rig(config, drone.recordings)
            return cameras.check_cameras(config, drone.seconds)
        case "models":
            from flockd.ground.doctor.model_checks import check_models

            return check_models(config)
    from flockd.ground.doctor import setup_checks as setup

    if name == "limits":
        return setup.check_limits(config)
    return setup.check_fleet(config) if name == "zenoh" else setup.check_instance(drone.taken)


def run_checks(checks: Sequence[Check], on_done: Callable[[int, int], None]) -> dict[str, tuple[Finding, ...]]:
    """What each check found, by its name; ``on_done`` is called with how many of how many are done."""
    found = {}
    for number, check in enumerate(checks, start=1):
        found[check.name] = _bounded(check)
        on_done(number, len(checks))
    return found


def _bounded(check: Check) -> tuple[Finding, ...]:
    found: list[Finding] = []

    def run() -> None:
        try:
            found.extend(check.run())
        except BaseException as error:  # noqa: BLE001 - reported, whatever it is
            found.append(_of_error(check.name, error))

    thread = threading.Thread(target=run, name=f"check {check.name}", daemon=True)
    thread.start()
    thread.join(check.limit_s)
    if thread.is_alive():
        measured = f"the check has not ended within {check.limit_s:g} s"
        fix = "a device or service does not respond: read this check's other findings and the kernel's log (`dmesg`)"
        return (*found, failed(check.name, measured, fix))
    return tuple(found)


def _of_error(about: str, error: BaseException) -> Finding:
    """The failure that an error means."""
    match error:
        case FlockdError():
            return failed_from_error(about, str(error))
        case ImportError():
            return failed(about, f"a library cannot be loaded ({error})", "install flockd again, for this computer")
        case OSError():
            what = f"{error.filename or 'the system'}: {error.strerror or error}"
            return failed(about, what, "check that it responds")
    fix = "report it to flockd's developers, with your configuration"
    return failed(about, f"the check itself failed ({error!r})", fix)
