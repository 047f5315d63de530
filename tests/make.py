"""What tests fly with: messages, cameras and configurations that are fine, from the little that a test is about.

Every builder takes the fields that matter to a test, by name; the others are those of one quiet drone 5 m above home.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass, replace
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np
from pydantic import BaseModel

from flockd.core.config import DroneConfig
from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig, RigConfig
from flockd.core.data import data_path
from flockd.core.messages import (
    SECTORS,
    Detection,
    FloatArray,
    Frame,
    FrameSet,
    Neighbour,
    PilotOutput,
    Reason,
    ReasonKind,
    UInt8Array,
    VehicleState,
    Wanted,
)
from flockd.flight.geometry import PinholeCamera, RigCamera, RigidTransform, log_polar_covariance
from flockd.flight.safety import OFFBOARD, Action, CameraHealth, Inputs, Permission, Request, Surroundings
from flockd.onboard.autopilot.autopilot_status import AutopilotStatus
from flockd.onboard.telemetry.topics import FlightMessage
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import ScenarioConfig, load_scenario

Section = TypeVar("Section", bound=BaseModel)


def vehicle(time_s: float = 0.0, height_m: float = 5.0, **fields: Any) -> VehicleState:
    """Level, heading north, hovering above home, as the autopilot says; sequences become arrays."""
    state = VehicleState(time_s, np.eye(3), height_m, velocity_ned=np.zeros(3), position=np.zeros(2))
    return replace(state, **_arrays(fields))


def neighbour(
    position: Sequence[float] | FloatArray, velocity: Sequence[float] | FloatArray = (0.0, 0.0, 0.0), **fields: Any
) -> Neighbour:
    """Followed for long and confirmed, metres and m/s in NED from the own drone."""
    known = Neighbour(
        track=1, position=np.array(position, float), velocity=np.array(velocity, float), position_sigma_m=0.05,
        velocity_sigma_m_s=0.1, age_s=5.0, unseen_s=0.0, hits=10, confirmed=True,
    )  # fmt: skip
    return replace(known, **_arrays(fields))


def detection(
    position: Sequence[float] | FloatArray, range_sigma: float = 0.02, angle_sigma_rad: float = 0.005, **fields: Any
) -> Detection:
    """At a place in body FRD, its log range and its bearing this uncertain."""
    range_m = float(np.linalg.norm(position))
    bearing = np.asarray(position, float) / range_m
    seen = Detection(
        bearing=bearing, log_range=math.log(range_m),
        covariance=log_polar_covariance(bearing, range_sigma, angle_sigma_rad),
        drone_probability=0.95, size_m=0.5, cameras=("front",), label=1,
    )  # fmt: skip
    return replace(seen, **_arrays(fields))


def wanted(velocity: Sequence[float] | FloatArray = (0.0, 0.0), yaw_rad: float | None = 0.0, **fields: Any) -> Wanted:
    """A level velocity, m/s north and east."""
    return replace(Wanted(np.array(velocity, float), np.zeros(2), yaw_rad), **_arrays(fields))


def around(
    position: Sequence[float] | FloatArray = (0.0, 0.0), velocity: Sequence[float] | FloatArray = (0.0, 0.0), *,
    neighbours: Sequence[Any] | FloatArray = (), obstacles: Sequence[Any] | FloatArray = (), **fields: Any,
) -> Surroundings:  # fmt: skip
    """Of a drone 5 m high, with neighbours (n, 3) that stand still and points of obstacles (m, 2), metres from it."""
    near, points = np.reshape(np.array(neighbours, float), (-1, 3)), np.reshape(np.array(obstacles, float), (-1, 2))
    here, moves = np.array(position, float), np.array(velocity, float)
    none, now = np.zeros((len(near), 2)), np.zeros(len(near))
    nearby = Surroundings(here, moves, 0.5, near, none, 5.0, points, none, now, np.full(SECTORS, np.inf))
    return replace(nearby, **_arrays(fields))


def request(
    now_s: float, velocity: Sequence[float] | FloatArray = (0.0, 0.0), action: Action = Action.FLY,
    surroundings: Surroundings | None = None, *, yaw_rad: float | None = 1.0, **fields: Any,
) -> Request:  # fmt: skip
    """For a velocity that is wanted and permitted now."""
    want = wanted(velocity, yaw_rad)
    asked = Request(Permission(action, now_s), want, now_s, 5.0, around() if surroundings is None else surroundings)
    return replace(asked, **fields)


def quiet(**changes: Any) -> Inputs:
    """What a supervisor hears in a flight with four cameras in which nothing is the matter."""
    sees = CameraHealth(age_s=0.02, period_s=0.033, fault=None)
    fine = Inputs(
        cameras=dict.fromkeys(("front", "right", "back", "left"), sees), dropped_share=0.01, estimate_age_s=0.4,
        ego_motion_age_s=0.0, network_faults=0, inference_stuck=False, load=0.6, temperature_c=60.0, loop_lag_s=0.01,
        velocity_error_m_s=0.1, velocity_late_s=0.0, dead_tasks=(), neighbours_age_s=0.4, nearest_neighbour_m=2.5,
        refused_commands=0, obstacle_near=False, outside_fence=False, outside_heights=False, motion_age_s=0.03,
        heartbeat_age_s=0.5, message_age_s=0.1, stream_fault=None, autopilot_failsafe=False, foreign_setpoints=None,
        parameter_fault=None, frame_jumped=False, flight_mode=OFFBOARD, armed=True, in_air=True, battery_low=False,
        position_lost=False, shutdown_asked=False, hold_asked=False, land_asked=False, resume_asked=False,
    )  # fmt: skip
    return replace(fine, **changes)


def output(time_s: float = 0.0, **fields: Any) -> PilotOutput:
    """Of a step in which nothing was seen and nothing is wanted."""
    nothing = PilotOutput(time_s, None, None, (), (), (), wanted())
    return replace(nothing, **fields)


def autopilot_status(**fields: Any) -> AutopilotStatus:
    """Armed in the air in Hold, heard a moment ago, all well, at home."""
    known = AutopilotStatus(
        time_s=0.0, heartbeat_age_s=0.1, message_age_s=0.1, flight_mode="hold", armed=True, failsafe=False,
        landed_state="air", battery_share=1.0, estimate_ok=True, gps_ok=True,
        position_ned=np.zeros(3), home_ned=np.zeros(3),
    )  # fmt: skip
    return replace(known, **fields)


def flight_message(**fields: Any) -> dict[str, Any]:
    """Telemetry's `flight` of a drone that flies with the flock."""
    known = FlightMessage(
        time_s=5.0, state="normal", reasons=[], flight_mode="offboard", armed=True, in_air=True, heartbeat_age_s=0.1,
        heartbeats_lost=0, battery_share=0.5, height_m=4.0, velocity_trim=[0.0, 0.0], velocity_error_m_s=0.1,
        silence=None, setpoints_sent=1, setpoints_missed=0, orders=[], orders_refused=0,
    )  # fmt: skip
    return {**known, **fields}


