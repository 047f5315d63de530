"""Reasons for which PX4 SITL refuses to arm or to fly offboard, as `flockd status` shows them; `pytest -rP` prints.

One PX4 and one `flockd run` for each; it is provoked, and taken back where that is possible.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.fleet.drone_rows import status_rows
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.autopilot.refusal_reasons import NOT_STREAMING, REASONS, SEVERAL_SENDERS
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import load_scenario
from flockd.sim.sitl.autopilots import Px4s
from flockd.sim.sitl.daemons import Daemons
from flockd.sim.sitl.processes import free_endpoint
from tests.make import changed
from tests.sitl.sitl_run import PX4, SitlRun

FLEET = "reasons"
START_S, SHOWN_S, GONE_S = 300.0, 60.0, 60.0
"""For PX4 and the daemon to come up without a reason; for a reason to be shown; and to be gone again."""
POLL_S = 0.2
OTHER_PORT = 14030
"""Where PX4's instance 0 looks for a further onboard computer."""


@dataclass(frozen=True)
class Provocation:
    """One reason, and how it is provoked."""

    name: str
    reason: str
    """Its name in the table of reasons."""
    begin: Callable[[Bench], None] = lambda bench: None
    end: Callable[[Bench], None] = lambda bench: None
    parameters: Mapping[str, str] = field(default_factory=dict)
    """From the start, of a PX4 of its own."""
    lasting: bool = False
    """It cannot be taken back, nor be waited for to be gone."""


def _set(parameter: str, value: str, normal: str, reason: str, name: str) -> Provocation:
    """By a parameter that PX4 reads at any time."""
    return Provocation(
        name,
        reason,
        lambda bench: bench.shell("param", "set", parameter, value),
        lambda bench: bench.shell("param", "set", parameter, normal),
    )


def _fail(unit: str, reason: str, *, lasting: bool = False) -> Provocation:
    """By PX4's own injection of failures."""
    return Provocation(
        f"{unit}_failed",
        reason,
        lambda bench: bench.shell("failure", unit, "off"),
        lambda bench: bench.shell("failure", unit, "ok"),
        {"SYS_FAILURE_EN": "1"},
        lasting,
    )


def _mode(mode: str, reason: str, name: str) -> Provocation:
    return Provocation(
        name,
        reason,
        lambda bench: bench.shell("commander", "mode", mode),
        lambda bench: bench.shell("commander", "mode", "auto:loiter"),
    )


def _switch_too_early(bench: Bench) -> None:
    """In the air, while flockd does not stream: it has no images here."""
    bench.shell("commander", "takeoff")
    bench.wait_for(lambda: bench.height_m() > 1.5, SHOWN_S, "PX4 did not take off")
    bench.shell("commander", "mode", "offboard")


def _land(bench: Bench) -> None:
    bench.shell("commander", "land")
    bench.wait_for(lambda: not bench.armed(), START_S, "PX4 did not land")
    bench.shell("commander", "mode", "auto:loiter")


PROVOCATIONS = (
    _mode("auto:land", "check_modes_cannot_takeoff", "land_mode"),
    _mode("posctl", "check_modes_manual_control", "no_sticks"),
    _mode("offboard", NOT_STREAMING, "no_setpoints"),
    Provocation("too_early", NOT_STREAMING, _switch_too_early, _land),
    Provocation(
        "several_senders", SEVERAL_SENDERS,
        lambda bench: bench.begin_other_computer(), lambda bench: bench.end_other_computer(),
    ),
    _set("NAV_DLL_ACT", "2", "0", "check_rc_dl_no_dllink", "no_ground_station"),
    _set("GF_MAX_HOR_DIST", "0.0001", "0", "check_gf_violation_max_hor_dist", "geofence_distance"),
    _set("COM_ARM_MIS_REQ", "1", "0", "check_modes_mission", "no_mission"),
    _set("COM_ARMABLE", "0", "1", "check_armable_configuration", "not_armable"),
    _set("SYS_HAS_MAG", "3", "1", "check_mag_sys_has_mag_missing", "compass_missing"),
    _set("SYS_HAS_NUM_DIST", "3", "0", "check_distance_sensor_missing", "range_finder_missing"),
    _set("SYS_HAS_NUM_OF", "1", "0", "check_optical_sensor_missing", "optical_flow_missing"),
    _set("COM_CPU_MAX", "1", "95", "check_cpuload_too_high", "processor_busy"),
    _set("COM_PARACHUTE", "2", "0", "check_parachute_missing", "parachute_missing"),
    _set("COM_ARM_ODID", "2", "0", "check_open_drone_id_missing", "remote_id_missing"),
    _set("COM_ARM_TRAFF", "2", "0", "check_traffic_avoidance_missing", "traffic_missing"),
    _fail("gps", "check_modes_local_pos"),
    _fail("battery", "check_battery_critical", lasting=True),  # PX4 then shuts down
    Provocation(
        "no_home", "check_system_no_home_pos",
        parameters={"COM_HOME_EN": "0", "COM_ARM_WO_GPS": "0"}, lasting=True,
    ),
    Provocation(
        "geofence_without_home", "check_gf_no_home",
        parameters={"COM_HOME_EN": "0", "GF_ACTION": "3"}, lasting=True,
    ),
    Provocation("no_satellites", "check_modes_local_pos", parameters={"SIM_GPS_USED": "0"}, lasting=True),
)  # fmt: skip


