"""The typed configuration of a simulated flight, and its loader."""

from flockd.sim.scenario.scenario_file import load, load_scenario, load_with_places, scenario_schema
from flockd.sim.scenario.sections import (
    DRONE_FAMILIES,
    MAX_DRONES,
    MIN_START_DISTANCE_M,
    CameraFaultConfig,
    ClearingConfig,
    DetectionsConfig,
    ObstaclesConfig,
    RangeFinderConfig,
    ScenarioConfig,
    SensorConfig,
    StartConfig,
    VehicleConfig,
)

__all__ = [
    "DRONE_FAMILIES",
    "MAX_DRONES",
    "MIN_START_DISTANCE_M",
    "CameraFaultConfig",
    "ClearingConfig",
    "DetectionsConfig",
    "ObstaclesConfig",
    "RangeFinderConfig",
    "ScenarioConfig",
    "SensorConfig",
    "StartConfig",
    "VehicleConfig",
    "load",
    "load_scenario",
    "load_with_places",
    "scenario_schema",
]
