"""Checks the computer: space for recordings, memory, temperature, clocks."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.ground.doctor import Finding, failed, graded, passed, warned
from flockd.onboard.daemon import THERMAL_ZONES, thermal_zones

STATE_FOLDER = Path("/var/lib/flockd")
"""Folder in which the systemd unit lets flockd record."""
MB = 1e6
NEEDS_MB = 350.0
"""Resident memory with the shipped networks and four cameras, besides data that wait for the disk."""
LEAST_MB = 2000.0
"""For one flight: five minutes of four cameras as PNG."""
SPARE_MB = 200.0
SPARE_K = 10.0
MEMORY = Path("/proc/meminfo")
YEARS = (2026, 2100)
"""First possible year: a clock that shows an earlier one was never set."""


def check_disk(config: DroneConfig, folder: Path | None, state_folder: Path = STATE_FOLDER) -> Iterator[Finding]:
    """Whether recordings fit on the disk. ``folder``: as for `flockd run --record`; None: the service's
    ``state_folder``."""
    folder = folder or (state_folder if state_folder.is_dir() else None)
    if folder is None:
        measured = "no folder for recordings was named, so none was checked"
        yield warned(
            "disk", measured, "name it with --record DIR, as for `flockd run`; without one nothing is recorded"
        )
        return
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"flockd")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        fix = "make the folder and give it to the user that flies, as with `chown flockd`, or name another"
        yield failed("disk", f"{folder} cannot be written ({error.strerror})", fix)
        return
    own_mb = sum(path.stat().st_size for path in folder.glob(f"{config.name}-*.mcap")) / MB
    yield judge_room(config, folder, shutil.disk_usage(folder).free / MB, own_mb)


def judge_room(config: DroneConfig, folder: Path, free_mb: float, own_mb: float) -> Finding:
    """Whether the quota fits: it includes this drone's recordings there, of which it deletes the oldest."""
    quota_mb, room_mb = config.recording.quota_mb, free_mb + own_mb
    measured = f"{free_mb / 1e3:.1f} GB free in {folder}, {own_mb / 1e3:.1f} GB are this drone's recordings"
    if room_mb < LEAST_MB:
        return failed("disk", f"{measured}: not enough for a flight of {LEAST_MB / 1e3:g} GB", "make room")
    if room_mb < quota_mb:
        fix = f"make room, or write recording.quota_mb: {0.9 * room_mb:.0f}"
        return warned("disk", f"{measured}: not enough for the quota of {quota_mb / 1e3:g} GB", fix)
    return passed("disk", f"{measured}; the quota of {quota_mb / 1e3:g} GB fits")


def check_memory(config: DroneConfig, meminfo: Path = MEMORY) -> Iterator[Finding]:
    """Whether enough memory is free for flockd."""
    values = dict(line.split(":", 1) for line in meminfo.read_text(encoding="ascii").splitlines())
    free_mb, total_mb = (int(values[key].split()[0]) * 1024 / MB for key in ("MemAvailable", "MemTotal"))
    needs_mb = NEEDS_MB + config.recording.queue_mb
    measured = f"{free_mb:.0f} of {total_mb:.0f} MB are available, flockd needs about {needs_mb:.0f}"
    little = ": little is left" if needs_mb <= free_mb < needs_mb + SPARE_MB else ""
    fix = "stop other programs, or make recording.queue_mb smaller"
    yield graded("memory", f"{measured}{little}", fix, failure=free_mb < needs_mb, warning=bool(little))


def check_temperature(config: DroneConfig, folder: Path = THERMAL_ZONES) -> Iterator[Finding]:
    """The temperature at rest, and whether the processor is throttled."""
    zones = thermal_zones(folder)
    slowed = sorted(processors_slowed(folder))
    if slowed:
        measured = f"the processor is being slowed down ({', '.join(slowed)})"
        yield warned("temperature", measured, "cool it, and check its power supply; then measure the step again")
    if not zones:
        measured = "this computer reports no temperature, so flockd will not notice when it gets too hot"
        yield warned("temperature", measured, "load the driver of its thermal sensor, if it has one")
        return
    hottest, celsius = max(zones, key=lambda zone: zone[1])
    limit_c = config.safety.degraded_temperature_c
    measured = f"{celsius:.0f} °C ({hottest}); from {limit_c:g} on it flies slowly"
    hot, warm = celsius >= limit_c, celsius > limit_c - SPARE_K
    fix = f"{'let it cool down, and ' if hot else ''}improve its airflow, or add a heat sink"
    little = ": little is left" if warm and not hot else ""
    yield graded("temperature", f"{measured}{little}", fix, failure=hot, warning=warm)


def processors_slowed(folder: Path) -> Iterator[str]:
    """Cooling devices that throttle the processor now."""
    for device in folder.glob("cooling_device*"):
        try:
            kind, state = (device / "type").read_text("ascii").strip(), int((device / "cur_state").read_text("ascii"))
        except (OSError, ValueError):
            continue
        if state > 0 and ("cpu" in kind.lower() or "processor" in kind.lower()):
            yield kind


def clock_is_synchronised() -> bool:
    """Whether a time service keeps the wall clock: systemd asks the kernel. Raises OSError where there is none."""
    asked = ("timedatectl", "show", "--property=NTPSynchronized", "--value")
    return subprocess.run(asked, capture_output=True, text=True, timeout=5.0, check=False).stdout.strip() == "yes"


def check_clock(
    synchronised: Callable[[], bool] = clock_is_synchronised,
    today: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> Iterator[Finding]:
    """The wall clock, by which recordings and logs are dated."""
    date = today()
    if not YEARS[0] <= date.year <= YEARS[1]:
        measured = f"the wall clock shows {date:%Y-%m-%d}: recordings get wrong dates, and TLS no valid certificate"
        yield failed("wall clock", measured, "set it (`timedatectl set-time`), or fit a battery for the clock")
    elif not synchronised():
        measured = f"{date:%Y-%m-%d %H:%M} UTC, not synchronised: recordings of several drones will not fit together"
        yield warned("wall clock", measured, "start a time service, as with `timedatectl set-ntp true`")
    else:
        yield passed("wall clock", f"{date:%Y-%m-%d %H:%M} UTC, synchronised")
