"""``FlockPilot.step``: camera frames and the own autopilot's state in, velocity command out. No clock, no I/O."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from flockd.config.drone import DroneConfig
from flockd.flocking import FlockingLaw, course, desired_velocity
from flockd.geometry import build_rig
from flockd.inference import models_folder
from flockd.messages import (
    BoolArray,
    Detection,
    EgoMotion,
    Float32Array,
    FloatArray,
    FrameSet,
    Neighbour,
    NeighbourMotion,
    PilotOutput,
    VehicleState,
    VelocityCommand,
)
from flockd.perception import Perception, SceneMaps
from flockd.perception.depth import VelocityScale
from flockd.pilot.motions import ego_motion, neighbour_motions
from flockd.pilot.views import Observer, Perceiver, RigView
from flockd.tracking import Blind, ExpectedNeighbour, Measurement, Tracker

_OWN_DISPLACEMENT_SIGMA_M = 0.02
_MAX_REFUSALS = 2
_MOTION_CAUTION = 2.0
"""Eq. 36 rests on the same ranges as the positions do: it counts for less than its own spread says."""


class FlockPilot:
    """One drone's pilot. Remembers the last frame set and its tracks; everything else comes in with each step."""

    def __init__(
        self,
        config: DroneConfig,
        perceiver: Perceiver | None = None,
        stopwatch: Callable[[], float] | None = None,
    ) -> None:
        """``perceiver`` may be shared by several pilots. ``stopwatch`` (seconds) only fills ``stages_ms``."""
        self._config = config
        self._rig = build_rig(config.rig)
        self._perceiver = perceiver or load_perception(config)
        self._observer = Observer(self._rig, self._perceiver, height_fixes_scale=config.perception.scale == "height")
        self._scale = VelocityScale(self._rig) if config.perception.scale == "velocity" else None
        self._tracker = Tracker(config.tracking)
        self._law = FlockingLaw(config.flocking)
        self._stopwatch = stopwatch
        self._first_time_s: float | None = None
        self._previous: RigView | None = None
        self._velocity: FloatArray | None = None
        self._refused_in_a_row = 0
        self._flows_seen: Mapping[str, Float32Array] = {}

    @property
    def last_view(self) -> RigView | None:
        """What the last step saw, for reports."""
        return self._previous

    @property
    def last_flows(self) -> Mapping[str, Float32Array]:
        """By camera, the flow into the last step's images, for reports."""
        return self._flows_seen

    def step(self, frames: FrameSet, vehicle: VehicleState) -> PilotOutput:
        """One step of the pure line.

        Args:
            frames: the newest image of every camera that has one.
            vehicle: what the own autopilot says, at the frames' time.
        """
        laps = _Laps(self._stopwatch)
        if self._first_time_s is None:
            self._first_time_s = frames.time_s
        maps, reasons = self._observer.scenes(frames, vehicle)
        laps.end("scene")
        previous, reasons = self._pair_with(frames.time_s, reasons)
        flows = self._flows(previous, frames, maps)
        laps.end("flow")
        if self._scale:
            maps, why = self._fixed(self._scale, previous, vehicle, maps, flows)
            reasons += why
        view = self._observer.view(frames, vehicle, maps, reasons, self._expected(frames.time_s))
        laps.end("distance")
        ego, displacement = self._ego_motion(previous, view, flows, reasons)
        laps.end("ego_motion")
        motions: dict[int, NeighbourMotion] = {}
        if ego is not None and previous is not None:
            motions, why = neighbour_motions(self._rig, previous, view, flows, ego, self._config.geometry)
            reasons += why
        laps.end("neighbour_motion")
        velocity = self._own_velocity(ego, displacement, vehicle)
        tracks = self._track(previous, view, displacement, motions, velocity)
        laps.end("tracking")
        neighbours = self._tracker.neighbours()
        command = self._command(view, neighbours, velocity)
        laps.end("flocking")
        self._previous, self._flows_seen = view, flows
        return PilotOutput(
            time_s=view.time_s,
            ego_motion=ego,
            velocity=velocity,
            detections=view.detections,
            detection_tracks=tracks,
            neighbour_motions=motions,
            neighbours=neighbours,
            command=command,
            reasons=tuple(reasons),
            counts=Counter(reasons),
            stages_ms=laps.stages_ms,
        )

    def _expected(self, time_s: float) -> tuple[ExpectedNeighbour, ...]:
        if self._previous is None or time_s <= self._previous.time_s:
            return ()
        return self._tracker.expect(time_s - self._previous.time_s, self._velocity)

    def _pair_with(self, time_s: float, reasons: list[str]) -> tuple[RigView | None, list[str]]:
        if self._previous is not None and time_s <= self._previous.time_s:
            return None, [*reasons, "time stamps do not increase: the pair starts anew"]
        return self._previous, reasons

    def _flows(
        self, previous: RigView | None, frames: FrameSet, maps: Mapping[str, SceneMaps]
    ) -> dict[str, Float32Array]:
        if previous is None:
            return {}
        both = {name: previous.cameras[name] for name in maps if name in previous.cameras}
        return {n: self._perceiver.flow(n, v.image, frames.frames[n].image, v.labels) for n, v in both.items()}

    @staticmethod
    def _fixed(
        scale: VelocityScale,
        previous: RigView | None,
        vehicle: VehicleState,
        maps: Mapping[str, SceneMaps],
        flows: Mapping[str, Float32Array],
    ) -> tuple[dict[str, SceneMaps], list[str]]:
        """The maps with their scale from the autopilot's velocity."""
        before = previous.vehicle if previous else None
        labels = {name: view.labels for name, view in previous.cameras.items()} if previous else {}
        return scale.fix(before, vehicle, labels, maps, flows)

    def _ego_motion(
        self, previous: RigView | None, view: RigView, flows: Mapping[str, Float32Array], reasons: list[str]
    ) -> tuple[EgoMotion | None, FloatArray | None]:
        """The motion in C and the displacement in NED."""
        if previous is None:
            return None, None
        try:
            ego = ego_motion(self._rig, previous, view, flows, self._config.geometry)
        except ValueError as error:
            reasons.append(f"ego-motion: {error}")
            return None, None
        displacement = previous.vehicle.R_ned_body @ ego.translation
        if not self._is_plausible(displacement, ego.interval_s):
            reasons.append("ego-motion: no vehicle changes its velocity that fast")
            return None, None
        return ego, displacement

    def _is_plausible(self, displacement: FloatArray, interval_s: float) -> bool:
        """Whether the last velocity can have become this one; a third refusal in a row would rather doubt the last."""
        if self._velocity is None:
            return True
        change = float(np.linalg.norm(displacement / interval_s - self._velocity))
        allowed = self._config.geometry.max_acceleration_m_s2 * interval_s * (1 + self._refused_in_a_row)
        if change <= allowed or self._refused_in_a_row == _MAX_REFUSALS:
            self._refused_in_a_row = 0
            return True
        self._refused_in_a_row += 1
        return False

    def _own_velocity(
        self, ego: EgoMotion | None, displacement: FloatArray | None, vehicle: VehicleState
    ) -> FloatArray | None:
        """(3,) NED m/s. Where vision fails, the last one that it gave."""
        if ego is not None and displacement is not None:
            self._velocity = displacement / ego.interval_s  # Eq. 21
        return vehicle.velocity_ned if self._config.own_velocity == "autopilot" else self._velocity

    def _track(
        self,
        previous: RigView | None,
        view: RigView,
        displacement: FloatArray | None,
        motions: Mapping[int, NeighbourMotion],
        velocity: FloatArray | None,
    ) -> tuple[int, ...]:
        if previous is not None:
            self._tracker.predict(view.time_s - previous.time_s, displacement, _OWN_DISPLACEMENT_SIGMA_M)
        measurements = [
            _measurement(s, view.vehicle.R_ned_body, previous, motions.get(s.label)) for s in view.detections
        ]
        return self._tracker.update(view.time_s, measurements, velocity, self._blind(view))

    def _blind(self, view: RigView) -> Blind | None:
        """Where only cameras look that gave nothing in this step; None: they all did."""
        gone = self._rig.cameras.keys() - view.cameras.keys()
        if not gone:
            return None

        def blind(places: FloatArray) -> BoolArray:
            pixels = self._rig.pixels_of(places @ view.vehicle.R_ned_body)  # row by row R^T p: into the body's axes
            shown = {name: np.isfinite(uv).all(axis=1) for name, uv in pixels.items()}
            of_gone = np.any([shown[name] for name in gone], axis=0)
            of_others = np.any([shown[name] for name in view.cameras], axis=0)
            hidden: BoolArray = of_gone & ~of_others
            return hidden

        return blind

    def _command(self, view: RigView, neighbours: Sequence[Neighbour], velocity: FloatArray | None) -> VelocityCommand:
        elapsed_s = view.time_s - (self._first_time_s or 0.0)
        desired = desired_velocity(self._config.desired, elapsed_s)
        seen = [n for n in neighbours if n.confirmed]
        positions = np.array([n.position[:2] for n in seen]).reshape(-1, 2)
        velocities = np.array([n.velocity[:2] for n in seen]).reshape(-1, 2)
        own = desired if velocity is None else velocity[:2]  # before the first pair: as asked for
        command, acceleration = self._law.command(own, positions, velocities, desired, self._config.step_s)
        R = view.vehicle.R_ned_body
        heading = math.atan2(R[1, 0], R[0, 0])
        yaw = course(self._config.desired, elapsed_s) if self._config.yaw == "course" else heading
        return VelocityCommand(command, acceleration, yaw)


