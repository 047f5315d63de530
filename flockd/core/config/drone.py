"""The typed configuration of one drone: every parameter, its unit, its default and its limits.

Strict: an unknown key, a wrong type or a number that is not finite is refused. The defaults are the paper's where it
gives one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from flockd.core.choices import OwnVelocitySource
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.config.base import Name, Section, refuse
from flockd.core.config.flocking import FlockingParameters
from flockd.core.config.geometry import GeometryParameters
from flockd.core.config.mission import MissionParameters, mission_faults
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.recording import RecordingConfig
from flockd.core.config.rig import RigConfig
from flockd.core.config.safety import SafetyParameters
from flockd.core.config.source import SourceParameters
from flockd.core.config.telemetry import TelemetryParameters
from flockd.core.config.tracking import TrackingParameters


class DroneConfig(Section):
    """Everything one drone's pilot needs."""

    name: Name = "drone"
    """By which it is known in telemetry and recordings; different for each drone of a fleet."""
    step_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    rig: RigConfig
    source: SourceParameters | None = None
    """Where the frames come from; needed to fly, not to simulate."""
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
    """None: this drone's commands go nowhere but to the simulator."""
    telemetry: TelemetryParameters = TelemetryParameters()

    @property
    def speed_factor(self) -> float:
        """How fast this drone's time passes: 1 unless it is simulated."""
        return 1.0 if self.source is None else self.source.shared_memory.speed_factor

    @model_validator(mode="after")
    def _sections_agree(self) -> Self:
        gate_m_s, law_m_s = self.safety.gate.max_speed_m_s, self.flocking.max_speed_m_s
        faults: dict[tuple[str | int, ...], str] = {
            ("mission", *key): text for key, text in mission_faults(self.mission, self.safety.gate, law_m_s).items()
        }
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
        if self.autopilot is not None and self.autopilot.obstacle_distance and not self.obstacles.enabled:
            fault = "needs the map of obstacles; write `enabled: true` in `obstacles`, or false here"
            faults["autopilot", "obstacle_distance"] = fault
        if self.speed_factor != 1.0 and self.autopilot is not None and self.autopilot.address.startswith("serial:"):
            fault = "is for simulations, and an autopilot on a cable is none; delete it"
            faults["source", "shared_memory", "speed_factor"] = fault
        if self.source is not None and self.source.kind != "shared_memory":
            faults |= self._device_faults([camera.name for camera in self.source.cameras])
        refuse(self, faults)
        return self

    def _device_faults(self, devices: Sequence[str]) -> dict[tuple[str | int, ...], str]:
        """Where the cameras of the rig and the names of their devices do not match."""
        rig = [camera.name for camera in self.rig.cameras]
        faults: dict[tuple[str | int, ...], str] = {}
        for number, name in enumerate(devices):
            if name not in rig:
                told = f"{name} is no camera of the rig; write one of {', '.join(rig)}"
                faults["source", "cameras", number, "name"] = told
            elif name in devices[:number]:
                faults["source", "cameras", number, "name"] = f"{name} has an entry already; keep one"
        missing = [name for name in rig if name not in devices]
        if missing and not faults:
            told = f"has no entry of the name {missing[0]}, which is a camera of the rig; add one"
            faults["source", "cameras"] = told
        return faults
