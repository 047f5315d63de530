"""The typed configuration of one drone: every parameter, its unit, its default and its limits.

Strict: an unknown key, a wrong type or a number that is not finite is refused. The defaults are the paper's where it
gives one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from flockd.core.choices import ImageFormat, OwnVelocitySource
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.config.base import Endpoint, Name, Positive, Section, refuse
from flockd.core.config.flocking import FlockingParameters
from flockd.core.config.geometry import GeometryParameters
from flockd.core.config.mission import MissionParameters, mission_faults
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.rig import RigConfig
from flockd.core.config.safety import SafetyParameters
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.config.tracking import TrackingParameters
from flockd.core.secrets import masked


class RecordingConfig(Section):
    """How a flight is recorded, if it is recorded."""

    images: ImageFormat = "png"
    """Only `png` is lossless, so that a replay equals the flight."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 90
    queue_mb: Positive = 64.0
    """Memory for data that wait for the disk; when it is full, steps are dropped."""
    quota_mb: Positive = 20000.0
    """Limit for all recordings of the drone in one folder. The oldest are deleted to make room, also on a full disk.
    The previous flight's recording does not count; it is deleted last, and on a full disk only. A flight that exceeds
    the limit alone is recorded up to it."""


OperatorCommand = Literal["hold", "land", "resume", "goto", "velocity"]


class TelemetryParameters(Section):
    """Endpoints at which this drone can be watched, and the commands that it accepts."""

    fleet: Name = "fleet"
    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    """zenoh endpoints at which watchers find this drone, as in `tcp/0.0.0.0:7447`."""
    connect: tuple[Endpoint, ...] = ()
    """zenoh endpoints, of a router or of `flockd status --listen`, that this drone keeps trying to reach."""
    zenoh_config: str | None = None
    """A file of zenoh's settings, for TLS and access control; see `config/zenoh_tls.json5`. A relative path starts at
    the folder of the configuration file."""
    commands: tuple[OperatorCommand, ...] = ()
    """Commands that operators may send over telemetry; by default no command. `goto` and `velocity` change the mission
    until the flight ends."""

    @model_validator(mode="after")
    def _endpoints_differ(self) -> Self:
        endpoints = (*self.listen, *self.connect)
        twice = next((one for number, one in enumerate(endpoints) if one in endpoints[:number]), None)
        if twice is not None:
            raise ValueError(f"{masked(twice)} is named twice in listen and connect; delete one")
        return self


