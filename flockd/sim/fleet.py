"""Flies a scenario with real daemons: autopilots, `flockd run` processes, a film crew that feeds their cameras."""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from flockd.choices import AutopilotKind
from flockd.config import DroneConfig
from flockd.config.scenario import ScenarioConfig
from flockd.errors import UnavailableError
from flockd.sim.autopilots import Autopilots, Px4s, StandIns
from flockd.sim.daemons import Daemons, fleet_configs
from flockd.sim.film_crew import FilmCrew
from flockd.sim.fleet_log import Flown, filmstrip, flight_log
from flockd.sim.ground_station import GroundStation
from flockd.sim.processes import Program
from flockd.sim.swarm import Flight
from flockd.sources import clock_at

Progress = Callable[[int, int], None]

AUTOPILOT_START_S, DAEMON_START_S = 90.0, 180.0
"""Real seconds; a computer that loads networks for five drones takes its time."""
ARM_S, CLIMB_S, READY_S, OFFBOARD_S, LAND_S = 60.0, 60.0, 60.0, 10.0, 60.0
"""Simulated seconds for each step of bringing a fleet up and down."""
LOOK_S = 0.05
ASK_AGAIN_S = 1.0
ON_GROUND_M, AT_HEIGHT_M = 0.5, 1.0


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
        logs: a folder for what all programs write and fly with, over what an earlier fleet's did.
        recordings: a folder for the daemons' recordings; None: they are deleted.
        environment: this process's own.
        progress: told (simulated seconds done, seconds in all).

    Raises UnavailableError when a program does not come up or a drone not into the air, in time.
    """
    scenario = _at_rest(scenario)
    clock = clock_at(speed_factor)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="flockd-")))
        stack.enter_context(_kept(folder, logs))
        films = recordings or folder / "recordings"
        films.mkdir(parents=True, exist_ok=True)
        autopilots = stack.enter_context(_autopilots(scenario, kind, speed_factor, environment, folder))
        ports, endpoint = autopilots.ports, _free_endpoint()
        configs = fleet_configs(scenario, sitl, ports=ports, endpoint=endpoint, speed_factor=speed_factor)
        names = [config.name for config in configs]
        assert configs[0].source is not None
        station = stack.enter_context(GroundStation([port.truth for port in ports], clock))
        crew = stack.enter_context(
            FilmCrew(
                scenario, names, endpoint=endpoint, rate_hz=configs[0].source.shared_memory.rate_hz,
                poses=station.poses, clock=clock, speed_factor=speed_factor,
            )
        )  # fmt: skip
        daemons = stack.enter_context(Daemons(configs, folder=folder, recordings=films, environment=environment))
        fleet = _Fleet(scenario, speed_factor, clock, autopilots, station, crew, daemons)
        fleet.come_up()
        fleet.take_off()
        flown = fleet.fly(progress)
        fleet.land(flown)
        return Flight(flight_log(scenario, configs, flown, films, speed_factor), filmstrip(films, flown))


class _Fleet:
    """Brings a fleet up, lets it fly, and lands it: the hands of five pilots and their stopwatch."""

    def __init__(
        self, scenario: ScenarioConfig, speed_factor: float, clock: Callable[[], float], autopilots: Autopilots,
        station: GroundStation, crew: FilmCrew, daemons: Daemons,
    ) -> None:  # fmt: skip
        self._scenario, self._speed_factor, self._clock = scenario, speed_factor, clock
        self._autopilots, self._station, self._crew, self._daemons = autopilots, station, crew, daemons
        self._all = range(len(scenario.vehicles))
        self._needed: Sequence[Program] = ()
        """What has to run now."""

    def come_up(self) -> None:
        """All programs start, and see and hear each other."""
        self._autopilots.start()
        self._needed = self._autopilots.programs()
        self._wait_for(
            self._station.heard,
            AUTOPILOT_START_S * self._speed_factor,
            lambda i: f"{self._autopilots.name} {i + 1} said nothing for {AUTOPILOT_START_S:g} s",
        )
        self._station.ask_for_news()
        self._crew.start()
        self._daemons.start()
        self._needed = (*self._autopilots.programs(), *self._daemons.programs())
        self._wait_for(
            self._daemons.is_ready,
            DAEMON_START_S * self._speed_factor,
            lambda i: f"the daemon of drone{i + 1} was not ready after {DAEMON_START_S:g} s ({self._said(i)})",
        )

    def take_off(self) -> None:
        """As pilots do: arm, climb to the drone's own height, and give it to flockd when that is ready."""
        station = self._station
        self._ask(station.is_armed, station.arm, ARM_S, "could not be armed")
        self._ask(self._is_up, self._ask_to_climb, CLIMB_S, "did not reach its height")
        self._wait_for(
            lambda i: self._daemons.status(i).startswith("ready") and station.mode_is(i, "LOITER"),
            READY_S,
            lambda i: f"flockd was not ready to fly drone{i + 1} after {READY_S:g} s ({self._said(i)})",
        )
        self._ask(
            lambda i: station.mode_is(i, "OFFBOARD"),
            lambda i: station.select(i, "OFFBOARD"),
            OFFBOARD_S,
            "did not go into offboard",
        )

    def fly(self, progress: Progress) -> Flown:
        """Watches until the time is over."""
        flown = Flown(self._clock())
        wall_s, cpu_s, booted = time.monotonic(), self._cpu_s(), [self._station.uptime_s(i) for i in self._all]
        total_s = self._scenario.duration_s
        while (flying_s := self._clock() - flown.began_s) < total_s:
            progress(int(flying_s), int(total_s))
            self._notice(flown, flying_s)
            self._crew.shootings()
            time.sleep(LOOK_S)
        progress(int(total_s), int(total_s))
        flown.ended_s, flown.wall_s = self._clock(), time.monotonic() - wall_s
        flown.cores = {kind: (after - cpu_s[kind]) / flown.wall_s for kind, after in self._cpu_s().items()}
        flown.clock_rates = [
            rate for i in self._all if (rate := _rate(booted[i], self._station.uptime_s(i))) is not None
        ]
        version = self._station.version(0)
        stand_in = self._autopilots.name == StandIns.name
        flown.autopilot = self._autopilots.name if stand_in or version is None else f"{self._autopilots.name} {version}"
        flown.shootings = tuple(s for s in self._crew.shootings() if flown.began_s <= s.time_s < flown.ended_s)
        return flown

    def land(self, flown: Flown) -> None:
        """The daemons end, which leaves the drones in Hold, and the pilots land them."""
        flown.notes += self._crew.notes()
        self._needed = self._autopilots.programs()
        flown.exit_codes = self._daemons.end()
        try:
            self._ask(
                lambda i: not self._station.is_armed(i), lambda i: self._station.select(i, "LAND"), LAND_S,
                "did not land",
            )  # fmt: skip
        except UnavailableError as error:  # the flight is over, and worth its report
            flown.notes.append(str(error))

    def _notice(self, flown: Flown, flying_s: float) -> None:
        """A drone that is not in offboard any more, or of which a program has ended."""
        autopilots = self._autopilots.programs()
        for i, program in zip(self._all, self._daemons.programs(), strict=True):
            if program.name in flown.handed_over:
                continue
            if program.ended is not None:
                why = f"its daemon ended with exit code {program.ended} ({program.last_words()})"
            elif autopilots and autopilots[i].ended is not None:
                why = f"its autopilot ended with exit code {autopilots[i].ended} ({autopilots[i].last_words()})"
            elif not self._station.mode_is(i, "OFFBOARD"):
                why = f"it left offboard ({self._said(i)})"
            else:
                continue
            flown.handed_over[program.name] = f"after {flying_s:.1f} s {why}"

    def _height_m(self, i: int) -> float:
        return -float(self._station.poses().position[i, 2])

    def _is_up(self, i: int) -> bool:
        error_m = self._height_m(i) + self._scenario.vehicles[i].position_m[2]
        return abs(error_m) < AT_HEIGHT_M and self._station.mode_is(i, "LOITER")

    def _ask_to_climb(self, i: int) -> None:
        """Once it has left the ground, another take-off would lead higher."""
        if self._height_m(i) < ON_GROUND_M:
            self._station.select(i, "TAKEOFF")

    def _said(self, i: int) -> str:
        """What was said last, by whom it concerns."""
        words = [f"flockd: {self._daemons.status(i) or self._daemons.programs()[i].last_words()}"]
        if self._station.last_words(i):
            words.append(f"autopilot: {self._station.last_words(i)}")
        return "; ".join(words)

    def _ask(self, done: Callable[[int], bool], ask: Callable[[int], None], patience_s: float, otherwise: str) -> None:
        """Asks all at a time, and those who have not done it again and again."""
        until_s, asked_s = self._clock() + patience_s, -np.inf
        while (open_ones := [i for i in self._all if not done(i)]) and self._clock() < until_s:
            if self._clock() - asked_s >= ASK_AGAIN_S:
                asked_s = self._clock()
                for i in open_ones:
                    ask(i)
            self._look()
        if open_ones:
            first = open_ones[0]
            raise UnavailableError(f"drone{first + 1} {otherwise} within {patience_s:g} s ({self._said(first)})")

    def _wait_for(self, done: Callable[[int], bool], patience_s: float, otherwise: Callable[[int], str]) -> None:
        until_s = self._clock() + patience_s
        while open_ones := [i for i in self._all if not done(i)]:
            if self._clock() >= until_s:
                raise UnavailableError(f"{otherwise(open_ones[0])}; see its log")
            self._look()

    def _look(self) -> None:
        """Waits a moment. Raises when something has ended that the flight needs."""
        self._crew.shootings()
        for program in self._needed:
            if program.ended is not None:
                raise UnavailableError(f"{program.name} ended with exit code {program.ended} ({program.last_words()})")
        time.sleep(LOOK_S)

    def _cpu_s(self) -> dict[str, float]:
        def used(programs: Sequence[Program]) -> float:
            return sum(program.cpu_s() for program in programs)

        own = os.times()
        return {
            "daemons": used(self._daemons.programs()),
            "autopilots": used(self._autopilots.programs()),
            "simulator": own.user + own.system,
        }


def _at_rest(scenario: ScenarioConfig) -> ScenarioConfig:
    """Autopilots begin in Hold."""
    vehicles = tuple(vehicle.model_copy(update={"velocity_m_s": (0.0, 0.0)}) for vehicle in scenario.vehicles)
    return scenario.model_copy(update={"vehicles": vehicles})


def _autopilots(
    scenario: ScenarioConfig, kind: AutopilotKind, speed_factor: float, environment: Mapping[str, str], folder: Path
) -> Autopilots:
    if kind == "px4":
        return Px4s(scenario, speed_factor, environment, folder)
    return StandIns(scenario, speed_factor)


@contextmanager
def _kept(folder: Path, logs: Path) -> Iterator[None]:
    """What the programs wrote and flew with is there afterwards, whatever happens."""
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


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _rate(before: tuple[float, float] | None, after: tuple[float, float] | None) -> float | None:
    if before is None or after is None or after[1] <= before[1]:
        return None
    return (after[0] - before[0]) / (after[1] - before[1])
