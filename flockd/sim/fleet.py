"""Flies a scenario with real daemons: autopilots, `flockd run` processes, a film crew that feeds their cameras."""

from __future__ import annotations

import json
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flockd.config import DroneConfig
from flockd.config.scenario import ScenarioConfig
from flockd.errors import UnavailableError
from flockd.flocking import desired_velocity
from flockd.flocking.metrics import order, union
from flockd.messages import FloatArray, PilotOutput
from flockd.pilot import FlockPilot
from flockd.pilot.pilot import load_perception
from flockd.recording.codec import from_json
from flockd.recording.mcap_file import Entry, read_records
from flockd.recording.reader import Recording
from flockd.recording.streams import OUTPUT, VEHICLE
from flockd.report.filmstrip import FilmstripFrame
from flockd.sim.autopilots import Autopilots, Px4s, StandIns
from flockd.sim.daemons import Daemons, fleet_configs
from flockd.sim.film_crew import FilmCrew, Shooting
from flockd.sim.ground_station import GroundStation
from flockd.sim.log import FlightLog
from flockd.sim.log_book import LogBook
from flockd.sim.pictures import picture, pictured_steps
from flockd.sim.processes import Program
from flockd.sim.swarm import Flight
from flockd.sim.truth import fly_truth
from flockd.sources import clock_at

AutopilotKind = Literal["standin", "px4"]
Progress = Callable[[int, int], None]

AUTOPILOT_START_S, DAEMON_START_S = 90.0, 180.0
"""Real seconds; a computer that loads networks for five drones takes its time."""
ARM_S, CLIMB_S, READY_S, OFFBOARD_S, LAND_S = 60.0, 60.0, 60.0, 10.0, 60.0
"""Simulated seconds for each step of bringing a fleet up and down."""
LOOK_S = 0.05
ASK_AGAIN_S = 1.0
ON_GROUND_M, AT_HEIGHT_M = 0.5, 1.0
END_OF_FLIGHT_S = 20.0
"""Over which the order and the union at the end are told."""
_FILMSTRIP_DRONE = 0


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
        log = _log(scenario, configs, flown, films, speed_factor)
        return Flight(log, _filmstrip(films, flown))


@dataclass
class _Flown:
    """What the simulator knows of a flight."""

    began_s: float
    ended_s: float = 0.0
    wall_s: float = 0.0
    shootings: tuple[Shooting, ...] = ()
    cores: dict[str, float] = field(default_factory=dict)
    """How many processor cores each kind of program kept busy."""
    handed_over: dict[str, str] = field(default_factory=dict)
    """Why a drone did not fly to the end, by its name."""
    autopilot: str = ""
    clock_rates: list[float] = field(default_factory=list)
    """Seconds of each autopilot's clock in one of the simulation's."""
    exit_codes: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


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

    def fly(self, progress: Progress) -> _Flown:
        """Watches until the time is over."""
        flown = _Flown(self._clock())
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

    def land(self, flown: _Flown) -> None:
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

    def _notice(self, flown: _Flown, flying_s: float) -> None:
        """A drone that is not in offboard any more, or whose daemon has ended."""
        for i, program in zip(self._all, self._daemons.programs(), strict=True):
            if program.name in flown.handed_over:
                continue
            if program.ended is not None:
                why = f"its daemon ended with exit code {program.ended} ({program.last_words()})"
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


# What came of it


