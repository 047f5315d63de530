"""Checks `flockd doctor --bench` on kernel cameras: the shipped networks, frames of both drivers, a fake autopilot."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator

from tools.checks.device_check.cameras import feeding, loopback
from tools.checks.device_check.findings import Finding
from tools.checks.device_check.service import CAMERAS, CONFIG, FRONT_SIZE, RATE_HZ, Service

MINUTES = 0.5
PATIENCE_S = 300.0
"""Networks on an emulated processor."""
NEEDED = {"bench", "steps", "load", *(f"camera {name}" for name in CAMERAS), "control loop", "autopilot", "commands"}
"""What has to pass. The rest depends on what cameras and computer show: these show no world and have no thermometer."""


def runs(service: Service) -> Iterator[Finding]:
    """As the unit's own user in the unit's groups, before the unit starts; one row for each of the bench's."""
    command = ["/opt/flockd/bin/flockd", "doctor", "--config", CONFIG, "--bench", "--minutes", f"{MINUTES:g}", "--json"]
    with feeding(loopback(FRONT_SIZE, RATE_HZ)):
        ended = subprocess.run(
            ["runuser", "-u", "flockd", "-G", "video", "-G", "dialout", "--", *command],
            capture_output=True, text=True, check=False, timeout=60.0 * MINUTES + PATIENCE_S,
        )  # fmt: skip
    if not ended.stdout.strip():
        raise RuntimeError(f"exit code {ended.returncode}: {ended.stderr.strip()}")
    rows = {row["about"]: row for row in json.loads(ended.stdout)["findings"]}
    for about in sorted(NEEDED - rows.keys()):
        yield Finding(f"bench: {about}", passed=False, measured="no word of it", wanted="PASS")
    for about, row in rows.items():
        needed = about in NEEDED
        passed = row["level"] == "PASS" or (not needed and row["level"] == "WARNING")
        wanted = "PASS" if needed else "no FAILURE"
        yield Finding(f"bench: {about}", passed, f"{row['level']}, {row['measured']}", wanted)
    autopilot = service.autopilot
    sent, state = len(autopilot.setpoints), f"{autopilot.mode}, {'armed' if autopilot.armed else 'disarmed'}"
    yield Finding(
        "bench: what the autopilot got",
        (sent, autopilot.mode, autopilot.armed) == (0, "LOITER", False),
        f"{sent} setpoints; {state}",
        "no setpoint; LOITER, disarmed",
    )
