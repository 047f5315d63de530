"""Flocks, and errors of perception, for flights at control level."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from flockd.core.data import data_path
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.perceived import PerceivedErrors, load_perceived_errors
from tests import make

SHIPPED = load_perceived_errors(data_path("config") / "perceived" / "shipped_networks.yaml")
NONE = {"median": 0.0, "p95": 0.0}
FAULTLESS: dict[str, Any] = {
    "perception": "test",
    "provenance": (),
    "by_distance": [
        {
            "distance_m": 5.0, "missed": 0.0, "range_bias": 0.0, "range_error": NONE, "bearing_error_deg": NONE,
            "velocity_error_m_s": NONE, "samples": 1,
        }
    ],
    "range_limit_m": 500.0,
    "elevation_limit_deg": 90.0,
    "hidden_limit": 1.0,
    "drone_radius_m": 0.35,
    "error_time_s": 2.0,
    "missed_time_s": 2.0,
    "own_velocity_error_m_s": NONE,
    "own_velocity_time_s": 2.0,
    "false_neighbours": {"at_once": 0.0, "lifetime_s": 2.0, "distances_m": [2.0, 5.0, 9.0]},
}  # fmt: skip


def errors(entry: dict[str, Any] | None = None, **keys: Any) -> PerceivedErrors:
    """None but these, at every distance those of `entry`."""
    values = {**FAULTLESS, "by_distance": [{**FAULTLESS["by_distance"][0], **(entry or {})}], **keys}
    return PerceivedErrors.model_validate(values, strict=False)


@lru_cache
def flock(name: str = "paper_flight", drones: int | None = None, **keys: Any) -> ScenarioConfig:
    """A shipped scenario with so many drones, and values by dotted key with `__`; ideal, as the control level is."""
    scenario = make.scenario({"ideal": True} | {key.replace("__", "."): value for key, value in keys.items()}, name)
    return scenario if drones is None else with_drones(scenario, drones)


def level(scenario: ScenarioConfig) -> ScenarioConfig:
    """With all drones at one height."""
    starts = [one.model_copy(update={"position_m": (*one.position_m[:2], -4.0)}) for one in scenario.vehicles]
    return scenario.model_copy(update={"vehicles": tuple(starts)})
