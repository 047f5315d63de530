"""Collects the supervisor's inputs from cameras, pilot, autopilot, operators, and the computer's own monitors."""

from __future__ import annotations

import asyncio
import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.messages import FloatArray, VehicleState
from flockd.flight.safety import CameraHealth, Gate, Inputs, Objection, outside_fence, outside_heights
from flockd.onboard.autopilot.autopilot_status import AutopilotStatus
from flockd.onboard.daemon.operator_orders import OperatorRequests
from flockd.onboard.daemon.pilot_loop import PilotLoop
from flockd.onboard.daemon.watched_networks import WatchedNetworks
from flockd.onboard.sources import CameraStatus, Count, FrameSource
from flockd.onboard.worker import BusyError, LateError, Worker

DROPS_WINDOW_S = 5.0
_Tally = tuple[int, int, int, int]
"""Counts of frames: received, refused on arrival, decoded, useless after decoding or noise."""
_BAD: tuple[Count, ...] = ("time_stamp", "flagged", "corrupt", "malformed")
_REFUSED = (Objection.COMMAND_NOT_FINITE, Objection.COMMAND_TOO_LARGE, Objection.HEADING_NOT_FINITE)


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
        """``dead_tasks``: why each dead task ended, by name; updated elsewhere."""
        self._config, self._source, self._pilot_loop, self._networks = config, source, pilot_loop, networks
        self._gate, self._lag, self._thermometer, self._dead_tasks = gate, lag, thermometer, dead_tasks
        assert config.autopilot is not None
        self._clock, self._low_battery_share = clock, config.autopilot.low_battery_share
        self._camera_monitor = CameraMonitor(config)
        self._faults_before = 0
        self._refused_before = 0
        self._had_satellites = False
        self._was_armed = False

    def collect(
        self,
        status: AutopilotStatus,
        vehicle: VehicleState | None,
        operator: OperatorRequests,
        takeover: str | None,
        stream_fault: str | None,
        obstacle_m: float,
    ) -> Inputs:
        """All inputs as of now; requests that count once, or for a finished flight, are reset in ``operator``.

        ``obstacle_m``: the range of the nearest obstacle.
        """
        now = self._clock()
        pilot_loop, result = self._pilot_loop, self._pilot_loop.newest
        neighbours = result.output.neighbours if result else ()
        ranges = [float(np.linalg.norm(n.position)) for n in neighbours if n.confirmed]
        noisy = result.output.noisy_cameras if result else ()
        noisy_images = pilot_loop.noisy_images.total()
        cameras, dropped_share = self._camera_monitor.update(now, self._source.status(), noisy, noisy_images)
        position = position_from_home(status)
        self._had_satellites = self._had_satellites or status.gps_ok is True
        if self._was_armed and not status.armed:
            operator.hold = operator.land = False  # they were for the finished flight
        self._was_armed = status.armed
        inputs = Inputs(
            cameras=cameras,
            dropped_share=dropped_share,
            estimate_age_s=math.inf if result is None else now - result.time_s,
            ego_motion_age_s=pilot_loop.ego_motion_age_s,
            network_faults=self._networks.faults - self._faults_before,
            inference_stuck=self._networks.stuck,
            load=pilot_loop.load(),
            temperature_c=self._thermometer.hottest_c,
            loop_lag_s=self._lag.worst_s(),
            velocity_late_s=self._gate.response.late_s,
            velocity_error_m_s=self._gate.response.error_m_s,
            dead_tasks=tuple(self._dead_tasks),
            neighbours_age_s=now - pilot_loop.neighbour_seen_s,
            nearest_neighbour_m=min(ranges, default=math.inf),
            refused_commands=sum(self._gate.counts[objection] for objection in _REFUSED) - self._refused_before,
            obstacle_near=obstacle_m < self._config.safety.hold_room_m,
            outside_fence=outside_fence(self._config.safety.gate, position),
            outside_heights=vehicle is None or outside_heights(self._config.safety.gate, vehicle.height_m),
            motion_age_s=math.inf if vehicle is None else now - vehicle.time_s,
            heartbeat_age_s=status.heartbeat_age_s,
            message_age_s=status.message_age_s,
            stream_fault=stream_fault,
            autopilot_failsafe=status.armed and status.failsafe,
            foreign_setpoints=status.foreign_setpoints,
            parameter_fault=status.parameter_fault,
            frame_jumped=status.frame_jumped,
            flight_mode=None if status.flight_mode == "unknown" else status.flight_mode,
            armed=None if math.isinf(status.heartbeat_age_s) else status.armed,
            in_air=None if status.landed_state == "unknown" else status.in_air,
            battery_low=status.battery_share is not None and status.battery_share <= self._low_battery_share,
            position_lost=status.estimate_ok is False or (self._had_satellites and status.gps_ok is False),
            shutdown_asked=operator.shutdown,
            hold_asked=operator.hold,
            land_asked=operator.land,
            resume_asked=operator.resume,
            takeover=takeover,
        )
        self._faults_before += inputs.network_faults
        self._refused_before += inputs.refused_commands
        operator.resume = False
        return inputs


