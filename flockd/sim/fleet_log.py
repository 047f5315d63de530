"""What came of a fleet's flight: its log, from the truth and the daemons' recordings, and its pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flockd.config import DroneConfig
from flockd.config.scenario import ScenarioConfig
from flockd.flocking import desired_velocity
from flockd.flocking.metrics import order, union
from flockd.messages import FloatArray, PilotOutput
from flockd.perception import load_networks
from flockd.pilot import FlockPilot, StepTrace
from flockd.recording.codec import from_json
from flockd.recording.mcap_file import Entry, read_records
from flockd.recording.reader import Recording
from flockd.recording.streams import OUTPUT, VEHICLE
from flockd.report.filmstrip import FilmstripFrame
from flockd.sim.film_crew import Shooting
from flockd.sim.log import FlightLog
from flockd.sim.log_book import LogBook
from flockd.sim.pictures import picture, pictured_steps
from flockd.sim.truth import fly_truth

END_OF_FLIGHT_S = 20.0
"""Over which the order and the union at the end are told."""
_FILMSTRIP_DRONE = 0


@dataclass
class Flown:
    """What the simulator knows of a fleet's flight."""

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


def flight_log(
    scenario: ScenarioConfig,
    configs: Sequence[DroneConfig],
    flown: Flown,
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


def filmstrip(recordings: Path, flown: Flown) -> tuple[FilmstripFrame, ...]:
    """A few moments of one drone, seen again: a fresh pilot for each, with two frame sets of the recording."""
    drone = f"drone{_FILMSTRIP_DRONE + 1}"
    path = min(recordings.glob(f"{drone}-*.mcap"), default=None)
    if path is None:
        return ()
    recording = Recording(path)
    perception = load_networks(recording.config.perception)
    times = [time_s for _, time_s in recording.contents.steps]
    strip: list[FilmstripFrame] = []
    for index in sorted(pictured_steps(len(times))):
        pilot = FlockPilot(recording.config, perception)
        for step in recording.steps(times[max(index - 1, 0)], times[index]):
            trace = StepTrace()
            output = pilot.step(step.frames, step.vehicle, trace)
        begin_s = flown.shootings[0].time_s
        strip += [replace(frame, time_s=frame.time_s - begin_s) for frame in picture(trace, output, _FILMSTRIP_DRONE)]
    return tuple(strip)
