"""``FlockPilot.step``: camera frames and the autopilot's state in, velocity command out. No clock, no I/O."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.drone import DroneConfig
from flockd.core.messages import (
    NO_STATUS,
    Detection,
    EgoMotion,
    FloatArray,
    FrameSet,
    GroundEstimate,
    LearnedSize,
    MissionOrder,
    Neighbour,
    ObstacleRanges,
    PilotOutput,
    Reason,
    ReasonKind,
    VehicleState,
    Wanted,
)
from flockd.core.navigation import wrapped
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import HORIZON_S, Passing
from flockd.flight.geometry import build_rig, estimate_ego_motion
from flockd.flight.geometry.level import limit_norm
from flockd.flight.mission import Moment, Navigator
from flockd.flight.mission.navigator import Lookout, middle_of
from flockd.flight.obstacles import Avoidance, LocalMap, ObstacleRanging, nothing_found
from flockd.flight.perception import Networks, Observation, Perception, load_networks
from flockd.flight.perception.detection.detector import DetectionTrace
from flockd.flight.pilot.camera_agreement import CameraAgreement, moves_otherwise
from flockd.flight.pilot.ground import GroundFilter
from flockd.flight.pilot.motions import background_pairs
from flockd.flight.pilot.own_motion import OwnMotion
from flockd.flight.pilot.size_learner import SizeLearner
from flockd.flight.pilot.turns import Turns
from flockd.flight.safety.surroundings import limits_towards
from flockd.flight.tracking import Measurement, Prediction, Shown, Tracker

_ROTATION_TOLERANCE = 1e-3
"""Largest deviation of an attitude's R R^T from the identity. A larger one is not rounding: the attitude is refused."""
_ROUNDING = 1e-6
"""Deviation above which an attitude is replaced by the nearest rotation, as measurements and transforms need one."""
_LONGEST_S = 10.0
"""Longest time between two steps; after a longer gap the pilot starts anew."""
_DISAGREE = "ego-motion: images and autopilot disagree on the velocity; one, or the height above ground, is wrong"
_UNFIT = "ego-motion: images show another motion than the autopilot and the steps before"


@dataclass
class StepTrace:
    """Intermediate results of a step, for reports and viewers: filled if a caller passes one in."""

    observation: Observation | None = None
    detection: DetectionTrace = field(default_factory=DetectionTrace)