def position_from_home(status: AutopilotStatus) -> FloatArray:
    """(2,) metres north and east; NaN until the autopilot has sent its position and home."""
    if status.position_ned is None or status.home_ned is None:
        return np.full(2, np.nan)
    from_home: FloatArray = (status.position_ned - status.home_ned)[:2]
    return from_home


class CameraMonitor:
    """The health of each camera, and the share of frames dropped in the last seconds."""

    def __init__(self, config: DroneConfig) -> None:
        source = config.source
        assert source is not None
        common_hz = source.shared_memory.rate_hz
        rates = {camera.name: camera.rate_hz for camera in source.cameras}
        self._periods_s = {camera.name: 1.0 / rates.get(camera.name, common_hz) for camera in config.rig.cameras}
        self._timeout_periods = config.safety.camera_timeout_periods
        self._frozen_before = dict.fromkeys(self._periods_s, 0)
        self._clean_s: dict[str, float] = {}
        """Time of each camera's last image without noise."""
        self._window: deque[tuple[float, _Tally]] = deque()

    def update(
        self, now: float, status: Mapping[str, CameraStatus], noisy: Collection[str] = (), noisy_images: int = 0
    ) -> tuple[dict[str, CameraHealth], float]:
        """The cameras' health, and the share of frames dropped, as of now; call it at each tick.

        ``noisy``: cameras whose newest images are noise by the pilot; ``noisy_images``: number of such images since the
        start, of all cameras.
        """
        for name in status.keys() - set(noisy):
            self._clean_s[name] = now
        cameras = {name: self._health(name, camera, now) for name, camera in status.items()}
        while self._window and now - self._window[0][0] > DROPS_WINDOW_S:
            self._window.popleft()
        tally = _tally(status, noisy_images)
        self._window.append((now, tally))
        return cameras, _dropped_share(self._window[0][1], tally)

    def _health(self, name: str, camera: CameraStatus, now: float) -> CameraHealth:
        """A fault with frozen images counted since the last good state means that the camera is frozen."""
        frozen = camera.counts.get("frozen", 0)
        if camera.fault is None:
            self._frozen_before[name] = frozen
        period_s, fault = self._periods_s[name], None
        if now - self._clean_s.setdefault(name, now) > self._timeout_periods * period_s:
            fault = "noisy"
        if camera.fault is not None:
            fault = "frozen" if frozen > self._frozen_before[name] else "unplugged"
        return CameraHealth(camera.age_s, period_s, fault)


def _tally(status: Mapping[str, CameraStatus], noisy_images: int) -> _Tally:
    """Counts of all cameras since the start. Few frames are decoded, so these are counted separately."""
    counts = Counter[Count]()
    for camera in status.values():
        counts.update(camera.counts)
    undecodable = counts["undecodable"]
    refused = sum(counts[what] for what in _BAD) - undecodable
    return counts["received"], refused, counts["used"] + undecodable, undecodable + noisy_images


def _dropped_share(before: _Tally, now: _Tally) -> float:
    """The share of refused frames or that of useless ones, whichever is larger."""
    received, refused, decoded, useless = (b - a for a, b in zip(before, now, strict=True))
    return max(refused / max(received, 1), useless / max(decoded, 1))


SAMPLE_S = 0.05
MEMORY_S = 1.0
THERMAL_ZONES = Path("/sys/class/thermal")
READ_EVERY_S = 1.0
"""Time between two readings of the temperature, and time-out of one."""


class LoopLag:
    """Measures how late the event loop wakes a sleeping task."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._measured: deque[tuple[float, float]] = deque()
        self._due_s = math.inf

    async def run(self) -> None:
        """Measures until cancelled."""
        while True:
            self._due_s = self._clock() + SAMPLE_S
            await asyncio.sleep(SAMPLE_S)
            now = self._clock()
            self._measured.append((now, max(0.0, now - self._due_s)))

    def worst_s(self) -> float:
        """Largest lag in the last second, and now."""
        now = self._clock()
        while self._measured and now - self._measured[0][0] > MEMORY_S:
            self._measured.popleft()
        return max([0.0, now - self._due_s, *(lag for _, lag in self._measured)])


class Thermometer:
    """Reads the hottest thermal zone once a second, on a worker: some drivers are slow."""

    def __init__(self) -> None:
        self.hottest_c: float | None = None
        """None if the computer has no thermal zone, and while the reading hangs."""

    async def run(self) -> None:
        """Reads until cancelled."""
        worker = Worker("thermometer")
        try:
            while True:
                try:
                    zones = await worker.do(READ_EVERY_S, thermal_zones)
                    self.hottest_c = max((celsius for _, celsius in zones), default=None)
                except (LateError, BusyError):  # a driver may hang for ever, so no further thread waits for it
                    self.hottest_c = None
                await asyncio.sleep(READ_EVERY_S)
        finally:
            worker.leave()


def thermal_zones(folder: Path = THERMAL_ZONES) -> list[tuple[str, float]]:
    """Name and temperature in degrees Celsius of all readable zones; a disabled one is not readable."""
    found = []
    for zone in sorted(folder.glob("thermal_zone*")):
        with suppress(OSError, ValueError):
            found.append(((zone / "type").read_text("ascii").strip(), int((zone / "temp").read_text("ascii")) / 1000))
    return found
