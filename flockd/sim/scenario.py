"""The typed configuration of one simulated flight: vehicles, sensors, world, made-up detections; and its loader."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from math import dist
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import Field, model_validator

from flockd.core.config.base import FromHome, NonNegative, Positive, Section, Share, Speed, refuse
from flockd.core.config.document import Document, KeyPath, Place, read_document
from flockd.core.config.drone import DroneConfig
from flockd.core.config.loader import Overrides, drone_document, kind_of, override, require, validated
from flockd.core.config.mission import MissionParameters, mission_faults
from flockd.core.data import data_path
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray
from flockd.sim.cameras.imperfect_cameras import CamerasConfig, CameraTimingConfig
from flockd.sim.renderer.drone_models import FAMILIES

MAX_DRONES = 100
"""More would take days and all memory."""
MAX_DURATION_S = 86400.0
_LOWEST_M = 0.5
"""A drone that begins lower touches the uneven ground."""
_HIGHEST_M = 1000.0
MIN_START_DISTANCE_M = 0.7
"""Smallest distance of two drones at the start, about the size of one: nearer, they touch."""


_Wind = Annotated[float, Field(ge=-50, le=50)]
"""m/s; a hurricane's, and faster than any of these vehicles."""


class StartConfig(Section):
    """The start of one vehicle."""

    position_m: tuple[FromHome, FromHome, float]
    """North, east, down: a height of 4.5 m is -4.5."""
    velocity_m_s: tuple[_Wind, _Wind] = (0.0, 0.0)
    """North, east."""
    mission: MissionParameters | None = None
    """Its own mission; null: that of `drone`. Positions count from the world's origin."""
    by_hand: bool = False
    """Whether a person flies it along its mission, in Position mode and without flockd; it looks like the others."""


class VehicleConfig(Section):
    """Response of a simulated multirotor to velocity setpoints; by default that of PX4 1.18 in software to steps of up
    to 4 m/s (tests/sim/autopilot/px4_steps.csv)."""

    dead_time_s: Annotated[float, Field(ge=0, le=5)] = 0.2
    velocity_time_constant_s: Positive = 0.39
    max_acceleration_m_s2: Positive = 7.0
    max_jerk_m_s3: Positive = 19.0
    yaw_time_constant_s: Positive = 0.4
    max_yaw_rate_deg_s: Positive = 60.0
    tilt_time_constant_s: NonNegative = 0.1
    wind_m_s: tuple[_Wind, _Wind] = (0.0, 0.0)
    """Mean wind, north and east."""
    gust_m_s: Speed = 0.0
    """Standard deviation of the velocity that gusts add, each axis, at a constant setpoint. Under the flocking law
    gusts carry drones farther, because its setpoint starts from the own velocity."""
    gust_length_m: Annotated[float, Field(ge=1, le=1000)] = 36.6
    """Length of gusts: they push drones alike that are much nearer to each other. By default that of MIL-F-8785C at a
    height of 5 m over open ground; it is less among trees and houses."""
    radius_m: Annotated[float, Field(gt=0, le=5)] = 0.35
    """Radius of the sphere around its centre that contains the drone; a nearer obstacle is a collision."""


class RangeFinderConfig(Section):
    """A simulated range finder that faces down, and its errors."""

    rate_hz: Annotated[float, Field(gt=0, le=200)] = 30.0
    noise: Share = 0.015
    """Standard deviation of a reading, as a share of the range; at least 0.01 m, because MAVLink sends centimetres."""
    min_m: NonNegative = 0.15
    """Shortest range; a reading of nearer ground has no signal."""
    max_m: Positive = 20.0
    """Longest range, likewise."""
    tilt_deg: Annotated[float, Field(ge=0, le=10)] = 0.5
    """Standard deviation of its mounting angle from the body's down axis, about each axis."""
    dropouts_per_min: NonNegative = 2.0
    """Mean number of dropouts per minute."""
    dropout_s: Positive = 0.5
    """Mean duration of a dropout."""

    @model_validator(mode="after")
    def _measures_something(self) -> Self:
        if self.min_m >= self.max_m:
            refuse(self, {("min_m",): f"{self.min_m:g} is not below max_m {self.max_m:g}; write a smaller one"})
        return self


