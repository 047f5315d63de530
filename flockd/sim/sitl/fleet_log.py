"""The log of a fleet's flight, from the simulator's truth and the daemons' recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flockd import __version__
from flockd.core.config import DroneConfig
from flockd.core.messages import NO_STATUS, MissionStatus, PilotOutput
from flockd.onboard.message_json import from_json
from flockd.onboard.recording.mcap_file import read_entries
from flockd.onboard.recording.streams import OUTPUT
from flockd.review.flight_log.builder import FlightLogBuilder
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import FleetMetadata, FlightMetadata, MissionMetadata
from flockd.review.metrics import order
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.ground_station import Poses

END_OF_FLIGHT_S = 20.0
"""Over which order at the end is averaged."""


@dataclass
class FleetRun:
    """What the simulator measures while a fleet flies."""

    began_s: float
    began: str = ""
    """Wall time, ISO 8601."""
    interrupted: bool = False
    ended_s: float = 0.0
    wall_s: float = 0.0
    frames: tuple[Poses, ...] = ()
    """The true poses at each frame set; `time_s` is the time stamp of its frames, on the simulated clock."""
    handed_over: dict[str, str] = field(default_factory=dict)
    """Why a drone did not fly to the end, by its name; also where its mission ends so."""
    modes: dict[str, list[str]] = field(default_factory=dict)
    """The flight modes of each autopilot, in order, by its drone's name."""
    autopilot: str = ""
    exit_codes: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def fleet_log(
    scenario: ScenarioConfig,
    configs: Sequence[DroneConfig],
    run: FleetRun,
    recordings: Path,
    speed_factor: float,
) -> FlightLog:
    """The log of a fleet's flight, from the simulator's truth and the daemons' recordings in a folder."""
    frames, drone = run.frames, configs[0]
    begin_s = frames[0].time_s
    times = np.array([frame.time_s - begin_s for frame in frames])
    builder = FlightLogBuilder(times, len(scenario.vehicles))
    for row, frame in enumerate(frames):
        builder.add_truth(row, frame.position, frame.velocity, frame.R_ned_body)
    rows = {frame.time_s: row for row, frame in enumerate(frames)}
    flown = [i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.by_hand]
    statuses: list[dict[int, MissionStatus]] = [{} for _ in frames]
    over: set[str] = set()
    longest_s = 0.0
    for i, config in zip(flown, configs, strict=True):
        files = sorted(recordings.glob(f"{config.name}-*.mcap"))
        entries = (one for file in files for one in read_entries(file) if one.stream.topic == OUTPUT.topic)
        found = (from_json(PilotOutput, json.loads(entry.data)) for entry in entries)
        steps: list[tuple[int, PilotOutput]] = [(rows[one.time_s], one) for one in found if one.time_s in rows]
        for before, (row, output) in zip([None, *steps], steps, strict=False):
            spans_more = False
            if before is not None:
                longest_s = max(longest_s, float(times[row] - times[before[0]]))
                spans_more = row - before[0] != 1 and output.ego_motion is not None
            # The log compares a motion with the truth of one frame set before: it cannot take one that spans more.
            kept = replace(output, ego_motion=None) if spans_more else output
            builder.add_output(row, i, kept, output.stages_ms)
            statuses[row][i] = output.mission
            if output.mission.takeover is not None:
                over.add(config.name)
    _add_missions(builder, scenario, frames, statuses)
    end = [frame for frame, time_s in zip(frames, times, strict=True) if time_s >= times[-1] - END_OF_FLIGHT_S]
    fleet = FleetMetadata(
        speed_factor=speed_factor,
        frame_sets=len(frames),
        longest_step_s=longest_s,
        order_last_20s=float(np.mean([order(frame.velocity[:, :2]) for frame in end])),
        handed_over={name: why for name, why in run.handed_over.items() if name not in over},
        mission_over={name: why for name, why in run.handed_over.items() if name in over},
        modes=run.modes,
        exit_codes=run.exit_codes,
        notes=run.notes,
    )
    metadata = FlightMetadata.of_configuration(
        drone,
        scenario=scenario.scenario,
        drones=len(scenario.vehicles),
        mission=MissionMetadata.of(scenario.missions),
        duration_s=float(times[-1]) + drone.step_s if run.interrupted else scenario.duration_s,
        interrupted=run.interrupted,
        began=run.began or None,
        version=__version__,
        seed=scenario.seed,
        perception="learned",
        wall_s=run.wall_s,
        autopilot=run.autopilot,
        fleet=fleet,
    )
    return builder.build(metadata, None)


def _add_missions(
    builder: FlightLogBuilder,
    scenario: ScenarioConfig,
    frames: Sequence[Poses],
    statuses: Sequence[Mapping[int, MissionStatus]],
) -> None:
    """What each drone wanted at each frame; where its pilot left one out, what it wanted before.

    Of one that is flown by hand nobody knows more than how it flew.
    """
    vehicles = range(len(scenario.vehicles))
    homes = np.array([vehicle.position_m[:2] for vehicle in scenario.vehicles])
    newest: dict[int, MissionStatus] = {}
    for row, (frame, found) in enumerate(zip(frames, statuses, strict=True)):
        newest |= found
        desired = [
            frame.velocity[i, :2] if scenario.vehicles[i].by_hand else newest.get(i, NO_STATUS).desired
            for i in vehicles
        ]
        builder.add_missions(row, np.array(desired), [newest.get(i, NO_STATUS) for i in vehicles], homes)
