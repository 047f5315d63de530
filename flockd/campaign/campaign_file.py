"""A campaign's file: which flights are flown, what is measured, and when a cell is known well enough."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from flockd.campaign.figures import Figure
from flockd.core.config.base import Name, NonNegative, Positive, Section, refuse
from flockd.core.config.document import KeyPath, Place, read_document
from flockd.core.config.loader import require, validated

FlightKindName = Literal["truth", "sight", "control"]
"""How the flights of a campaign are flown."""

DRONES = "drones"
"""Instead of a key: the size of the flock."""
MAX_CONTROL_DRONES = 10_000
"""The most drones in a flight at control level."""
MAX_VALUES = 1000
MAX_SEEDS = 1_000_000
_Name = Annotated[Name, Field(max_length=60)]
_Number = Annotated[float, Field(allow_inf_nan=False)]


class Variation(Section):
    """The values of one key: `values`; or `low`, `high`, `steps`; or `low`, `high`, drawn for each flight."""

    values: Annotated[tuple[Any, ...], Field(min_length=1, max_length=MAX_VALUES)] | None = None
    """Each is a part of the grid."""
    low: _Number | None = None
    """The smallest value."""
    high: _Number | None = None
    """The largest value."""
    steps: Annotated[int, Field(ge=2, le=MAX_VALUES)] | None = None
    """So many values from `low` to `high`, evenly spaced, each a part of the grid. none: each flight draws its own
    from a uniform distribution, by its seed."""

    @property
    def is_drawn(self) -> bool:
        """Whether each flight draws its own value."""
        return self.values is None and self.steps is None

    @model_validator(mode="after")
    def _is_one_of_the_three(self) -> Self:
        faults: dict[tuple[str | int, ...], str] = {}
        if self.values is not None:
            others = [key for key in ("low", "high", "steps") if getattr(self, key) is not None]
            faults |= {(key,): "has no meaning beside `values`; delete one of them" for key in others}
        elif self.low is None or self.high is None:
            raise ValueError("needs `values`, or `low` and `high`; add them")
        elif self.high <= self.low:
            faults["high",] = f"{self.high:g} is not above `low`, {self.low:g}; write a larger number"
        refuse(self, faults)
        return self


class StopRule(Section):
    """When a cell is known well enough, so that no more of its seeds are flown."""

    figure: Figure
    """The one that has to be known."""
    half_width: Positive
    """Half width of the confidence interval of its mean, in the figure's unit; for `arrived`, of the share of
    flights."""
    confidence: Annotated[float, Field(ge=0.5, le=0.999)] = 0.95
    batch: Annotated[int, Field(ge=2, le=10_000)] = 10
    """Seeds are flown in batches of so many. The rule is asked after each whole batch, about all seeds up to there:
    how many are flown does not depend on which flight is done first."""


class CampaignConfig(Section):
    """A campaign: many flights of one scenario."""

    campaign: _Name
    """Its name, and by default that of its folder."""
    scenario: str
    """The path of the scenario's file, relative to this one."""
    perception: FlightKindName = "truth"
    """`truth`: on exact relative states, without images; `sight`: on networks, from rendered images; `control`: at
    control level, with flocks of any size, many flights at once, on exact states or with `errors`."""
    errors: str | None = None
    """For `control`: the path of a file of perception's errors, relative to this one, as
    `tools.training.fit_perception` writes it. none: exact states. Ranges to obstacles are exact in any case."""
    gated: bool = True
    """Whether each drone flies through its safety gate, as in the daemon; false: to study the flocking law alone."""
    seed: Annotated[int, Field(ge=0, le=2**53)] = 0
    """Flight n of each cell, from 0, flies with the scenario's seed `seed` + n, in all cells alike: so differences
    between cells and between campaigns are of flights with the same gusts and worlds."""
    seeds: Annotated[int, Field(ge=1, le=MAX_SEEDS)]
    """Flights of each cell, at most."""
    fixed: dict[str, Any] = Field(default_factory=dict)
    """Values of keys for all flights, by dotted key: `drone.flocking.cohesion: 0.2`, `duration_s: 40`. `drones` is the
    size of the flock."""
    scatter_m: NonNegative = 0.0
    """Each flight moves every start by up to this much to the north and to the east, by its seed."""
    vary: dict[str, Variation] = Field(default_factory=dict)
    """What varies, by dotted key. All combinations are flown, each is a cell."""
    cases: dict[_Name, dict[str, Any]] = Field(default_factory=dict)
    """Named sets of values, each flown in all combinations of `vary`, as in
    `new: {drone.perception.models_dir: new_models}`."""
    measure: Annotated[tuple[Figure, ...], Field(min_length=1)] | None = None
    """Figures to keep; none: all."""
    stop: StopRule | None = None
    """When a cell is known well enough, so that no more of its seeds are flown. none: all seeds are flown."""

    @model_validator(mode="after")
    def _says_nothing_twice(self) -> Self:
        faults: dict[tuple[str | int, ...], str] = {}
        of_cases = {key for values in self.cases.values() for key in values}
        for key in self.vary:
            if key in self.fixed:
                faults["fixed", key] = "varies too; delete it here or in `vary`"
            if key in of_cases:
                faults["vary", key] = "has a value in `cases` too; delete it here or there"
        for section, keys in (("fixed", self.fixed), ("vary", self.vary)):
            if "seed" in keys:
                faults[section, "seed"] = "is set for each flight; write `seed` and `seeds` at the top level instead"
        for case, values in self.cases.items():
            if "seed" in values:
                faults["cases", case, "seed"] = "is set for each flight; write `seed` and `seeds` at the top level"
        if self.errors is not None and self.perception != "control":
            faults["errors",] = "is for `perception: control`; delete one of them"
        if self.stop is not None and self.measure is not None and self.stop.figure not in self.measure:
            faults["stop", "figure"] = f"is not measured; add {self.stop.figure} to `measure`"
        if self.stop is not None and self.stop.batch > self.seeds:
            faults["stop", "batch"] = f"is above `seeds`, {self.seeds}; write {self.seeds} or less"
        refuse(self, faults)
        return self


def load_campaign(path: Path | str) -> tuple[CampaignConfig, Mapping[KeyPath, Place]]:
    """A campaign's file, and the place of each value in it; of its scenario only the path. Raises ConfigError."""
    document = read_document(Path(path), "campaign")
    require(document, "campaign")
    return validated(CampaignConfig, document), document.places