class SensorConfig(Section):
    """Errors of the simulated autopilot's estimates and of the cameras."""

    barometer_drift_m: NonNegative = 0.2
    """Standard deviation of the slow height error."""
    barometer_drift_time_s: Positive = 100.0
    barometer_noise_m: NonNegative = 0.02
    attitude_error_deg: NonNegative = 0.2
    """Standard deviation of the slow roll and pitch error."""
    heading_error_deg: NonNegative = 2.0
    """The same for the heading."""
    turn_rate_noise_deg_s: NonNegative = 1.0
    """Standard deviation of the noise on the rate of turn, each axis."""
    velocity_error_m_s: NonNegative = 0.1
    """Standard deviation of the slow error of the autopilot's velocity, each axis, as measured with PX4 1.18."""
    velocity_error_time_s: Positive = 2.0
    """How long that error stays about the same."""
    position_error_m: NonNegative = 0.1
    """Standard deviation of the slow error of the autopilot's position, each axis."""
    position_error_time_s: Positive = 5.0
    """How long that error stays about the same."""
    range_finder: RangeFinderConfig | None = RangeFinderConfig()
    """null: the drone has none."""
    image_noise: NonNegative = 2.0
    """Standard deviation in grey levels of 0-255."""


ObstacleKind = Literal["forest", "village"]
_Metres = Annotated[float, Field(ge=-75, le=75)]
_ONLY_FOR = {"trees_per_hectare": "forest", "houses_per_hectare": "village"}
"""Keys that only one kind has."""


class ClearingConfig(Section):
    """A circle without obstacles, for example where a flock gathers."""

    north_m: _Metres
    """From the world's origin; `east_m` likewise."""
    east_m: _Metres
    radius_m: Annotated[float, Field(gt=0, le=50)] = 5.0


class ObstaclesConfig(Section):
    """Obstacles around the world's origin, drawn from the scenario's seed."""

    kind: ObstacleKind
    """`forest`: trunks with crowns above the drones, and a few young trees with branches down to the ground;
    `village`: a street from south to north with poles and wires, and houses, walls and trees beside it."""
    extent_m: Annotated[float, Field(ge=15, le=75)] = 60.0
    """Largest distance from the origin, north and east."""
    trees_per_hectare: Annotated[float, Field(ge=50, le=400)] = 100.0
    """For `forest`: 100 as in an old beech wood, 400 as in a dense plantation."""
    houses_per_hectare: Annotated[float, Field(ge=2, le=16)] = 8.0
    """For `village`."""
    min_gap_m: Annotated[float, Field(ge=1, le=6)] = 2.0
    """Least gap between the circles around two trees, houses or walls."""
    free_start_m: NonNegative = 4.0
    """Radius without obstacles around each start position."""
    clearings: Annotated[tuple[ClearingConfig, ...], Field(max_length=100)] = ()
    """Further places without obstacles."""

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> Self:
        foreign = {
            (key,): kind for key, kind in _ONLY_FOR.items() if self.kind != kind and key in self.model_fields_set
        }
        told = f"has no meaning with kind `{self.kind}`, only with"
        refuse(self, {key: f"{told} `{kind}`; delete it" for key, kind in foreign.items()})
        return self