def load_perception(config: DroneConfig) -> Perception:
    """The networks that a configuration names. Raises ModelError."""
    return Perception(config.perception, models_folder(config.perception))


def _measurement(
    detection: Detection, R_ned_body: FloatArray, previous: RigView | None, motion: NeighbourMotion | None
) -> Measurement:
    """A detection in level axes, with the velocity of Eq. 36 where there is one."""
    position = R_ned_body @ detection.position
    covariance = detection.range_m**2 * R_ned_body @ detection.covariance @ R_ned_body.T
    measurement = Measurement(
        position=position,
        covariance=covariance,
        size_m=detection.size_m,
        drone_probability=detection.drone_probability,
    )
    if motion is None or previous is None:
        return measurement
    return replace(
        measurement,
        velocity=previous.vehicle.R_ned_body @ motion.velocity,
        velocity_sigma_m_s=_MOTION_CAUTION * math.sqrt(2) * detection.range_sigma_m / motion.interval_s,
    )


class _Laps:
    """Milliseconds between calls, if there is a watch."""

    def __init__(self, stopwatch: Callable[[], float] | None) -> None:
        self._watch = stopwatch
        self._last = stopwatch() if stopwatch else 0.0
        self.stages_ms: dict[str, float] = {}

    def end(self, stage: str) -> None:
        if self._watch:
            now = self._watch()
            self.stages_ms[stage] = 1e3 * (now - self._last)
            self._last = now
