"""The typed configuration and its loader."""

from flockd.core.config.campaign import CampaignConfig
from flockd.core.config.drone import DroneConfig
from flockd.core.config.envelope import outside_envelope
from flockd.core.config.loader import (
    Overrides,
    kind_of,
    load,
    load_campaign,
    load_drone,
    load_real_drone,
    load_scenario,
    load_with_places,
    schema_of,
)
from flockd.core.config.scenario import ScenarioConfig

__all__ = [
    "CampaignConfig",
    "DroneConfig",
    "Overrides",
    "ScenarioConfig",
    "kind_of",
    "load",
    "load_campaign",
    "load_drone",
    "load_real_drone",
    "load_scenario",
    "load_with_places",
    "outside_envelope",
    "schema_of",
]