class WorldConfig(Section):
    """The world."""

    ground_relief_m: Annotated[float, Field(ge=0, le=2)] = 0.15
    """Standard deviation of the gently uneven ground; 0 is flat."""
    hills_m: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Height from the lowest to the highest point of hills, if `hills_slope` permits it; level at the origin."""
    hills_slope: Annotated[float, Field(gt=0, le=0.5)] = 0.15
    """Steepest slope of the hills."""
    clearance_m: Annotated[float, Field(ge=0, le=100)] = 9.0
    """Width without obstacles on both sides of the planned path."""
    drone_family: Annotated[int, Field(ge=0, le=FAMILIES - 1)] | Literal["any"] = "any"
    """Shape of the drones; `any`: drawn from the seed, the same for the whole flock."""
    obstacles: ObstaclesConfig | None = None
    """Trees, or houses, walls, poles and wires, on level ground; null: no obstacles within `clearance_m`."""

    @model_validator(mode="after")
    def _obstacles_stand_on_level_ground(self) -> Self:
        if self.obstacles is not None and self.hills_m > 0:
            refuse(self, {("obstacles",): "stand on level ground only; delete them, or write 0 for `hills_m`"})
        return self


_FITTED = yaml.safe_load((data_path("config") / "perceived" / "shipped_networks.yaml").read_text(encoding="utf-8"))
_PERCEIVED: dict[str, dict[str, Any]] = {
    kind: {**errors, "missed": None, "false_m": tuple(errors["false_m"])}
    for kind, errors in _FITTED["detections"].items()
}
_MISSED: dict[str, FloatArray] = {kind: np.transpose(one["missed"]) for kind, one in _FITTED["detections"].items()}
"""Distances, m, and the share that is missed there."""
_TRAINED = _PERCEIVED["trained"]


class DetectionsConfig(Section):
    """Detections drawn from the truth with persistent errors, for flights without images. They go through the drone's
    tracker; the own displacement is wrong by 2 cm a step. By default the errors are those of flights by sight
    (config/perceived/shipped_networks.yaml). A camera with one of `faults` detects no drone, and the drone flies
    degraded."""

    airframe: Literal["trained", "unknown"] = "trained"
    """Source of errors that are not given here: airframes of the networks' training, or real airframes of known size
    that are not in the training."""
    range_m: Positive = 20.0
    """Largest range at which drones are detected."""
    missed: Share | None = None
    """Probability that a drone is not detected in a step, at all distances; null: as measured at each distance, 1
    beyond."""
    range_error: Annotated[float, Field(gt=0, le=1)] = _TRAINED["range_error"]
    """Standard deviation of the logarithm of a range."""
    bearing_error_rad: Annotated[float, Field(gt=0, le=1)] = _TRAINED["bearing_error_rad"]
    """Standard deviation of a bearing, each axis."""
    error_time_s: NonNegative = _TRAINED["error_time_s"]
    """Time constant of errors; 0: independent in each step."""
    missed_time_s: NonNegative = _TRAINED["missed_time_s"]
    """Time constant of misses, likewise."""
    false_at_once: Share = _TRAINED["false_at_once"]
    """Mean number of false neighbours of a drone at a time, at most one; a false neighbour does not move."""
    false_time_s: Positive = _TRAINED["false_time_s"]
    """Mean duration of a false neighbour, from its confirmation on."""
    false_m: tuple[Positive, Positive, Positive] = _TRAINED["false_m"]
    """Distances of false neighbours: 10th, 50th and 90th percentile."""

    @model_validator(mode="after")
    def _percentiles_rise(self) -> Self:
        if sorted(self.false_m) != list(self.false_m):
            refuse(self, {("false_m",): "falls; write the 10th, the 50th and the 90th percentile in this order"})
        return self

    @property
    def filled(self) -> Self:
        """With the errors of the airframe for those that are not given."""
        return type(self)(**{**_PERCEIVED[self.airframe], **self.model_dump(exclude_unset=True)})

    def missed_at(self, range_m: float) -> float:
        """Probability that a drone at this range is not detected in a step."""
        if range_m > self.range_m:
            return 1.0
        if self.missed is not None:
            return self.missed
        distances_m, shares = _MISSED[self.airframe]
        return float(np.interp(range_m, distances_m, shares, right=1.0))


class CameraFaultConfig(Section):
    """One simulated camera delivers no images."""

    drone: Annotated[int, Field(ge=1)]
    """The drone: the number of its entry in `vehicles`, from 1."""
    camera: str
    """Its name in the rig."""
    begin_s: NonNegative = 0.0
    """Time since the first image of the flight; with PX4 that is before the take-off."""
    end_s: Positive = MAX_DURATION_S


class TakeoverConfig(Section):
    """One drone's autopilot takes over in flight, as if its pilot had selected another mode."""

    drone: Annotated[int, Field(ge=1)]
    """The drone: the number of its entry in `vehicles`, from 1."""
    time_s: NonNegative
    to: Literal["hold", "land"]


