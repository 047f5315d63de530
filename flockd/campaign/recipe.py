"""What one flight's scenario is made of; small, and the same on every computer it is sent to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockd.config import ScenarioConfig
from flockd.config.campaign import DRONES
from flockd.config.scenario import MIN_START_DISTANCE_M, StartConfig
from flockd.errors import UsageError
from flockd.flocking.metrics import min_distance
from flockd.sim.start import with_drones

Values = dict[str, Any]
_SCATTER = 7
"""Tells the generator of the starts from the others of the same seed."""
_TRIES = 200


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
            scenario = scenario.model_copy(update={"vehicles": _scattered(scenario, self.scatter_m)})
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


def _scattered(scenario: ScenarioConfig, scatter_m: float) -> tuple[StartConfig, ...]:
    """The starts, each moved by up to ``scatter_m`` to the north and to the east, drawn again until they are apart."""
    rng = np.random.default_rng([scenario.seed, _SCATTER])
    starts = np.array([vehicle.position_m for vehicle in scenario.vehicles])
    for _ in range(_TRIES):
        moved = starts.copy()
        moved[:, :2] += rng.uniform(-scatter_m, scatter_m, (len(starts), 2))
        if min_distance(moved) >= MIN_START_DISTANCE_M:
            return tuple(
                vehicle.model_copy(update={"position_m": tuple(place)})
                for vehicle, place in zip(scenario.vehicles, moved.tolist(), strict=True)
            )
    raise UsageError(f"no starts of seed {scenario.seed} were {MIN_START_DISTANCE_M:g} m apart; write less scatter_m")