def frames(time_s: float, images: Mapping[str, UInt8Array] | None = None, sequence: int = 0) -> FrameSet:
    """The images of these cameras, all taken at one time; none without any."""
    return FrameSet(time_s, {name: Frame(name, one, time_s, sequence) for name, one in (images or {}).items()})


def pinhole(focal_px: float, size: tuple[int, int]) -> PinholeCamera:
    """Without distortion, its principal point in the middle; size as (width, height)."""
    width, height = size
    return PinholeCamera(np.array([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]]), size)


def rig_camera(focal_px: float, size: tuple[int, int], name: str = "front") -> RigCamera:
    """A pinhole whose optical axes are the body's."""
    return RigCamera(name, pinhole(focal_px, size), RigidTransform(np.eye(3), np.zeros(3)))


def camera(
    name: str = "front", size_px: tuple[int, int] = (64, 48), focal_px: float = 32.0, **extrinsics: Any
) -> CameraConfig:
    """A pinhole's configuration: 90 degrees wide, looking forward unless ``extrinsics`` says otherwise."""
    lens = IntrinsicsConfig(fx=focal_px, fy=focal_px, cx=size_px[0] / 2, cy=size_px[1] / 2)
    return CameraConfig(name=name, size_px=size_px, intrinsics=lens, extrinsics=ExtrinsicsConfig(**extrinsics))


def drone(*cameras: CameraConfig, **sections: Any) -> DroneConfig:
    """With these cameras, or one that looks ahead."""
    return DroneConfig(rig=RigConfig(cameras=cameras or (camera(),)), **sections)


def scenario(
    overrides: Mapping[str, Any] | None = None, name: str = "paper_flight", drones: int | None = None
) -> ScenarioConfig:
    """A shipped one, with single values set over the file's by dotted key, and with so many drones."""
    flight = load_scenario(data_path("config") / f"{name}.yaml", dict(overrides or {}))
    return flight if drones is None else with_drones(flight, drones)


def small_eyes(flight: ScenarioConfig, every: int = 2) -> ScenarioConfig:
    """The same with cameras of half the size, front and back alone or all: what is seen need not be sharp."""
    eyes = []
    for one in flight.drone.rig.cameras[::every]:
        halves = {f"intrinsics__{key}": getattr(one.intrinsics, key) / 2 for key in ("fx", "fy", "cx", "cy")}
        eyes.append(changed(one, size_px=(one.size_px[0] // 2, one.size_px[1] // 2), **halves))
    return changed(flight, drone__rig__cameras=tuple(eyes))


def changed(section: Section, **keys: Any) -> Section:
    """A copy of a configuration with other values, by dotted path with `__`: ``safety__gate__max_speed_m_s=1.0``."""
    for path, value in keys.items():
        head, _, rest = path.partition("__")
        section = section.model_copy(update={head: changed(getattr(section, head), **{rest: value}) if rest else value})
    return section


def filled(kind: Any, number: float) -> Any:
    """A message of this type with something in every field, whatever fields it has."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Reason:
        return Reason(ReasonKind.RECORDED, "front")
    if is_typeddict(kind):
        return {name: filled(hint, number) for name, hint in get_type_hints(kind).items()}
    if origin is Literal:
        return parts[0]
    if origin is list:
        return [filled(parts[0], number)] * 3
    if is_dataclass(kind) and isinstance(kind, type):
        hints = get_type_hints(kind, include_extras=True)
        return kind(**{field: filled(hint, number) for field, hint in hints.items()})
    if origin is Annotated:
        return np.full(parts[1].sizes, number)
    if origin in (Union, UnionType, tuple):
        inner = filled(parts[0], number)
        return (inner,) if origin is tuple else inner
    if origin is not None:
        return {filled(parts[0], number): filled(parts[1], number)}
    return {float: number, int: 3, bool: True, str: "front"}[kind]


def _arrays(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Lists of numbers as the arrays that messages hold."""
    return {name: np.array(value, float) if isinstance(value, list) else value for name, value in fields.items()}