class Bench(SitlRun):
    """One PX4 and one `flockd run`, and what `flockd status` shows of them."""

    def __init__(self, parameters: Mapping[str, str], *, well: bool) -> None:
        """``well``: waits at the start until nothing is refused."""
        super().__init__()
        self._parameters, self._well = parameters, well
        self._other: threading.Thread | None = None
        self._other_ends = threading.Event()

    def _come_up(self) -> None:
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="px4-reasons-")))
        scenario = with_drones(load_scenario(data_path("config") / "px4_flight.yaml"), 1)
        px4s = Px4s(scenario, 1.0, os.environ, folder, {"GF_ACTION": "2", **self._parameters}, self._instance)
        self._stack.enter_context(px4s).start()
        endpoint = free_endpoint()
        config = _config(px4s.ports[0].offboard, endpoint)
        daemons = Daemons([config], folder=folder, recordings=folder, environment=os.environ)
        self._stack.enter_context(daemons).start()
        self._watcher = self._stack.enter_context(FleetWatcher(FLEET, listen=[], connect=[endpoint]))
        self._stack.callback(self.end_other_computer)
        self.wait_for(lambda: bool(self._flight()), START_S, "the daemon says nothing")
        if self._well:
            self.wait_for(self.ready, START_S, "PX4 did not become ready to be armed")

    def ready(self) -> bool:
        """Nothing is refused."""
        return self._flight().get("height_m") is not None and not self.refused()

    def refused(self) -> dict[str, str]:
        """What `flockd status` shows of the autopilot's refusals: sentences by the reason's name."""
        rows = status_rows(self._watcher.drones(), time.monotonic())
        shown = {sentence for row in rows for sentence in row["matters"]}
        reasons = self._flight().get("reasons", ())
        refused = {str(one["event"]): str(one["sentence"]) for one in reasons if one["event"] in REASONS}
        return {event: sentence for event, sentence in refused.items() if sentence in shown}

    def armed(self) -> bool:
        """Motors on."""
        return bool(self._flight().get("armed"))

    def height_m(self) -> float:
        """Above home."""
        return float(self._flight().get("height_m") or 0.0)

    def begin_other_computer(self) -> None:
        """Starts a thread that sends the heartbeats of an onboard computer."""
        self._other_ends.clear()
        self._other = threading.Thread(target=self._send_heartbeats, daemon=True)
        self._other.start()

    def end_other_computer(self) -> None:
        """Ends it."""
        self._other_ends.set()
        if self._other is not None:
            self._other.join()
            self._other = None

    def _send_heartbeats(self) -> None:
        """To PX4's link for a second computer, from where PX4 forwards them."""
        link = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{OTHER_PORT + self._instance}", source_system=self._instance + 1, source_component=197
        )
        kind, nobody = mavutil.mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavutil.mavlink.MAV_AUTOPILOT_INVALID
        while not self._other_ends.wait(0.5):
            if link.recv_match(blocking=True, timeout=0.5) is not None:
                link.mav.heartbeat_send(kind, nobody, 0, 0, mavutil.mavlink.MAV_STATE_ACTIVE)
        link.close()

    def wait_for(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Until it holds. Raises UnavailableError."""
        begun_s = time.monotonic()
        while not condition():
            if time.monotonic() - begun_s > timeout_s:
                raise UnavailableError(f"{otherwise} within {timeout_s:g} s ({self.refused()})")
            time.sleep(POLL_S)

    def _flight(self) -> Mapping[str, Any]:
        return next((drone.message("flight", time.monotonic()) or {} for drone in self._watcher.drones()), {})

    def trial(self, provocation: Provocation) -> str:
        """Provokes a reason, waits until it is shown and how, and takes it back. Raises UnavailableError."""
        provocation.begin(self)
        shown: dict[str, str] = {}

        def is_shown() -> bool:
            shown.update(self.refused())
            return provocation.reason in shown

        try:
            self.wait_for(is_shown, SHOWN_S, "status does not show it")
        finally:
            provocation.end(self)
        if not provocation.lasting:
            self.wait_for(self.ready, GONE_S, "it was not gone again")
        return shown[provocation.reason]


def _config(port: int, endpoint: str) -> DroneConfig:
    """The SITL's drone, whose frames never come: what flockd itself lacks is not what this is about."""
    return changed(
        load_drone(data_path("config") / "px4_sitl.yaml"),
        autopilot=AutopilotParameters(address=f"udpin://127.0.0.1:{port}"),
        source__shared_memory__connect=(free_endpoint(),),
        telemetry__fleet=FLEET,
        telemetry__listen=(endpoint,),
        telemetry__connect=(),
    )


@PX4
@pytest.mark.slow
@pytest.mark.parametrize("provocation", PROVOCATIONS, ids=lambda provocation: provocation.name)
def test_status_shows_what_px4_refuses_for(provocation: Provocation) -> None:
    with Bench(dict(provocation.parameters), well=not provocation.lasting) as bench:
        shown = bench.trial(provocation)
    print(shown)  # noqa: T201
    assert REASONS[provocation.reason].what in shown
    assert REASONS[provocation.reason].remedy in shown


def test_every_provocation_is_of_a_reason_in_the_table() -> None:
    names = [provocation.name for provocation in PROVOCATIONS]
    assert len(set(names)) == len(names) >= 12
    assert {provocation.reason for provocation in PROVOCATIONS} <= REASONS.keys()
