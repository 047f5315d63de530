"""The typed configuration of one simulated flight."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from flockd.config.base import NonNegative, Positive, Section, Vector3
from flockd.config.drone import DroneConfig


class StartConfig(Section):
    """Where one vehicle begins."""

    position_m: Vector3
    """NED."""
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    """North, east."""


class VehicleConfig(Section):
    """How a simulated multirotor answers a velocity setpoint."""

    velocity_time_constant_s: Positive = 0.25
    max_acceleration_m_s2: Positive = 4.0
    yaw_time_constant_s: Positive = 0.4
    max_yaw_rate_deg_s: Positive = 60.0
    tilt_time_constant_s: NonNegative = 0.1
    wind_m_s: tuple[float, float] = (0.0, 0.0)
    """Mean wind, north and east."""
    gust_m_s: NonNegative = 0.0
    """Standard deviation of the velocity that gusts add, each axis."""


class SensorConfig(Section):
    """What separates the simulated autopilot's and cameras' readings from the truth."""

    barometer_drift_m: NonNegative = 0.1
    """Standard deviation of the slow height error."""
    barometer_drift_time_s: Positive = 100.0
    barometer_noise_m: NonNegative = 0.02
    attitude_error_deg: NonNegative = 0.2
    """Standard deviation of the slow roll and pitch error."""
    velocity_error_m_s: NonNegative = 0.1
    """Standard deviation of the slow error of the autopilot's own velocity."""
    image_noise: NonNegative = 2.0
    """Standard deviation in grey levels of 0-255."""


class WorldConfig(Section):
    """The rendered world."""

    ground_relief_m: NonNegative = 0.15
    """Standard deviation of the gently uneven ground; 0 is flat."""
    clearance_m: NonNegative = 9.0
    """Free of obstacles on both sides of the planned path."""
    drone_family: Annotated[int, Field(ge=0)] | Literal["any"] = "any"
    """Which mesh the drones wear; `any`: drawn from the seed, the same for the whole flock."""


class ScenarioConfig(Section):
    """One simulated flight."""

    scenario: Annotated[str, Field(min_length=1)]
    duration_s: Positive = 110.0
    seed: Annotated[int, Field(ge=0)] = 0
    vehicles: Annotated[tuple[StartConfig, ...], Field(min_length=1)]
    vehicle: VehicleConfig = VehicleConfig()
    sensors: SensorConfig = SensorConfig()
    world: WorldConfig = WorldConfig()
    drone: DroneConfig
    """In the file: the path of the drone's own configuration, relative to the scenario's."""