def _log(
    scenario: ScenarioConfig,
    configs: Sequence[DroneConfig],
    flown: _Flown,
    recordings: Path,
    speed_factor: float,
) -> FlightLog:
    """The flight's log: the truth of the film crew, and what the daemons recorded of themselves."""
    shootings, drone = flown.shootings, configs[0]
    begin_s = shootings[0].time_s
    times = np.array([shooting.time_s - begin_s for shooting in shootings])
    book = LogBook(times, len(configs))
    for row, shooting in enumerate(shootings):
        book.truth(row, shooting.poses.position, shooting.poses.velocity, shooting.poses.R_ned_body)
        book.desired(row, desired_velocity(drone.desired, float(times[row])))
    rows = {shooting.time_s: row for row, shooting in enumerate(shootings)}
    looked, longest_s, spanning = [], 0.0, 0
    for i, config in enumerate(configs):
        steps = [(rows[o.time_s], o, R) for o, R in _outputs(recordings, config.name) if o.time_s in rows]
        for before, (row, output, R_ned_body) in zip([None, *steps], steps, strict=False):
            spans_more = False
            if before is not None:
                longest_s = max(longest_s, times[row] - times[before[0]])
                spans_more = row - before[0] != 1 and output.ego_motion is not None
                spanning += spans_more
            # The log compares a motion with the truth of one frame set before: it cannot take one that spans more.
            told = replace(output, ego_motion=None) if spans_more else output
            book.seen(row, i, told, R_ned_body, output.stages_ms)
        looked.append(len(steps))
    late_s = [shooting.took_s for shooting in shootings]
    position = np.array([shooting.poses.position[:, :2] for shooting in shootings])
    velocity = np.array([shooting.poses.velocity[:, :2] for shooting in shootings])
    end = np.flatnonzero(times >= times[-1] - END_OF_FLIGHT_S)
    fleet: dict[str, Any] = {
        "speed_factor": speed_factor,
        "cores": {name: round(cores, 3) for name, cores in flown.cores.items()},
        "frame_sets": len(shootings),
        "frame_sets_looked_at": dict(zip((config.name for config in configs), looked, strict=True)),
        "longest_step_s": float(longest_s),
        "motions_over_more_than_one_frame_set": spanning,
        "frames_late_s": {"p50": float(np.percentile(late_s, 50)), "p95": float(np.percentile(late_s, 95))},
        "autopilot_clock_rates": [round(rate, 4) for rate in flown.clock_rates],
        "order_last_20s": float(np.mean([order(velocity[s]) for s in end])),
        "union_last_20s": float(np.mean([union(position[s], drone.flocking.observation_distance_m) for s in end])),
        "handed_over": flown.handed_over,
        "exit_codes": flown.exit_codes,
        "notes": flown.notes,
    }
    meta = {
        "scenario": scenario.scenario,
        "drones": len(configs),
        "duration_s": scenario.duration_s,
        "step_s": drone.step_s,
        "seed": scenario.seed,
        "circle_until_s": drone.desired.circle_until_s,
        "desired_distance_m": drone.flocking.desired_distance_m,
        "observation_distance_m": drone.flocking.observation_distance_m,
        "separation_distance_m": drone.flocking.separation_distance_m,
        "perception": "learned",
        "flow": drone.perception.flow,
        "scale": drone.perception.scale,
        "wall_s": flown.wall_s,
        "autopilot": flown.autopilot,
        "fleet": fleet,
    }
    return book.log(meta, _companion(scenario, times))


def _companion(scenario: ScenarioConfig, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same flight on exact states, at the times of the frame sets."""
    steps_s, position, velocity = fly_truth(scenario)
    flat = [values.reshape(len(steps_s), -1) for values in (position, velocity)]
    at = [np.stack([np.interp(times, steps_s, column) for column in values.T], axis=1) for values in flat]
    shape = (len(times), *position.shape[1:])
    return at[0].reshape(shape), at[1].reshape(shape)


def _outputs(recordings: Path, drone: str) -> Iterator[tuple[PilotOutput, FloatArray]]:
    """What one drone's pilot found in each step of its flight, and the attitude its autopilot told it."""
    for path in sorted(recordings.glob(f"{drone}-*.mcap")):
        outputs: dict[int, PilotOutput] = {}
        attitudes: dict[int, FloatArray] = {}
        for record in read_records(path):
            if isinstance(record, Entry) and record.stream.topic == OUTPUT.topic:
                outputs[record.sequence] = from_json(PilotOutput, json.loads(record.data))
            elif isinstance(record, Entry) and record.stream.topic == VEHICLE.topic:
                attitudes[record.sequence] = np.reshape(json.loads(record.data)["R_ned_body"], (3, 3))
        yield from ((outputs[step], attitudes[step]) for step in sorted(outputs.keys() & attitudes.keys()))


def _filmstrip(recordings: Path, flown: _Flown) -> tuple[FilmstripFrame, ...]:
    """A few moments of one drone, seen again: a fresh pilot for each, with two frame sets of the recording."""
    drone = f"drone{_FILMSTRIP_DRONE + 1}"
    path = min(recordings.glob(f"{drone}-*.mcap"), default=None)
    if path is None:
        return ()
    recording = Recording(path)
    perception = load_perception(recording.config)
    times = [time_s for _, time_s in recording.contents.steps]
    strip: list[FilmstripFrame] = []
    for index in sorted(pictured_steps(len(times))):
        pilot = FlockPilot(recording.config, perception)
        for step in recording.steps(times[max(index - 1, 0)], times[index]):
            output = pilot.step(step.frames, step.vehicle)
        begin_s = flown.shootings[0].time_s
        strip += [replace(frame, time_s=frame.time_s - begin_s) for frame in picture(pilot, output, _FILMSTRIP_DRONE)]
    return tuple(strip)
