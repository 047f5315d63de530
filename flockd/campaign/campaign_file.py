"""A campaign's file: its flights, and the figures to measure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from flockd.campaign.figures import MEASURES, Figure
from flockd.core.config.base import Name, Section, refuse
from flockd.core.config.document import KeyPath, Place, read_document
from flockd.core.config.loader import require, validated

FlightKindName = Literal["truth", "sight"]
"""How the flights of a campaign are flown."""

DRONES = "drones"
"""Stands in the place of a key: the size of the flock."""
MAX_VALUES = 1000
MAX_SEEDS = 1_000_000
_Name = Annotated[Name, Field(max_length=60)]


class Variation(Section):
    """The values of one key."""

    values: Annotated[tuple[Any, ...], Field(min_length=1, max_length=MAX_VALUES)]
    """Values of the grid."""


class CampaignConfig(Section):
    """A campaign: many flights of one scenario."""

    campaign: _Name
    """Its name; by default also the name of its folder."""
    scenario: str
    """The path of the scenario's file, relative to this one."""
    perception: FlightKindName = "truth"
    """`truth`: without images, on exact relative states or, with the scenario's `detections`, on tracks of simulated
    detections. `sight`: networks on rendered images."""
    gated: bool = True
    """Whether each drone flies through its safety gate, as in the daemon. false: the flocking law alone."""
    seed: Annotated[int, Field(ge=0, le=2**53)] = 0
    """Flight n of each cell, from 0, has the scenario's seed `seed` + n, the same in all cells: so flights with the
    same gusts and worlds are compared."""
    paired: bool = True
    """false: each cell has other seeds, cell c from `seed` + c `seeds` on, so that all flights are independent."""
    seeds: Annotated[int, Field(ge=1, le=MAX_SEEDS)]
    """Number of flights of each cell."""
    fixed: dict[str, Any] = Field(default_factory=dict)
    """Values of keys for all flights, by dotted key: `drone.flocking.cohesion: 0.2`, `duration_s: 40`. `drones` is the
    size of the flock."""
    scatter_m: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Largest random shift of every start to the north and to the east, by the flight's seed."""
    vary: dict[str, Variation] = Field(default_factory=dict)
    """Keys that vary, with dots. All combinations of their values are flown; each is a cell."""
    cases: dict[_Name, dict[str, Any]] = Field(default_factory=dict)
    """Named sets of values, each flown in all combinations of `vary`, as in
    `new: {drone.perception.models_dir: new_models}`."""
    measure: Annotated[tuple[Figure, ...], Field(min_length=1)] | None = None
    """Figures to keep; empty: all."""

    @property
    def wanted(self) -> tuple[Figure, ...]:
        """The figures to measure."""
        return self.measure or tuple(MEASURES)

    def seed_of(self, cell: int, number: int) -> int:
        """The scenario's seed of a cell's flight of this number, both from 0."""
        return self.seed + number + (0 if self.paired else cell * self.seeds)

    @model_validator(mode="after")
    def _says_nothing_twice(self) -> Self:
        faults = self._parts_beside_the_whole()
        of_cases = {key for values in self.cases.values() for key in values}
        for key, variation in self.vary.items():
            for number, value in enumerate(variation.values):
                if value in variation.values[:number]:
                    faults["vary", key, "values", number] = f"{value} is given already; delete one"
            if key in self.fixed:
                faults["fixed", key] = "varies too; delete it here or in `vary`"
            if key in of_cases:
                faults["vary", key] = "has a value in `cases` too; delete it here or there"
        for section, keys in (("fixed", self.fixed), ("vary", self.vary)):
            if "seed" in keys:
                faults[section, "seed"] = "is set for each flight; write `seed` and `seeds` at the top level instead"
        for number, figure in enumerate(self.measure or ()):
            if figure in (self.measure or ())[:number]:
                faults["measure", number] = f"{figure} is named already; delete one"
        for case, values in self.cases.items():
            if case != (first := next(name for name, same in self.cases.items() if same == values)):
                faults["cases", case] = f"has the values of {first}; change them, or delete one"
            if "seed" in values:
                faults["cases", case, "seed"] = "is set for each flight; write `seed` and `seeds` at the top level"
        refuse(self, faults)
        return self

    def _parts_beside_the_whole(self) -> dict[tuple[str | int, ...], str]:
        sets: dict[tuple[str, ...], Mapping[str, Any]] = {("fixed",): self.fixed, ("vary",): self.vary}
        sets |= {("cases", case): values for case, values in self.cases.items()}
        return {
            (*place, key): f"is a part of {whole}, which stands here too; write it there"
            for place, keys in sets.items() for key in keys for whole in keys if key.startswith(f"{whole}.")
        }  # fmt: skip


def load_campaign(path: Path | str) -> tuple[CampaignConfig, Mapping[KeyPath, Place]]:
    """A campaign's file, and the place of each value in it. The scenario's file is not read. Raises ConfigError."""
    document = read_document(Path(path), "campaign")
    require(document, "campaign")
    return validated(CampaignConfig, document), document.places
