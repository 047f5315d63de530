"""Which checks there are, in which order, and how long each may take."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.ground.doctor.finding import Finding
from flockd.ground.doctor.runner import Check

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig

CHECKS = (
    "instance",
    "memory",
    "disk",
    "temperature",
    "clock",
    "unit",
    "zenoh",
    "autopilot",
    "cameras",
    "models",
)
"""Memory before the models are loaded, and those last, as they heat up the computer."""


def plan(
    config: DroneConfig,
    *,
    recordings: Path | None,
    unit: Path | None,
    seconds: float,
    environment: Mapping[str, str],
    only: Collection[str] = CHECKS,
) -> tuple[Check, ...]:
    """The checks of these names for one drone.

    Args:
        config: the drone's.
        recordings: where flights are recorded; None: in the service's folder, where there is one.
        unit: the systemd unit to judge; None: the installed one, else the one that comes with flockd.
        seconds: how long the cameras are watched.
        environment: the process's own.
        only: of `CHECKS`.
    """

    # Each imports what it checks when it runs: a library that does not load fails its check alone.
    def instance() -> Iterable[Finding]:
        from flockd.ground.doctor.service_checks import check_instance

        return check_instance(config.name, environment)

    def memory() -> Iterable[Finding]:
        from flockd.ground.doctor.computer_checks import check_memory

        return check_memory(config)

    def disk() -> Iterable[Finding]:
        from flockd.ground.doctor.computer_checks import check_disk

        return check_disk(config, recordings)

    def temperature() -> Iterable[Finding]:
        from flockd.ground.doctor.computer_checks import check_temperature

        return check_temperature(config)

    def clock() -> Iterable[Finding]:
        from flockd.ground.doctor.computer_checks import check_clock

        return check_clock()

    def exposure() -> Iterable[Finding]:
        from flockd.ground.doctor.service_checks import check_unit

        return check_unit(unit)

    def zenoh() -> Iterable[Finding]:
        from flockd.ground.doctor.telemetry_checks import check_fleet

        return check_fleet(config)

    def autopilot() -> Iterable[Finding]:
        from flockd.ground.doctor.autopilot_checks import check_autopilot

        return check_autopilot(config)

    def cameras() -> Iterable[Finding]:
        from flockd.ground.doctor.camera_checks import check_cameras

        return check_cameras(config, seconds)

    def models() -> Iterable[Finding]:
        from flockd.ground.doctor.model_checks import check_models

        return check_models(config)

    runs: dict[str, tuple[Callable[[], Iterable[Finding]], float]] = {
        "instance": (instance, 5.0),
        "memory": (memory, 5.0),
        "disk": (disk, 20.0),
        "temperature": (temperature, 10.0),
        "clock": (clock, 10.0),
        "unit": (exposure, 30.0),
        "zenoh": (zenoh, 20.0),
        "autopilot": (autopilot, 60.0),
        "cameras": (cameras, seconds + 20.0),
        "models": (models, 180.0),
    }
    return tuple(Check(name, *runs[name]) for name in CHECKS if name in only)
