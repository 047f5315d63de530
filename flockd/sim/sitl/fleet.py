"""Flies a scenario with real daemons: autopilots, `flockd run` processes, and a server of their camera frames."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flockd.core.choices import AutopilotKind
from flockd.core.config import DroneConfig
from flockd.core.errors import UnavailableError
from flockd.onboard.simulated_time import clock_at
from flockd.sim.autopilot.fake_telemetry import Mode
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.flock.exact_states import at_home, navigator_of
from flockd.sim.flock.swarm import Flight
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.autopilots import Autopilots, Px4s, SimulatedAutopilots
from flockd.sim.sitl.daemons import Daemons, fleet_configs
from flockd.sim.sitl.fleet_log import FleetRun, fleet_log
from flockd.sim.sitl.frame_server import FrameServer
from flockd.sim.sitl.ground_station import GroundStation, Poses
from flockd.sim.sitl.processes import Program, free_endpoint
from flockd.sim.world.obstacle_worlds import with_obstacles

Progress = Callable[[int, int], None]

AUTOPILOT_START_S, DAEMON_START_S = 90.0, 180.0
"""Real seconds; a computer that loads networks for five drones is slow."""
ARM_S, CLIMB_S, READY_S, OFFBOARD_S, LAND_S = 60.0, 60.0, 60.0, 10.0, 60.0
"""Simulated seconds for each step of bringing a fleet up and down."""
POLL_S = 0.05
REQUEST_AGAIN_S = 1.0
ON_GROUND_M, AT_HEIGHT_M = 0.5, 1.0
LEVEL_M_S, LEVEL_S = 0.1, 1.0
"""PX4 says that it has climbed while it still climbs: a drone is at its height when it rises no more for so long."""
REASON_S = 0.5
"""Real seconds after a drone has left offboard, within which its daemon and its autopilot say why."""
LEAST_FRAME_SETS = 2
"""With fewer an interrupted flight has nothing to report."""


def fly_fleet(
    scenario: ScenarioConfig,
    sitl: DroneConfig,
    *,
    kind: AutopilotKind,
    speed_factor: float,
    logs: Path,
    recordings: Path | None,
    environment: Mapping[str, str],
    progress: Progress = lambda done, total: None,
) -> Flight:
    """Flies a scenario from when all drones are in offboard; every program that it starts has ended when it returns.

    Args:
        scenario: what to fly; its drones begin at a standstill.
        sitl: the configuration whose source, autopilot, safety and telemetry the daemons have.
        kind: of the autopilots.
        speed_factor: how fast simulated time passes.
        logs: a folder for the logs and configurations of all programs; those of an earlier fleet are overwritten.
        recordings: a folder for the daemons' recordings; None: they are deleted.
        environment: this process's own.
        progress: called with (simulated seconds done, seconds in all).

    Raises UnavailableError when a program does not come up or a drone not into the air, in time.
    """
    scenario = _at_standstill(scenario)
    clock = clock_at(speed_factor)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="flockd-")))
        stack.enter_context(_kept(folder, logs))
        recorded = recordings or folder / "recordings"
        recorded.mkdir(parents=True, exist_ok=True)
        cameras = CameraSimulator(scenario)  # takes seconds
        autopilots: Autopilots = (
            Px4s(scenario, speed_factor, environment, folder)
            if kind == "px4"
            else SimulatedAutopilots(scenario, speed_factor, cameras.ground_height)
        )
        stack.enter_context(autopilots)
        ports, endpoint = autopilots.ports, free_endpoint()
        configs = fleet_configs(scenario, sitl, ports=ports, endpoint=endpoint, speed_factor=speed_factor)
        names = [None if vehicle.by_hand else f"drone{i + 1}" for i, vehicle in enumerate(scenario.vehicles)]
        assert configs[0].source is not None
        station = stack.enter_context(GroundStation([port.truth for port in ports], clock))
        server = stack.enter_context(
            FrameServer(
                cameras, names, endpoint=endpoint, rate_hz=configs[0].source.shared_memory.rate_hz,
                poses=station.poses, clock=clock, speed_factor=speed_factor,
            )
        )  # fmt: skip
        daemons = stack.enter_context(Daemons(configs, folder=folder, recordings=recorded, environment=environment))
        fleet = _Fleet(scenario, speed_factor, clock, autopilots, station, server, daemons)
        fleet.come_up()
        fleet.take_off()
        run = fleet.fly(progress)
        fleet.land(run)
        log = fleet_log(scenario, configs, run, recorded, speed_factor)
        return Flight(with_obstacles(log, scenario), ())


@dataclass
class _Fleet:
    """Starts a fleet, flies and lands it, as its ground pilots would."""

    _scenario: ScenarioConfig
    _speed_factor: float
    _clock: Callable[[], float]
    _autopilots: Autopilots
    _station: GroundStation
    _server: FrameServer
    _daemons: Daemons

    def __post_init__(self) -> None:
        vehicles = self._scenario.vehicles
        self._all = range(len(vehicles))
        self._hands = {i: navigator_of(self._scenario, i) for i in self._all if vehicles[i].by_hand}
        self.drones = [i for i in self._all if i not in self._hands]
        """Those with a daemon, in the order of the daemons."""
        self._needed: Sequence[Program] = ()
        """Programs that have to run now; `_poll` raises when one has ended."""
        self._left_s: dict[int, float] = {}
        """When a drone was first seen out of offboard, in seconds of the flight."""
        self._climbed_s = dict.fromkeys(self._all, -np.inf)
        """When a drone rose or sank last."""

    def come_up(self) -> None:
        """Starts all programs and waits until they are connected."""
        self._autopilots.start()
        self._needed = self._autopilots.programs()
        start_s = AUTOPILOT_START_S * self._speed_factor
        self._until(self._station.is_connected, start_s, f"heard nothing of its {self._autopilots.name}")
        self._station.request_messages()
        self._server.start()
        self._daemons.start()
        self._needed = (*self._autopilots.programs(), *self._daemons.programs())
        self._until(
            lambda i: self._daemons.is_ready(self.drones.index(i)), DAEMON_START_S * self._speed_factor,
            "had no daemon that was ready", of=self.drones,
        )  # fmt: skip

    def take_off(self) -> None:
        """Arms, climbs to the drone's own height, and selects offboard when flockd is ready."""
        station = self._station
        late = "could not be armed or did not reach its height"
        self._until(self._is_up, ARM_S + CLIMB_S, late, request=self._request_climb)
        self._until(
            lambda i: self._status(i).startswith("ready") and station.mode_is(i, "LOITER"), READY_S,
            "had no flockd that was ready to fly it", of=self.drones,
        )  # fmt: skip
        modes: dict[int, Mode] = {i: "POSCTL" if i in self._hands else "OFFBOARD" for i in self._all}
        self._until(
            lambda i: station.mode_is(i, modes[i]), OFFBOARD_S,
            "did not go into offboard, or one that is flown by hand into Position mode",
            request=lambda i: station.select(i, modes[i]),
        )  # fmt: skip

    def fly(self, progress: Progress) -> FleetRun:
        """Monitors the flight until its time is over, or until KeyboardInterrupt once there is something to report."""
        run = FleetRun(self._clock(), began=datetime.now(UTC).isoformat(timespec="seconds"))
        wall_s, total_s = time.monotonic(), self._scenario.duration_s
        try:
            while (flying_s := self._clock() - run.began_s) < total_s:
                progress(int(flying_s), int(total_s))
                self._note_handovers(run, flying_s)
                self._note_modes(run)
                self._fly_by_hand(flying_s)
                self._server.frames()
                time.sleep(POLL_S)
            progress(int(total_s), int(total_s))
        except KeyboardInterrupt:
            if len(self._frames_of(run, self._clock())) < LEAST_FRAME_SETS:
                raise
            run.interrupted = True
        self._note_handovers(run, np.inf)
        run.ended_s, run.wall_s = self._clock(), time.monotonic() - wall_s
        version = self._station.version(0)
        is_fake = self._autopilots.name == SimulatedAutopilots.name
        run.autopilot = self._autopilots.name if is_fake or version is None else f"{self._autopilots.name} {version}"
        run.frames = self._frames_of(run, run.ended_s)
        return run

    def _frames_of(self, run: FleetRun, until_s: float) -> tuple[Poses, ...]:
        return tuple(s for s in self._server.frames() if run.began_s <= s.time_s < until_s)

    def land(self, run: FleetRun) -> None:
        """Ends the daemons, which leaves the drones in Hold, and lands all whose autopilot still runs."""
        run.exit_codes = self._daemons.end()
        ended = [program.name for program in self._autopilots.programs() if program.ended is not None]
        run.notes += [f"{name} had ended, so that its drone was not landed" for name in ended]
        self._needed = ()
        try:
            self._until(
                lambda i: self._autopilot_ended(i) or not self._station.is_armed(i), LAND_S, "did not land",
                request=lambda i: self._station.select(i, "LAND"),
            )  # fmt: skip
        except UnavailableError as error:  # the flight is over, and worth its report
            run.notes.append(str(error))

    def _status(self, i: int) -> str:
        """What a drone's daemon said of itself last."""
        return self._daemons.status(self.drones.index(i))

    def _fly_by_hand(self, flying_s: float | None) -> None:
        """Moves the sticks of who is flown by hand: along their missions, or, before the flight, not at all."""
        for i, hand in self._hands.items():
            velocity = np.zeros(2)
            if flying_s is not None:
                velocity = hand.step(at_home(flying_s, self._station.poses().position[i, :2])).velocity
            self._station.steer(i, velocity)

    def _autopilot_ended(self, i: int) -> bool:
        autopilots = self._autopilots.programs()
        return bool(autopilots) and autopilots[i].ended is not None

    def _note_handovers(self, run: FleetRun, flying_s: float) -> None:
        """Notes each drone that is not in offboard any more, or of which a program has ended.

        The reason is read when its daemon and its autopilot have had time to tell it.
        """
        for i, program in zip(self.drones, self._daemons.programs(), strict=True):
            if program.name in run.handed_over:
                continue
            if program.ended is None and not self._autopilot_ended(i) and self._station.mode_is(i, "OFFBOARD"):
                if i not in self._left_s:
                    continue
            elif i not in self._left_s:
                self._left_s[i] = min(flying_s, self._clock() - run.began_s)
            if flying_s - self._left_s[i] >= REASON_S * self._speed_factor:
                run.handed_over[program.name] = f"after {self._left_s[i]:.1f} s {self._why(i, program)}"

    def _note_modes(self, run: FleetRun) -> None:
        for i in self._all:
            mode, flown = self._station.mode(i), run.modes.setdefault(f"drone{i + 1}", [])
            if [mode] != flown[-1:]:
                flown.append(mode)

    def _why(self, i: int, program: Program) -> str:
        if program.ended is not None:
            return f"its daemon ended with exit code {program.ended} ({program.last_output()})"
        if self._autopilot_ended(i):
            autopilot = self._autopilots.programs()[i]
            return f"its autopilot ended with exit code {autopilot.ended} ({autopilot.last_output()})"
        return f"it left offboard ({self._last_messages(i)})"

    def _height_m(self, i: int) -> float:
        return -float(self._station.poses().position[i, 2])

    def _is_up(self, i: int) -> bool:
        now = self._clock()
        if abs(float(self._station.poses().velocity[i, 2])) > LEVEL_M_S:
            self._climbed_s[i] = now
        error_m = self._height_m(i) + self._scenario.vehicles[i].position_m[2]
        level = now - self._climbed_s[i] >= LEVEL_S
        return level and abs(error_m) < AT_HEIGHT_M and self._station.mode_is(i, "LOITER")

    def _request_climb(self, i: int) -> None:
        """Once it has left the ground, another take-off would lead higher."""
        if not self._station.is_armed(i):
            self._station.arm(i)
        elif self._height_m(i) < ON_GROUND_M:
            self._station.select(i, "TAKEOFF")

    def _last_messages(self, i: int) -> str:
        """The last messages of a drone's daemon and autopilot."""
        messages = []
        if i in self.drones:
            output = self._daemons.programs()[self.drones.index(i)].last_output
            messages.append(f"flockd: {self._status(i) or output()}")
        if self._station.last_text(i):
            messages.append(f"autopilot: {self._station.last_text(i)}")
        return "; ".join(messages)

    def _until(
        self, done: Callable[[int], bool], timeout_s: float, otherwise: str, *,
        request: Callable[[int], None] | None = None, of: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        """Waits for all drones, with requests to those that are not done; raises after the timeout."""
        until_s, asked_s = self._clock() + timeout_s, -np.inf
        while pending := [i for i in (self._all if of is None else of) if not done(i)]:
            now_s, first = self._clock(), pending[0]
            if now_s >= until_s:
                why = self._last_messages(first) or "see its log"
                raise UnavailableError(f"drone{first + 1} {otherwise} within {timeout_s:g} s ({why})")
            if request is not None and now_s - asked_s >= REQUEST_AGAIN_S:
                asked_s = now_s
                for i in pending:
                    request(i)
            self._poll()

    def _poll(self) -> None:
        """Waits for `POLL_S`. Raises UnavailableError when a program that the flight needs has ended."""
        self._server.frames()
        self._fly_by_hand(None)
        for program in self._needed:
            if program.ended is not None:
                raise UnavailableError(f"{program.name} ended with exit code {program.ended} ({program.last_output()})")
        time.sleep(POLL_S)


def _at_standstill(scenario: ScenarioConfig) -> ScenarioConfig:
    """With all drones hovering at the start, as autopilots begin in Hold."""
    vehicles = tuple(vehicle.model_copy(update={"velocity_m_s": (0.0, 0.0)}) for vehicle in scenario.vehicles)
    return scenario.model_copy(update={"vehicles": vehicles})


@contextmanager
def _kept(folder: Path, logs: Path) -> Iterator[None]:
    """Copies the programs' logs and configurations to ``logs`` at the end, also after an error."""
    try:
        yield
    finally:
        written = _logs_in(folder)
        if written:
            logs.mkdir(parents=True, exist_ok=True)
        for earlier in _logs_in(logs):
            earlier.unlink()
        for path in written:
            shutil.copy(path, logs)


def _logs_in(folder: Path) -> list[Path]:
    return [*folder.glob("*.log"), *folder.glob("drone*.yaml")]