_CLOCKS_APART_S = 0.2
_UNEVEN = CamerasConfig(timing=CameraTimingConfig(jitter_s=0.002))
_REFERENCE_LATENCY_S = 0.25
"""A step of four cameras on one core of the reference computer takes 0.19 s at the median, capture and decoding the
rest."""
_IDEAL: Mapping[str, Mapping[str, object]] = {
    "vehicle": {
        "dead_time_s": 0.0, "velocity_time_constant_s": 0.25, "max_acceleration_m_s2": 4.0, "max_jerk_m_s3": 1e6,
    },
    "sensors": {
        "barometer_drift_m": 0.1, "heading_error_deg": 0.2, "turn_rate_noise_deg_s": 0.0,
        "velocity_error_time_s": 10.0, "position_error_m": 0.5, "position_error_time_s": 60.0,
    },
    "detections": {"error_time_s": 0.0, "missed_time_s": 0.0, "false_at_once": 0.0},
}  # fmt: skip


class ScenarioConfig(Section):
    """One simulated flight."""

    scenario: Annotated[str, Field(min_length=1)]
    duration_s: Annotated[float, Field(gt=0, le=MAX_DURATION_S)] = 110.0
    """One step of the drone at least, one day at most."""
    seed: Annotated[int, Field(ge=0)] = 0
    ideal: bool = False
    """Easier than reality, for studies of a part: gates and autopilots know the truth, steps take no time, clocks and
    frames are exact, vehicles respond at once. Keys given besides it still hold."""
    latency_s: Annotated[float, Field(ge=0, le=5)] | None = None
    """Delay from the images to the resulting setpoints. null: 0.25 s, or a step if that is shorter; 0 if `ideal`."""
    clocks_apart_s: Annotated[float, Field(ge=0, le=10)] | None = None
    """Standard deviation of the time at which each drone leaves the paper's circle, because clocks differ. null: 0.2 s;
    0 if `ideal`."""
    vehicles: Annotated[tuple[StartConfig, ...], Field(min_length=1, max_length=MAX_DRONES)]
    vehicle: VehicleConfig = VehicleConfig()
    sensors: SensorConfig = SensorConfig()
    cameras: CamerasConfig | None = None
    """Faults of the cameras. null: only `sensors.image_noise`, and time stamps are exact to 2 ms, or exact if
    `ideal`."""
    world: WorldConfig = WorldConfig()
    detections: DetectionsConfig | None = None
    """For `--perception truth`: drones track such detections of each other; null: they know exact states without
    delay."""
    faults: tuple[CameraFaultConfig, ...] = ()
    """Cameras that fail in flight."""
    takeovers: tuple[TakeoverConfig, ...] = ()
    """Autopilots that take over in flight; not with real daemons."""
    drone: DroneConfig
    """The path of the drone's configuration, relative to the scenario's file, or the configuration itself. The
    scenario's keys `mission` and `obstacles` replace its own."""

    def drone_of(self, vehicle: int) -> DroneConfig:
        """The configuration of one vehicle's pilot."""
        mission = self.vehicles[vehicle].mission or self.drone.mission
        if mission.kind == "circle_then_tangent":
            late_s = self._clocks_apart_s * random.Random(f"clock {self.seed} {vehicle}").gauss(0.0, 1.0)
            mission = mission.model_copy(update={"circle_until_s": max(mission.circle_until_s + late_s, 0.0)})
        return self.drone if mission is self.drone.mission else self.drone.model_copy(update={"mission": mission})

    def lost_cameras(self, vehicle: int, time_s: float) -> frozenset[str]:
        """The names of one vehicle's cameras that have a fault at a time of the flight."""
        of_vehicle = [fault for fault in self.faults if fault.drone == vehicle + 1]
        return frozenset(fault.camera for fault in of_vehicle if fault.begin_s <= time_s < fault.end_s)

    @property
    def _clocks_apart_s(self) -> float:
        if self.clocks_apart_s is not None:
            return self.clocks_apart_s
        return 0.0 if self.ideal else _CLOCKS_APART_S

    @property
    def step_latency_s(self) -> float:
        """See `latency_s`."""
        if self.latency_s is not None:
            return self.latency_s
        return 0.0 if self.ideal else min(_REFERENCE_LATENCY_S, self.drone.step_s)

    @property
    def camera_faults(self) -> CamerasConfig | None:
        """See `cameras`."""
        return self.cameras or (None if self.ideal else _UNEVEN)

    @model_validator(mode="before")
    @classmethod
    def _begin_ideally(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or values.get("ideal") is not True:
            return values
        filled = dict(values)
        for section, ideal in _IDEAL.items():
            given = filled.get(section, {})
            if given is None or (section == "detections" and section not in filled):
                continue
            if isinstance(given, Section):
                given = given.model_dump(exclude_unset=True)
            filled[section] = {**ideal, **given} if isinstance(given, Mapping) else given
        return filled

    @property
    def missions(self) -> list[tuple[MissionParameters, bool]]:
        """The mission of each vehicle, and whether it is flown by hand."""
        return [(self.drone_of(i).mission, vehicle.by_hand) for i, vehicle in enumerate(self.vehicles)]

    def warnings(self) -> list[str]:
        """What can be flown and is hardly meant: vehicles out of sight of all others, and what comes after the end."""
        sight_m, places = self.drone.perception.detection.max_range_m, [one.position_m for one in self.vehicles]
        nearest_m = [min((dist(one, other) for other in places if other != one), default=0.0) for one in places]
        begin_s = {f"faults[{number}].begin_s": one.begin_s for number, one in enumerate(self.faults)}
        begin_s |= {f"takeovers[{number}].time_s": one.time_s for number, one in enumerate(self.takeovers)}
        late = (
            f"is not before the flight's end, duration_s {self.duration_s:g}: it will not happen; write an earlier one"
        )
        return [f"{key}: {at_s:g} {late}" for key, at_s in begin_s.items() if at_s >= self.duration_s] + [
            f"vehicles[{number}].position_m: begins {apart_m:.0f} m from the nearest other, and drones see others up "
            f"to perception.detection.max_range_m, {sight_m:g} m; move it nearer, unless its mission does"
            for number, apart_m in enumerate(nearest_m)
            if apart_m > sight_m
        ]

    @model_validator(mode="after")
    def _can_be_flown(self) -> Self:
        faults: dict[tuple[str | int, ...], str] = {}
        for key, text in (*self._faults_of_vehicles(), *self._faults_of_what_goes_wrong()):
            faults.setdefault(key, text)
        step_s = self.drone.step_s
        if round(self.duration_s / step_s) < 1:
            faults["duration_s",] = (
                f"{self.duration_s:g} s is shorter than a step of {step_s:g} s; write {step_s:g} or more"
            )
        refuse(self, faults)
        return self

    def _faults_of_vehicles(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        for number, vehicle in enumerate(self.vehicles):
            if vehicle.by_hand and all(other.by_hand for other in self.vehicles):
                yield ("vehicles", number, "by_hand"), "flies the last drone by hand too; leave one to flockd"
            if vehicle.mission is not None:
                limits = self.drone.safety.gate, self.drone.flocking.max_speed_m_s
                for key, text in mission_faults(vehicle.mission, *limits).items():
                    yield ("vehicles", number, "mission", *key), text
            down_m, place = vehicle.position_m[2], ("vehicles", number, "position_m")
            above = f"begins {abs(down_m):g} m above the ground; write "
            if down_m > 0:
                below = f"the third number points down, so that {down_m:g} is {down_m:g} m below the ground; "
                yield place, f"{below}write {-max(down_m, _LOWEST_M):g}"
            elif down_m > -_LOWEST_M:
                yield place, f"{above}-{_LOWEST_M:g} or less as the third number"
            elif down_m < -(most_m := _HIGHEST_M if vehicle.by_hand else self.drone.safety.gate.max_height_m):
                yield place, f"{above}-{most_m:g} or more as the third number, or raise safety.gate.max_height_m"
        for one, other in combinations(range(len(self.vehicles)), 2):
            apart_m = dist(self.vehicles[one].position_m, self.vehicles[other].position_m)
            if apart_m < MIN_START_DISTANCE_M:
                near = f"is {apart_m:.2g} m from vehicles[{one}], and drones touch below {MIN_START_DISTANCE_M:g} m; "
                yield ("vehicles", other, "position_m"), f"{near}move one of them"

    def _faults_of_what_goes_wrong(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        cameras, count = [camera.name for camera in self.drone.rig.cameras], len(self.vehicles)
        ordered: Mapping[str, Sequence[CameraFaultConfig | TakeoverConfig]]
        ordered = {"faults": self.faults, "takeovers": self.takeovers}
        for section, entries in ordered.items():
            for number, entry in enumerate(entries):
                if entry.drone > count:
                    text = f"is {entry.drone}, but there are {count} vehicles; write one of theirs"
                    yield (section, number, "drone"), text
                elif self.vehicles[entry.drone - 1].by_hand:
                    yield (section, number, "drone"), f"is {entry.drone}, which is flown by hand; write one of flockd's"
        for number, fault in enumerate(self.faults):
            if fault.camera not in cameras:
                yield ("faults", number, "camera"), f"is not in the rig; write one of {', '.join(cameras)}"
            if fault.end_s <= fault.begin_s:
                yield ("faults", number, "end_s"), f"is not after begin_s {fault.begin_s:g}; write a larger one"


_BESIDE_DRONE = ("mission", "obstacles")
"""Sections of a drone that its scenario may have instead."""


def load_scenario(path: Path | str, overrides: Overrides | None = None) -> ScenarioConfig:
    """The configuration of one simulated flight, with the drone's file that its key `drone` names merged into it.

    `overrides` sets single values over the files', by dotted key: `{"seed": 3, "drone.perception.flow": "dis"}`.
    Raises ConfigError with every problem found in both files.
    """
    return validated(ScenarioConfig, _scenario_document(Path(path), overrides or {}))


def load(path: Path | str) -> DroneConfig | ScenarioConfig:
    """A drone's or a scenario's configuration, whichever the file's keys belong to. Raises ConfigError."""
    return load_with_places(path)[0]


def load_with_places(path: Path | str) -> tuple[DroneConfig | ScenarioConfig, Mapping[KeyPath, Place]]:
    """The same, with the place of each value in the file, for checks of more than the file. Raises ConfigError."""
    path = Path(path)
    if kind_of(read_document(path)) == "drone":
        document = drone_document(path, {})
        return validated(DroneConfig, document), document.places
    document = _scenario_document(path, {})
    return validated(ScenarioConfig, document), document.places


def scenario_schema() -> dict[str, Any]:
    """The JSON schema of a scenario's file: its drone may be a path, and sections of the drone stand beside it."""
    schema = ScenarioConfig.model_json_schema()
    drone = schema["properties"]["drone"]
    inline = {"$ref": drone.pop("$ref")}
    schema["properties"]["drone"] = {"title": "Drone", **drone, "anyOf": [{"type": "string"}, inline]}
    of_all = "Of all vehicles without one of their own, instead of that in `drone`."
    schema["properties"]["mission"] = {"$ref": "#/$defs/MissionParameters", "description": of_all}
    schema["properties"]["obstacles"] = {"$ref": "#/$defs/ObstacleParameters", "description": "Instead of `drone`'s."}
    return schema


def _scenario_document(path: Path, overrides: Overrides) -> Document:
    document = read_document(path)
    require(document, "scenario")
    _merge_drone(document, path.parent)
    for key in _BESIDE_DRONE:
        _merge_section(document, key)
    override(document, overrides)
    return document


def _merge_drone(document: Document, folder: Path) -> None:
    """Puts the drone's values and places where the scenario's file names the drone's file.

    A scenario may also hold the drone's values itself, as `flockd config show` prints them. Raises ConfigError.
    """
    place = document.places.get(("drone",), replace(document.places[()], key="drone"))
    name = document.values.get("drone")
    if isinstance(name, dict):
        return
    if not isinstance(name, str) or not name:
        fault = "must be the path of the drone's own YAML file" if "drone" in document.values else "is missing"
        raise ConfigError([place.problem(f"{fault}; write it as in `drone: simulator.yaml`")])
    try:
        drone = drone_document(folder / name, {})
    except ConfigError as error:
        told = place.problem(f"names {name}, which cannot be used; correct it or name another")
        raise ConfigError([told, *error.problems]) from error
    document.values["drone"] = drone.values
    document.places.update({("drone", *path): place for path, place in drone.places.items()})
    document.problems.extend(drone.problems)


def _merge_section(document: Document, key: str) -> None:
    """Puts a scenario's section in place of its drone's, with its places: one drone's file flies many missions."""
    drone = document.values["drone"]
    if not isinstance(drone, dict) or key not in document.values:
        return
    document.values["drone"] = {**drone, key: document.values.pop(key)}
    places = {path: place for path, place in document.places.items() if path[:2] != ("drone", key)}
    document.places.clear()
    document.places.update({("drone", *path) if path[:1] == (key,) else path: at for path, at in places.items()})