class DroneConfig(Section):
    """The configuration of one drone."""

    name: Name = "drone"
    """Its name in telemetry and recordings; different for each drone of a fleet."""
    step_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    rig: RigConfig
    source: SourceParameters | None = None
    """The source of camera frames; required to fly, not to simulate."""
    perception: PerceptionConfig = PerceptionConfig()
    geometry: GeometryParameters = GeometryParameters()
    tracking: TrackingParameters = TrackingParameters()
    flocking: FlockingParameters = FlockingParameters()
    mission: MissionParameters = MissionParameters()
    obstacles: ObstacleParameters = ObstacleParameters()
    safety: SafetyParameters = SafetyParameters()
    own_velocity: OwnVelocitySource = "vision"
    yaw: Literal["hold", "course"] = "course"
    """Heading: kept as it is, or along the desired velocity."""
    recording: RecordingConfig = RecordingConfig()
    autopilot: AutopilotParameters | None = None
    """The link to the autopilot; required to fly, not to simulate."""
    telemetry: TelemetryParameters = TelemetryParameters()

    @property
    def speed_factor(self) -> float:
        """Speed of this drone's time relative to real time: 1 unless it is simulated."""
        return 1.0 if self.source is None else self.source.shared_memory.speed_factor

    @model_validator(mode="after")
    def _sections_agree(self) -> Self:
        gate_m_s, law_m_s = self.safety.gate.max_speed_m_s, self.flocking.max_speed_m_s
        faults: dict[tuple[str | int, ...], str] = {
            ("mission", *key): text for key, text in mission_faults(self.mission, self.safety.gate, law_m_s).items()
        }
        if self.mission.at_end == "land" and (self.mission.height_offset_m or self.safety.first_flight_layer):
            faults["mission", "at_end"] = "`land` leads down onto drones of other layers, out of view below; write hold"
        trim_m_s = 0.0 if self.autopilot is None else self.autopilot.max_velocity_trim_m_s
        if law_m_s > gate_m_s:
            faults["flocking", "max_speed_m_s"] = (
                f"{law_m_s:g} is above safety.gate.max_speed_m_s, which would refuse it; write {gate_m_s:g} or less"
            )
        elif law_m_s + trim_m_s > gate_m_s and not math.isclose(law_m_s + trim_m_s, gate_m_s):
            faults["autopilot", "max_velocity_trim_m_s"] = (
                f"{trim_m_s:g} and flocking.max_speed_m_s {law_m_s:g} are together above safety.gate.max_speed_m_s, "
                f"which would refuse them; write {gate_m_s - law_m_s:g} or less"
            )
        if self.autopilot is not None:
            faults |= self._late_steps()
        if self.flocking.desired_distance_m >= self.flocking.observation_distance_m:
            far_m = self.flocking.observation_distance_m
            told = f"is not below observation_distance_m {far_m:g}, beyond which no drone counts; write a smaller one"
            faults["flocking", "desired_distance_m"] = f"{self.flocking.desired_distance_m:g} {told}"
        if (size_m := self.perception.drone_size_m) is not None and size_m >= (
            apart_m := self.safety.gate.min_separation_m
        ):
            told = f"{apart_m:g} m is not above perception.drone_size_m {size_m:g}, at which drones touch"
            faults["safety", "gate", "min_separation_m"] = f"{told}; write a larger one"
        if self.flocking.size == "learn" and self.perception.drone_size_m is not None:
            faults["flocking", "size"] = "learns what perception.drone_size_m says; delete one of the two"
        if self.speed_factor != 1.0 and self.autopilot is not None and self.autopilot.address.startswith("serial:"):
            fault = "is for simulations, and an autopilot on a cable is none; delete it"
            faults["source", "shared_memory", "speed_factor"] = fault
        if self.source is not None and (apart_s := self.source.set_tolerance_s) > self.step_s:
            told = f"{apart_s:g} s is longer than step_s {self.step_s:g}; write a smaller one"
            faults["source", "set_tolerance_s"] = told
        if self.source is not None:
            if self.source.kind != "shared_memory":
                faults |= self._device_faults(self.source.cameras)
            rate_hz = max([camera.rate_hz for camera in self.source.cameras] or [self.source.shared_memory.rate_hz])
            if self.step_s * rate_hz < 1.0 and not math.isclose(self.step_s * rate_hz, 1.0):
                told = f"{self.step_s:g} s is below the {1 / rate_hz:.3f} s between two images of the fastest camera"
                faults["step_s",] = f"{told}; write a larger one, or a higher rate_hz of the source"
        refuse(self, faults)
        return self

    def idle_keys(self) -> dict[tuple[str, ...], str]:
        """Keys without an effect, as another key has this value, and why."""
        kind = "shared_memory" if self.source is None else self.source.kind
        idle = {
            ("recording", "jpeg_quality"): ("recording.images is png", self.recording.images == "png"),
            ("perception", "drone_size_sigma_m"): ("there is no drone_size_m", self.perception.drone_size_m is None),
            ("source", "shared_memory"): (f"source.kind is {kind}", kind != "shared_memory"),
            ("autopilot", "max_velocity_trim_m_s"): ("own_velocity is autopilot", self.own_velocity == "autopilot"),
        }
        return {key: why for key, (why, is_idle) in idle.items() if is_idle}

    def _late_steps(self) -> dict[tuple[str | int, ...], str]:
        """Faults of a `step_s` so long that each step, or one that is late, would stop the drone."""
        fresh_s, lasts_s = self.safety.gate.command_fresh_s, self.safety.estimate_timeout_s
        if self.step_s > fresh_s:
            told = f"safety.gate.command_fresh_s {fresh_s:g}, so that the drone would slow down before each step"
        elif 2 * self.step_s > lasts_s:
            told = f"half of safety.estimate_timeout_s {lasts_s:g}, so that one late step would stop the drone"
        else:
            return {}
        return {("step_s",): f"{self.step_s:g} s is above {told}; write a smaller one, or a larger time there"}

    def _device_faults(self, cameras: Sequence[CameraDeviceParameters]) -> dict[tuple[str | int, ...], str]:
        """Faults where the cameras of the rig do not match the names and crops of their devices."""
        rig = {camera.name: camera.size_px for camera in self.rig.cameras}
        devices = [camera.name for camera in cameras]
        faults: dict[tuple[str | int, ...], str] = {}
        for number, (name, cut_px) in enumerate((camera.name, camera.cut_px) for camera in cameras):
            if name not in rig:
                told = f"{name} is no camera of the rig; write one of {', '.join(rig)}"
                faults["source", "cameras", number, "name"] = told
            elif name in devices[:number]:
                faults["source", "cameras", number, "name"] = f"{name} has an entry already; keep one"
            elif cut_px is not None and cut_px != rig[name]:
                cut, size = (" x ".join(map(str, sides)) for sides in (cut_px, rig[name]))
                told = f"gives images of {cut}, but camera {name} of the rig has size_px {size}; correct one"
                faults["source", "cameras", number, "crop"] = told
        missing = [name for name in rig if name not in devices]
        if missing and not faults:
            told = f"has no entry of the name {missing[0]}, which is a camera of the rig; add one"
            faults["source", "cameras"] = told
        return faults
