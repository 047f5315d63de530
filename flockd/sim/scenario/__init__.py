"""The typed configuration of a simulated flight, and its loader."""

from flockd.sim.scenario.scenario_config import (
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
    TakeoverConfig,
    VehicleConfig,
)
from flockd.sim.scenario.scenario_file import load, load_scenario, load_with_places, scenario_schema

__all__ = [
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
    "TakeoverConfig",
    "VehicleConfig",
    "load",
    "load_scenario",
    "load_with_places",
    "scenario_schema",
]
