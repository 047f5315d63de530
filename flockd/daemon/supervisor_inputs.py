"""Collects the supervisor's inputs from all components."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from flockd.autopilot.autopilot_status import AutopilotStatus
from flockd.config import DroneConfig
from flockd.daemon.host_monitors import LoopLag, Thermometer
from flockd.daemon.operator_commands import OperatorRequests
from flockd.daemon.pilot_loop import PilotLoop
from flockd.daemon.watched_networks import WatchedNetworks
from flockd.messages import FloatArray, VehicleState
from flockd.safety import CameraHealth, Gate, Inputs, MissionEnd, Objection, outside_fence, outside_heights
from flockd.sources import CameraStatus, Count, FrameSource

DROPS_WINDOW_S = 5.0
_BAD: tuple[Count, ...] = ("time_stamp", "flagged", "corrupt", "malformed")
_REFUSED = (Objection.COMMAND_NOT_FINITE, Objection.COMMAND_TOO_LARGE)


class InputCollector:
    """Collects the inputs at each tick of the control loop."""

    def __init__(
        self,
        config: DroneConfig,
        source: FrameSource,
        pilot_loop: PilotLoop,
        networks: WatchedNetworks,
        gate: Gate,
        lag: LoopLag,
        thermometer: Thermometer,
        dead_tasks: Mapping[str, str],
        clock: Callable[[], float],
    ) -> None:
        """``dead_tasks``: why each task that has ended did, by name; grows elsewhere."""
        self._config, self._source, self._pilot_loop, self._networks = config, source, pilot_loop, networks
        self._gate, self._lag, self._thermometer, self._dead_tasks = gate, lag, thermometer, dead_tasks
        self._clock = clock
        self._camera_monitor = CameraMonitor(config)
        self._faults_before = 0
        self._refused_before = 0
        self._had_satellites = False

    def collect(
        self,
        status: AutopilotStatus,
        vehicle: VehicleState | None,
        operator: OperatorRequests,
        mission_over: MissionEnd | None,
    ) -> Inputs:
        """All inputs as of now; requests that count once are reset in ``operator``."""
        now = self._clock()
        pilot_loop, result = self._pilot_loop, self._pilot_loop.newest
        neighbours = result.output.neighbours if result else ()
        ranges = [float(np.linalg.norm(n.position)) for n in neighbours if n.confirmed]
        summary = self._camera_monitor.update(now, self._source.status())
        position = position_from_home(status)
        self._had_satellites = self._had_satellites or status.gps_ok is True
        inputs = Inputs(
            cameras=summary.cameras,
            dropped_share=summary.dropped_share,
            estimate_age_s=math.inf if result is None else now - result.time_s,
            ego_motion_failures=pilot_loop.ego_motion_failures,
            network_faults=self._networks.faults - self._faults_before,
            inference_stuck=self._networks.stuck,
            load=pilot_loop.load(),
            temperature_c=self._thermometer.hottest_c,
            loop_lag_s=self._lag.worst_s(),
            dead_tasks=tuple(self._dead_tasks),
            neighbours_age_s=now - pilot_loop.neighbour_seen_s,
            nearest_neighbour_m=min(ranges, default=math.inf),
            refused_commands=self._refused() - self._refused_before,
            outside_fence=outside_fence(self._config.safety.gate, position),
            outside_heights=vehicle is None or outside_heights(self._config.safety.gate, vehicle.height_m),
            heartbeat_age_s=status.heartbeat_age_s,
            flight_mode=None if status.flight_mode == "unknown" else status.flight_mode,
            armed=None if math.isinf(status.heartbeat_age_s) else status.armed,
            in_air=None if status.landed_state == "unknown" else status.in_air,
            offboard_refused=operator.offboard_refused,
            battery_low=self._battery_low(status),
            position_lost=status.estimate_ok is False or (self._had_satellites and status.gps_ok is False),
            shutdown_asked=operator.shutdown,
            hold_asked=operator.hold,
            land_asked=operator.land,
            resume_asked=operator.resume,
            mission_over=mission_over,
        )
        self._faults_before += inputs.network_faults
        self._refused_before += inputs.refused_commands
        operator.resume = operator.offboard_refused = False
        return inputs

    def _refused(self) -> int:
        return sum(self._gate.counts[objection] for objection in _REFUSED)

    def _battery_low(self, status: AutopilotStatus) -> bool:
        assert self._config.autopilot is not None
        return status.battery_share is not None and status.battery_share <= self._config.autopilot.low_battery_share


def position_from_home(status: AutopilotStatus) -> FloatArray:
    """(2,) metres north and east; NaN while the autopilot has not sent its position or home."""
    if status.position_ned is None or status.home_ned is None:
        return np.full(2, np.nan)
    from_home: FloatArray = (status.position_ned - status.home_ned)[:2]
    return from_home


@dataclass(frozen=True)
class CameraSummary:
    """The supervisor's inputs from the cameras."""

    cameras: Mapping[str, CameraHealth]
    dropped_share: float


class CameraMonitor:
    """The health of each camera, and the share of frames dropped in the last seconds."""

    def __init__(self, config: DroneConfig) -> None:
        source = config.source
        assert source is not None
        common_hz = source.shared_memory.rate_hz
        rates = {camera.name: camera.rate_hz for camera in source.cameras}
        self._periods_s = {camera.name: 1.0 / rates.get(camera.name, common_hz) for camera in config.rig.cameras}
        self._frozen_before = dict.fromkeys(self._periods_s, 0)
        self._window: deque[tuple[float, int, int]] = deque()

    def update(self, now: float, status: Mapping[str, CameraStatus]) -> CameraSummary:
        """As of now; to be called at each tick."""
        cameras = {name: self._health(name, camera) for name, camera in status.items()}
        received = sum(camera.counts.get("received", 0) for camera in status.values())
        bad = sum(camera.counts.get(what, 0) for camera in status.values() for what in _BAD)
        while self._window and now - self._window[0][0] > DROPS_WINDOW_S:
            self._window.popleft()
        self._window.append((now, received, bad))
        _, received_before, bad_before = self._window[0]
        return CameraSummary(cameras, (bad - bad_before) / max(received - received_before, 1))

    def _health(self, name: str, camera: CameraStatus) -> CameraHealth:
        """A fault with frozen images counted since the last good state means that the camera is frozen."""
        frozen = camera.counts.get("frozen", 0)
        if camera.fault is None:
            self._frozen_before[name] = frozen
        is_frozen = camera.fault is not None and frozen > self._frozen_before[name]
        unplugged = camera.fault is not None and not is_frozen
        return CameraHealth(camera.age_s, self._periods_s[name], unplugged=unplugged, frozen=is_frozen)