class FlockPilot:
    """One drone's pilot. It keeps the last frame set and its tracks; all other inputs come with each step."""

    def __init__(
        self,
        config: DroneConfig,
        networks: Networks | None = None,
        stopwatch: Callable[[], float] | None = None,
        observer: Perception | None = None,
        learned: LearnedSize | None = None,
        *,
        flies: bool = True,
    ) -> None:
        """``networks`` may be shared by several pilots; None: those that the configuration names. ``stopwatch``
        (seconds) only fills ``stages_ms``. ``observer`` replaces perception. ``learned``: the others' size from an
        earlier flight. ``flies``: whether the output is flown; false before a flight. Raises ModelError."""
        self._config = config
        self._rig = build_rig(config.rig)
        self._perception = observer or Perception(
            self._rig, networks or load_networks(config.perception), config.perception
        )
        by_height = config.perception.scale == "height"
        self._ground = GroundFilter(config.perception.height, config.perception.range_finder) if by_height else None
        self._agreement = CameraAgreement(self._rig)
        rest_s = 0.0 if config.obstacles.enabled else config.perception.longest_rest_s  # ranges need the flow
        self._turns = Turns(self._rig, rest_s, config.safety.gate.min_separation_m)
        self._tracker = Tracker(config.tracking, config.safety.gate)
        self._size = SizeLearner(config, learned, flies=flies)
        self._law = FlockingLaw(config.flocking)
        self._passing = Passing(self._law, config.safety.gate.vertical_separation_m)
        self._map = LocalMap(config.obstacles)
        self._ranging = ObstacleRanging(self._rig, config.obstacles) if config.obstacles.enabled else None
        self._avoidance = Avoidance(config.obstacles, config.safety.gate, config.step_s)
        self._navigator = Navigator(config.mission, config.safety.gate)
        self._lookout = Lookout(self._rig)
        self._own = OwnMotion(config.geometry.own_displacement_sigma_m)
        self._stopwatch = stopwatch
        self._first_time_s: float | None = None
        self._first_height_m, self._floor_m = math.nan, -math.inf
        """Height when the flight began, and the least one above the ground that a range showed last."""
        self._height_m: float | None = None
        """The height commanded last, as in `Wanted`."""
        self._last_time_s: float | None = None
        self._yaw_rad: float | None = None
        """The heading commanded last, without what the lookout adds; at first that of the first valid attitude."""
        self._order: MissionOrder | None = None
        self._mission = NO_STATUS
        """As of the last valid step."""

    def step(
        self,
        frames: FrameSet,
        vehicle: VehicleState,
        trace: StepTrace | None = None,
        order: MissionOrder | None = None,
    ) -> PilotOutput:
        """One step of the pipeline.

        Args:
            frames: the newest image of every camera that has one.
            vehicle: the own autopilot's state at the frames' time.
            trace: filled with intermediate results; changes no output.
            order: an operator's order to the mission, in the first step after it arrived.

        Impossible input is refused with a reason: the command is standstill. It stands still at the height and
        heading commanded last. Of such a step the pilot keeps only the order, and the heading if it had none.
        """
        self._order = self._order if order is None else order
        if self._yaw_rad is None and _is_rotation(vehicle.R_ned_body):
            self._yaw_rad = math.atan2(vehicle.R_ned_body[1, 0], vehicle.R_ned_body[0, 0])
        refusal = _why_refused(frames, vehicle)
        if refusal is not None:
            return self._refused(frames.time_s, refusal)
        vehicle = _with_rotation(vehicle)
        elsewhere = self._agreement.elsewhere()
        frames = replace(frames, frames={name: one for name, one in frames.frames.items() if name not in elsewhere})
        laps = _Laps(self._stopwatch)
        trace = trace or StepTrace()
        predictions = self._predictions(frames.time_s)
        ground, why_no_ground = (None, None) if self._ground is None else self._ground.update(vehicle)
        learned = self._size.learned
        resting = self._turns.resting(
            frames.time_s, frames.frames, self._perception.last, lambda: self._near(vehicle.R_ned_body)
        )
        observation = self._perception.observe(
            frames, vehicle, ground, predictions, trace.detection, laps.end, learned, resting
        )
        trace.observation = observation
        if self._config.perception.height == "barometer":
            ground = None  # it would only repeat the vehicle's height
        ego, why_no_ego = self._ego_motion(observation, ground)
        laps.end("ego_motion")
        velocity = vehicle.velocity_ned if self._config.own_velocity == "autopilot" else self._own.velocity
        detections, measurements, why_no_measurement = self._measurements(observation)
        tracks = self._track(observation, measurements, velocity)
        neighbours = self._with_sizes(observation, ego, dict(zip(tracks, measurements, strict=True)), velocity)
        laps.end("tracking")
        ranges = self._local_map(observation, ego, ground)
        laps.end("obstacles")
        command = self._command(observation, neighbours, velocity, ranges, ground)
        laps.end("flocking")
        self._last_time_s = observation.time_s
        of_height = () if why_no_ground is None else (why_no_ground,)
        of_rig = [Reason(ReasonKind.RIG, f"{moves_otherwise(name)} The drone flies without it.") for name in elsewhere]
        reasons = (*of_height, *observation.reasons, *why_no_ego, *why_no_measurement, *of_rig)
        return PilotOutput(
            time_s=observation.time_s,
            ego_motion=ego,
            velocity=velocity,
            detections=detections,
            detection_tracks=tracks,
            neighbours=neighbours,
            command=command,
            reasons=reasons,
            counts=Counter(reason.text for reason in reasons),
            stages_ms=laps.stages_ms,
            mission=self._mission,
            noisy_cameras=(*observation.noisy_cameras, *elsewhere),
            ground=ground,
            obstacles=None if self._ranging is None else ranges,
            seen_m=ranges.seen_m,
            size=self._size.status,
        )

    @property
    def learned(self) -> LearnedSize | None:
        """What the steps so far showed of the others' size, for the next flight's pilot."""
        return self._size.learned

    def _refused(self, time_s: float, reason: Reason) -> PilotOutput:
        """The output of a refused step: neighbours and obstacles of the last valid step, predicted to now."""
        last_s = 0.0 if self._last_time_s is None else self._last_time_s
        time_s = max(time_s, last_s) if math.isfinite(time_s) else last_s
        interval_s = min(time_s - last_s, _LONGEST_S)
        moved, sigma_m = self._own.ahead(interval_s)
        yaw_rad = None if self._yaw_rad is None else wrapped(self._yaw_rad + self._lookout.turn_rad)
        tracker, local_map = copy.deepcopy((self._tracker, self._map))
        if self._last_time_s is not None:
            tracker.predict(interval_s, moved, sigma_m)
            tracker.update(time_s, (), shown=lambda places, radius_m: np.zeros(len(places), np.bool_))
        ranges = local_map.step(time_s, None, None if moved is None else moved[:2], sigma_m)
        return PilotOutput(
            time_s=time_s,
            ego_motion=None,
            velocity=self._own.velocity,
            detections=(),
            detection_tracks=(),
            neighbours=self._size.cautious(tracker.neighbours()),
            command=Wanted(np.zeros(2), np.zeros(2), yaw_rad, height_m=self._height_m),
            mission=self._mission,
            reasons=(reason,),
            counts={reason.text: 1},
            obstacles=None if self._ranging is None else ranges,
            seen_m=ranges.seen_m,
        )

    def _predictions(self, time_s: float) -> tuple[Prediction, ...]:
        """Predictions of the tracks at the frames' time; empty if time runs backwards or jumps too far."""
        if self._last_time_s is None or not 0.0 < time_s - self._last_time_s <= _LONGEST_S:
            return ()
        return self._tracker.predictions(time_s - self._last_time_s, self._own.velocity)

    def _near(self, R_ned_body: FloatArray) -> FloatArray:
        """(n, 3) metres in the body: neighbours of the last step, confirmed or not, and where the drone flies."""
        ahead = [] if self._own.velocity is None else [HORIZON_S * self._own.velocity]
        neighbours = [one.position for one in self._tracker.neighbours()]
        return np.array([*neighbours, *ahead]).reshape(-1, 3) @ R_ned_body

    def _ego_motion(
        self, observation: Observation, ground: GroundEstimate | None
    ) -> tuple[EgoMotion | None, Sequence[Reason]]:
        """The own motion by images in C (the body frame at the previous observation), or the reasons why there is none.
        Updates the state of the own motion."""
        ego, displacement, reasons, interval_s = None, None, [], 0.0
        if observation.previous is not None:
            interval_s = min(observation.interval_s, _LONGEST_S)
            try:
                ego = self._by_images(observation)
            except ValueError as error:
                reasons.append(f"ego-motion: {error}")
            else:
                displacement = observation.previous.vehicle.R_ned_body @ ego.translation
        if not self._own.update(observation.vehicle, interval_s, displacement):
            ego = None
            reasons.append(_UNFIT)
        elif displacement is not None and ground is not None and self._ground is not None:
            self._ground.see_motion(displacement)
        if self._own.disagreement_m_s:
            reasons.append(_DISAGREE)
        return ego, [Reason(ReasonKind.EGO_MOTION, text) for text in reasons]

    def _by_images(self, observation: Observation) -> EgoMotion:
        """The own motion in the depth maps' scale (Eq. 7-21). ValueError gives the reason if there is none."""
        pairs = background_pairs(self._rig, observation, self._config.geometry)
        if observation.previous is not None:
            self._agreement.see(observation.previous.vehicle, observation.vehicle, observation.interval_s, pairs)
        return estimate_ego_motion(pairs, self._rig, observation.interval_s, self._config.geometry)

    def _measurements(self, observation: Observation) -> tuple[tuple[Detection, ...], list[Measurement], list[Reason]]:
        """The detections that the tracker uses, their measurements, and the reasons for those left out."""
        taken, measurements, reasons = [], [], []
        for detection in observation.detections:
            try:
                measurements.append(Measurement.of(detection, observation.vehicle.R_ned_body))
                taken.append(detection)
            except ValueError as error:
                reasons.append(Reason(ReasonKind.NEIGHBOUR, f"neighbour: {error}"))
        return tuple(taken), measurements, reasons

    def _track(
        self,
        observation: Observation,
        measurements: Sequence[Measurement],
        velocity: FloatArray | None,
    ) -> tuple[int, ...]:
        """Updates the tracker. Returns the track of each measurement."""
        if observation.previous is not None:
            if observation.interval_s > _LONGEST_S:
                self._tracker.forget()
            interval_s = min(observation.interval_s, _LONGEST_S)
            self._tracker.predict(interval_s, self._own.displacement, self._own.sigma_m)
        return self._tracker.update(observation.time_s, measurements, velocity, self._shown(observation))

    def _with_sizes(
        self,
        observation: Observation,
        ego: EgoMotion | None,
        measured: Mapping[int, Measurement],
        velocity: FloatArray | None,
    ) -> tuple[Neighbour, ...]:
        """The neighbours after their size is updated with their measurements, by track."""
        sunk_m = 0.0
        if ego is not None and self._own.displacement is not None:
            sunk_m = float(self._own.displacement[2])
        elif observation.previous is not None:
            sunk_m = observation.previous.vehicle.height_m - observation.vehicle.height_m
        neighbours = self._tracker.neighbours()
        size_m = self._size.see(observation.time_s, sunk_m, measured, neighbours)
        if size_m is not None:
            self._tracker.resize(size_m, velocity)
            neighbours = self._tracker.neighbours()
        return self._size.cautious(neighbours)

    def _local_map(
        self, observation: Observation, ego: EgoMotion | None, ground: GroundEstimate | None
    ) -> ObstacleRanges:
        """The local map now; if obstacles are not detected, all is free within view of a camera."""
        if self._ranging is None:
            R = observation.vehicle.R_ned_body
            yaw_rad = math.atan2(R[1, 0], R[0, 0])
            ranges = nothing_found(observation.time_s, self._rig, self._gone(observation), yaw_rad)
        else:
            ranges = self._ranging.ranges(observation, ego, ground)
        displacement = None if self._own.displacement is None else self._own.displacement[:2]
        return self._map.step(observation.time_s, ranges, displacement, self._own.sigma_m)

    def _gone(self, observation: Observation) -> frozenset[str]:
        """Cameras without a usable image in this step."""
        return frozenset(self._rig.cameras.keys() - observation.cameras.keys())

    def _shown(self, observation: Observation) -> Shown:
        """A function that tells which neighbours are wholly in view of a camera with a usable image."""
        gone, R_ned_body = self._gone(observation), observation.vehicle.R_ned_body
        return lambda places, radius_m: self._rig.shows(places @ R_ned_body, radius_m, gone)  # rows R^T p: in the body

    def _command(
        self,
        observation: Observation,
        neighbours: Sequence[Neighbour],
        velocity: FloatArray | None,
        ranges: ObstacleRanges,
        ground: GroundEstimate | None,
    ) -> Wanted:
        if self._first_time_s is None:
            self._first_time_s, self._first_height_m = observation.time_s, observation.vehicle.height_m
        seen = [n for n in neighbours if n.confirmed]
        places = np.array([n.position for n in seen]).reshape(-1, 3)
        velocities = np.array([n.velocity[:2] for n in seen]).reshape(-1, 2)
        ages_s = np.array([n.age_s for n in seen])
        vehicle = observation.vehicle
        guidance = self._navigator.step(
            Moment(
                time_s=max(observation.time_s - self._first_time_s, 0.0),
                position=vehicle.position,
                middle=middle_of(places[:, :2]),
                home_deg=vehicle.home_deg,
                order=self._order,
                heading_rad=self._yaw_rad,
            )
        )
        self._order = None
        self._mission = self._navigator.status(guidance)
        desired = self._mission.desired
        own = guidance.velocity if velocity is None else velocity[:2]  # at first the mission's velocity
        if self._ranging is None:
            tracks = [n.track for n in seen]
            limits = limits_towards(neighbours, vehicle.position, self._config.safety.gate, HORIZON_S)
            command, acceleration = self._passing.command(
                own, places, velocities, desired, self._config.step_s, tracks, limits, ages_s
            )
        else:
            command, acceleration = self._avoidance.command(self._law, own, places, velocities, desired, ranges, ages_s)
        if self._config.yaw == "course" and guidance.course_rad is not None:
            self._yaw_rad = guidance.course_rad
        assert self._yaw_rad is not None, "the attitude is good"
        yaw_rad = self._lookout.heading(observation.time_s, self._yaw_rad, command, self._gone(observation))
        ends = guidance.takeover is not None
        height_m = self._size.height(observation.time_s, vehicle, ground, guidance.height_m, neighbours, ends=ends)
        rises_m = 0.0
        if ground is not None and ground.source == "range_finder":  # the ground may rise, until a climb is flown
            gate, steepest = self._config.safety.gate, self._config.perception.range_finder.max_slope
            climbs_s = self._config.step_s + gate.neighbour_reaction_s
            self._floor_m = vehicle.height_m - ground.height_m + gate.min_height_m
            rises_m = climbs_s * max(float(ground.slope @ own), 0.0)
            most_m, room_m = climbs_s * steepest * math.hypot(*command), ground.height_m - gate.min_height_m / 2
            if most_m > room_m:
                command = command * max(room_m / most_m, 0.0)
        if self._floor_m + rises_m > (self._first_height_m if height_m is None else height_m):
            height_m = self._floor_m + rises_m  # also without a range: it may not sink into a hill
        self._height_m = height_m
        self._mission = replace(self._mission, sentence=self._mission.sentence + self._size.sentence)
        trim = self._trim()
        command = limit_norm(command + trim, self._config.safety.gate.max_speed_m_s)  # exact after rounding
        return Wanted(command, acceleration, yaw_rad, trim if trim.any() else None, height_m)

    def _trim(self) -> FloatArray:
        """(2,) m/s, north and east, that are added to setpoints.

        An autopilot flies a setpoint v so that its own estimate becomes v. If that is wrong by b, the drone moves with
        v - b. Other drones have other b, so a flock with equal commands drifts apart. Adding b corrects it.
        """
        if self._config.own_velocity == "autopilot":
            return np.zeros(2)
        autopilot = self._config.autopilot or AutopilotParameters()  # a simulated autopilot has errors too
        return limit_norm(self._own.error[:2], autopilot.max_velocity_trim_m_s)


