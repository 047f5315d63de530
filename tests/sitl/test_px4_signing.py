"""PX4 with a MAVLink 2 signing key does not listen to flockd, and the doctor says so; without it, all is as before."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from flockd.core.config import DroneConfig, load_drone
from flockd.core.data import data_path
from flockd.ground.doctor.autopilot_checks import check_autopilot
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import load_scenario
from flockd.sim.sitl.autopilots import Px4s
from tests.sitl.sitl_run import PX4

SPEED_FACTOR, START_S, TIMES, PAUSE_S = 0.5, 120.0, 5, 0.5
KEY, NO_KEY = bytes(range(1, 33)), bytes(32)
EPOCH_2015_S, TICKS_A_S = 1420070400, 1e5
"""Epoch and ticks of MAVLink's signature time stamps."""
LATER = 10**8


def _is_deaf(config: DroneConfig) -> bool:
    return any(finding.about == "signing" for finding in check_autopilot(config))


def _again(send: Callable[[], None]) -> None:
    """Datagrams may be lost."""
    for _ in range(TIMES):
        send()
        time.sleep(PAUSE_S)


@PX4
@pytest.mark.slow
def test_with_a_key_px4_hears_nobody_who_does_not_sign_until_the_key_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    config = load_drone(data_path("config") / "px4_sitl.yaml")
    scenario = with_drones(load_scenario(data_path("config") / "px4_flight.yaml"), 1)
    with Px4s(scenario, SPEED_FACTOR, os.environ, tmp_path, {}) as px4:
        px4.start()
        station: Any = mavutil.mavlink_connection(f"udpin:127.0.0.1:{px4.ports[0].truth}", source_system=255)
        try:
            assert station.wait_heartbeat(timeout=START_S) is not None
            assert not _is_deaf(config), "it accepts unsigned messages"
            stamp = int((time.time() - EPOCH_2015_S) * TICKS_A_S)
            _again(lambda: station.mav.setup_signing_send(1, 1, KEY, stamp))
            assert _is_deaf(config), "it is heard and does not respond"
            station.setup_signing(KEY, sign_outgoing=True, initial_timestamp=stamp + LATER)
            _again(lambda: station.mav.setup_signing_send(1, 1, NO_KEY, 0))
            assert not _is_deaf(config), "the old key signed its own removal"
        finally:
            station.close()
