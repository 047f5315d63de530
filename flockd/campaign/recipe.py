"""What one flight's scenario is made of; small, and the same on every computer it is sent to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flockd.campaign.campaign_file import DRONES
from flockd.sim.flock.start import scattered, with_drones
from flockd.sim.scenario import ScenarioConfig

Values = dict[str, Any]


@dataclass(frozen=True)
class Recipe:
    """One flight: a scenario's own values, and those put over them."""

    base: Mapping[str, Any]
    overrides: Mapping[str, Any]
    """By dotted key."""
    seed: int
    scatter_m: float

    def scenario(self) -> ScenarioConfig:
        """Raises ValueError (pydantic's ValidationError) for values that cannot be flown, and UsageError for starts."""
        values = merged(self.base, {**self.overrides, "seed": self.seed})
        count = values.pop(DRONES, None)
        scenario = ScenarioConfig.model_validate(values)
        if count is not None:
            scenario = with_drones(scenario, count)
        if self.scatter_m:
            scenario = scattered(scenario, self.scatter_m)
        return scenario


def merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> Values:
    """The values with others over them, by dotted key. Raises ValueError where a key leads into a list or a value."""
    values = dict(base)
    for key, value in overrides.items():
        *sections, last = key.split(".")
        inside = values
        for section in sections:
            inner = inside.get(section)
            if inner is not None and not isinstance(inner, Mapping):
                raise ValueError(f"`{section}` is not a section, so that it has no `{last}`; set `{section}` itself")
            inside[section] = dict(inner or {})
            inside = inside[section]
        inside[last] = value
    return values