def _why_refused(frames: FrameSet, vehicle: VehicleState) -> Reason | None:
    """What in a step's input is impossible; None: nothing."""
    reading = vehicle.ground_range
    numbers: dict[str, ArrayLike | None] = {
        "a time": (frames.time_s, vehicle.time_s),
        "the height": vehicle.height_m,
        "the autopilot's velocity": vehicle.velocity_ned,
        "the rate of turn": vehicle.turn_rate,
        "the range finder's time": None if reading is None else reading.time_s,
        "the autopilot's position": vehicle.position,
        "the position of home": vehicle.home_deg,
    }
    for what, value in numbers.items():
        if value is not None and not np.isfinite(value).all():
            return Reason(ReasonKind.INPUT, f"input refused: {what} is not finite")
    if not _is_rotation(vehicle.R_ned_body):
        return Reason(ReasonKind.INPUT, "input refused: the attitude is not a rotation")
    return None


def _is_rotation(matrix: FloatArray) -> bool:
    return bool(_off_rotation(matrix) <= _ROTATION_TOLERANCE and np.linalg.det(matrix) > 0.0)  # NaN compares false


def _off_rotation(matrix: FloatArray) -> float:
    """Largest deviation of R R^T from the identity, of a (3, 3) matrix R."""
    return float(np.abs(matrix @ matrix.T - np.eye(3)).max())


def _with_rotation(vehicle: VehicleState) -> VehicleState:
    """The state with a rotation as attitude: the nearest one if rounding is larger than a step allows."""
    if _off_rotation(vehicle.R_ned_body) <= _ROUNDING:
        return vehicle
    u, _, vt = np.linalg.svd(vehicle.R_ned_body)
    return replace(vehicle, R_ned_body=u @ vt)


class _Laps:
    """Milliseconds between calls, if there is a watch."""

    def __init__(self, stopwatch: Callable[[], float] | None) -> None:
        self._watch = stopwatch
        self._last = stopwatch() if stopwatch else 0.0
        self.stages_ms: dict[str, float] = {}

    def end(self, stage: str) -> None:
        """Records the time of a stage that ends now."""
        if self._watch:
            now = self._watch()
            self.stages_ms[stage] = 1e3 * (now - self._last)
            self._last = now
