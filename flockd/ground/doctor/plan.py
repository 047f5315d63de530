"""Which checks there are, in which order, and how long each may take."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.ground.doctor.finding import Finding, warned
from flockd.ground.doctor.runner import Check

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.core.errors import UnavailableError

CHECKS = (
    "limits",
    "rig",
    "instance",
    "memory",
    "disk",
    "temperature",
    "clock",
    "unit",
    "secrets",
    "zenoh",
    "autopilot",
    "cameras",
    "models",
)
"""Memory before the models are loaded, and those last, as they heat up the computer."""
BESIDE_A_FLIGHT = frozenset({"limits", "instance", "memory", "disk", "temperature", "clock", "unit", "secrets"})
"""They leave alone what a drone flies with: its autopilot, cameras and endpoints, and its computer's time."""


def plan(
    config: DroneConfig,
    file: Path,
    *,
    recordings: Path | None,
    unit: Path | None,
    seconds: float,
    taken: UnavailableError | None,
    only: Collection[str] = CHECKS,
) -> tuple[Check, ...]:
    """The checks of these names for one drone.

    Args:
        config: the drone's.
        file: its path.
        recordings: where flights are recorded; None: in the service's folder, where there is one.
        unit: the systemd unit to judge; None: the installed one, else the one that comes with flockd.
        seconds: how long the cameras are watched.
        taken: why this process may not own the drone's link, which another does; None: it owns it. What would touch
            the drone is then not examined.
        only: of `CHECKS`.
    """

    checks: dict[str, tuple[str, tuple[object, ...], float]] = {
        "limits": ("limit_checks.check_limits", (config,), 5.0),
        "rig": ("rig_checks.check_rig", (config, recordings), 60.0),
        "instance": ("service_checks.check_instance", (taken,), 5.0),
        "memory": ("computer_checks.check_memory", (config,), 5.0),
        "disk": ("computer_checks.check_disk", (config, recordings), 20.0),
        "temperature": ("computer_checks.check_temperature", (config,), 10.0),
        "clock": ("computer_checks.check_clock", (), 10.0),
        "unit": ("service_checks.check_unit", (unit,), 30.0),
        "secrets": ("secret_checks.check_secrets", (config, file), 5.0),
        "zenoh": ("telemetry_checks.check_fleet", (config,), 20.0),
        "autopilot": ("autopilot_checks.check_autopilot", (config,), 60.0),
        "cameras": ("camera_checks.check_cameras", (config, seconds), seconds + 20.0),
        "models": ("model_checks.check_models", (config,), 180.0),
    }
    return tuple(
        Check(name, partial(_run, function, arguments), limit_s)
        if taken is None or name in BESIDE_A_FLIGHT
        else Check(name, partial(_leave_alone, name), limit_s)
        for name, (function, arguments, limit_s) in checks.items()
        if name in only
    )


def _leave_alone(name: str) -> Iterable[Finding]:
    fix = "see `instance`, and examine again once that process has ended"
    yield warned(name, "not examined: another flockd has this drone, and may be flying it", fix)


def _run(function: str, arguments: Sequence[object]) -> Iterable[Finding]:
    """Imports what checks only when it runs: a library that does not load fails its check alone."""
    module, _, name = function.partition(".")
    found: Iterable[Finding] = getattr(import_module(f"flockd.ground.doctor.{module}"), name)(*arguments)
    return found
