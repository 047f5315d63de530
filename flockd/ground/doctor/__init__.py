"""Examines a drone on the ground. Each check gives its measurement, a level and the remedy. Its time is bounded: a
check that hangs or raises is a failure."""

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
    """The level of a finding."""

    PASS = "PASS"
    WARNING = "WARNING"
    """The drone can fly, but less well or less safely than it could; or the check has no result."""
    FAILURE = "FAILURE"
    """Do not fly."""


@dataclass(frozen=True)
class Finding:
    """The result of one check of one thing."""

    level: Level
    about: str
    """Name of the camera, model, parameter or other thing."""
    measured: str
    fix: str
    """The remedy; empty: none is needed."""


def passed(about: str, measured: str) -> Finding:
    """A finding of level PASS."""
    return Finding(Level.PASS, about, measured, "")


def warned(about: str, measured: str, fix: str) -> Finding:
    """A finding of level WARNING."""
    return Finding(Level.WARNING, about, measured, fix)


def failed(about: str, measured: str, fix: str) -> Finding:
    """A finding of level FAILURE."""
    return Finding(Level.FAILURE, about, measured, fix)


def graded(about: str, measured: str, fix: str, *, failure: bool = False, warning: bool = False) -> Finding:
    """FAILURE or WARNING if its fault is given, the worse first; else PASS."""
    if failure or warning:
        return Finding(Level.FAILURE if failure else Level.WARNING, about, measured, fix)
    return passed(about, measured)


def failed_from_error(about: str, sentence: str) -> Finding:
    """The failure of an error: its sentence ends with the remedy, after the last semicolon."""
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
"""Time limit of each check, for cameras besides the time they are watched. Memory comes before the models are loaded,
and models come last, because they heat up the computer."""
CHECKS = tuple(_LIMITS_S)
BESIDE_A_FLIGHT = frozenset({"limits", "instance", "memory", "disk", "temperature", "clock"})
"""Checks that do not touch a running daemon's autopilot, cameras, endpoints and processor time."""


@dataclass(frozen=True)
class Check:
    """One check of the doctor."""

    name: str
    run: Callable[[], Iterable[Finding]]
    """Runs the check, which changes nothing; its findings count even if it hangs later."""
    limit_s: float
    """Time limit, well above the usual duration."""


@dataclass(frozen=True)
class Examined:
    """The drone, and the parameters of the checks."""

    config: DroneConfig
    recordings: Path | None
    """Folder of recordings; None: that of the service, if it exists."""
    seconds: float
    """Time for which the cameras are watched."""
    taken: UnavailableError | None
    """Why this process does not own the drone's link; None: it does. Otherwise checks that touch the drone are
    skipped."""


def plan(drone: Examined, only: Collection[str] = CHECKS) -> tuple[Check, ...]:
    """The checks of these names, of `CHECKS`, in their order."""
    return tuple(
        Check(name, partial(_check, name, drone), limit_s + (drone.seconds if name == "cameras" else 0.0))
        for name, limit_s in _LIMITS_S.items()
        if name in only
    )


def _check(name: str, drone: Examined) -> Iterable[Finding]:
    """Imports the check when it runs, so that a library that does not load fails this check only."""
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
    """The findings of each check, by name; ``on_done`` is called with the number of checks done and their total."""
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
    """The failure for an exception."""
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
