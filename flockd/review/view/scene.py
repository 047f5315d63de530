"""Each step of a recording for viewers, as plain values in north, east and down."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import EgoMotion, Float32Array, FloatArray, PilotOutput, UInt8Array
from flockd.flight.geometry import PointPairs, Rig, build_rig, z_map
from flockd.flight.perception import Observation
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.flight.pilot.motions import background_pairs, neighbour_pairs
from flockd.onboard.recording.codec import Json, from_json, to_json
from flockd.onboard.recording.mcap_file import Entry
from flockd.onboard.recording.own_path import OwnPath
from flockd.onboard.recording.reader import RecordedStep, Recording
from flockd.onboard.recording.record_source import records_of
from flockd.onboard.recording.streams import TABLE

_MAX_PAIRS = 800
"""More lines of one kind in one step hide each other."""


@dataclass(frozen=True, eq=False)
class Place:
    """The drone's pose on its own path, by dead reckoning."""

    position: FloatArray
    """(3,) m NED from where the path began."""
    R_ned_body: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """(n, 3) body points in NED."""
        return np.asarray(points @ self.R_ned_body.T + self.position)


@dataclass(frozen=True, eq=False)
class Maps:
    """What the pilot made of one step's images: computed again, as recordings hold none of it."""

    labels: Mapping[str, UInt8Array]
    """By camera; 0 background, k the drone with label k, 255 not to be used."""
    depth: Mapping[str, Float32Array]
    """By camera, m along the optical axis."""
    pairs: Mapping[str, FloatArray]
    """(n, 2, 3) m NED, by kind: both ends of each point pair as the own motion places them. `still`: background that
    it brings together within Algorithm 1's threshold, `rejected`: that it does not, `drone K`: of the neighbour
    with label K."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One step."""

    number: int
    time_s: float
    images: Mapping[str, UInt8Array]
    place: Place
    height_m: float
    output: PilotOutput | None
    """As recorded; None where the recording ends before it."""
    true_neighbours: Mapping[str, FloatArray]
    """(3,) m NED on the same path, by name; of simulated flights."""
    maps: Maps | None


class Scenes:
    """A recording's moments in order, replayed for their maps or as they are."""

    def __init__(self, recording: Recording, *, fly_again: bool) -> None:
        """Raises ModelError where the networks that the recording flew with are not here."""
        self._recording = recording
        self.rig: Rig = build_rig(recording.config.rig)
        self._pilot = FlockPilot(recording.config, learned=recording.learned) if fly_again else None
        self.compared = 0
        """Steps whose outputs came out once more."""
        self.equal = 0
        """Those of them that came out as recorded."""

    def moments(self, start_s: float, end_s: float) -> Iterator[Moment]:
        """Those within this time of the recording's clock. Raises RecordingError where it is damaged."""
        path, last = OwnPath(), None
        for step in self._recording.steps(start_s, end_s):
            output = None if step.output is None else from_json(PilotOutput, step.output)
            velocity = None if output is None else output.velocity
            position = path.go_on(step.frames.time_s, velocity, step.vehicle.height_m)
            place = Place(position, step.vehicle.R_ned_body)
            maps = None
            if self._pilot is not None:
                maps = self._maps(self._pilot, step, (last, place))
            yield Moment(
                number=step.number,
                time_s=step.frames.time_s,
                images={name: frame.image for name, frame in step.frames.frames.items()},
                place=place,
                height_m=step.vehicle.height_m,
                output=output,
                true_neighbours=_true_neighbours(step, self._recording.drone, position),
                maps=maps,
            )
            last = place

    def _maps(self, pilot: FlockPilot, step: RecordedStep, places: tuple[Place | None, Place]) -> Maps | None:
        trace = StepTrace()
        output = pilot.step(step.frames, step.vehicle, trace, step.order)
        if step.output is not None:
            self.compared += 1
            self.equal += _without_times(to_json(output)) == _without_times(step.output)
        if trace.observation is None:
            return None
        pairs = self._pairs(trace.observation, output.ego_motion, places)
        cameras = trace.observation.cameras
        depth: dict[str, Float32Array] = {
            name: z_map(camera.depth, self.rig.cameras[name].camera)  # as Rerun has it
            for name, camera in cameras.items()
            if camera.depth is not None
        }
        return Maps({name: camera.labels for name, camera in cameras.items()}, depth, pairs)

    def _pairs(
        self,
        observation: Observation,
        ego: EgoMotion | None,
        places: tuple[Place | None, Place],
    ) -> dict[str, FloatArray]:
        """Nothing where no camera has both frames."""
        last, here = places
        parameters = self._recording.config.geometry
        if last is None or observation.previous is None or not observation.flows:
            return {}
        still = background_pairs(self.rig, observation, parameters)
        kept = np.zeros(len(still), dtype=np.bool_)
        if ego is not None:
            off = still.previous - (still.current @ ego.rotation.T + ego.translation)  # Eq. 7
            kept = np.linalg.norm(off, axis=1) <= ego.threshold_m
        drones = neighbour_pairs(self.rig, observation, parameters)
        found = {"still": still.select(kept), "rejected": still.select(~kept)}
        found |= {f"drone {label}": pairs for label, pairs in drones.items() if pairs is not None}
        return {kind: _segments(pairs, last, here) for kind, pairs in found.items()}


def texts(recording: Recording, start_s: float, end_s: float) -> Iterator[tuple[float, str]]:
    """Events in words, with the time of the recording's clock."""
    for path in recording.contents.paths:
        for record in records_of(path):
            if isinstance(record, Entry) and record.stream.topic == TABLE["events"].topic:
                message = json.loads(record.data)
                if start_s <= message["time_s"] <= end_s:
                    yield message["time_s"], message["event"]


def _segments(pairs: PointPairs, last: Place, here: Place) -> FloatArray:
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_PAIRS)).astype(np.int64)
    few = pairs.select(chosen)
    return np.stack([last.apply(few.previous), here.apply(few.current)], axis=1)


def _true_neighbours(step: RecordedStep, own: str, position: FloatArray) -> dict[str, FloatArray]:
    """Moved so that the own drone is at its estimated position."""
    drones = () if step.truth is None else step.truth.drones
    true_own = next((drone.position for drone in drones if drone.name == own), None)
    if true_own is None:
        return {}
    return {drone.name: drone.position - true_own + position for drone in drones if drone.name != own}


def _without_times(output: Json) -> dict[str, Json]:
    return {name: value for name, value in output.items() if name != "stages_ms"}
