"""Obstacles of a simulated world."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from flockd.core.config.base import NonNegative, Section, refuse

ObstacleKind = Literal["forest", "village"]
_Metres = Annotated[float, Field(ge=-75, le=75)]
_ONLY_FOR = {"trees_per_hectare": "forest", "houses_per_hectare": "village"}
"""Keys that only one kind has."""


class ClearingConfig(Section):
    """A circle that is kept free of obstacles, for a place where a flock is to gather."""

    north_m: _Metres
    """From the world's origin; so `east_m`."""
    east_m: _Metres
    radius_m: Annotated[float, Field(gt=0, le=50)] = 5.0


class ObstaclesConfig(Section):
    """What stands around the world's origin, drawn from the scenario's seed."""

    kind: ObstacleKind
    """`forest`: trunks with crowns above the drones, and a few young trees with branches down to the ground;
    `village`: a street from south to north with poles and wires, and houses, walls and trees beside it."""
    extent_m: Annotated[float, Field(ge=15, le=75)] = 60.0
    """They stand within this distance of the origin, north and east."""
    trees_per_hectare: Annotated[float, Field(ge=50, le=400)] = 100.0
    """For `forest`: 100 are an old beech wood, 400 a dense plantation."""
    houses_per_hectare: Annotated[float, Field(ge=2, le=16)] = 8.0
    """For `village`."""
    min_gap_m: Annotated[float, Field(ge=1, le=6)] = 2.0
    """Between two trees, houses or walls, measured from the circles around them."""
    free_start_m: NonNegative = 4.0
    """Kept free around each start position."""
    clearings: Annotated[tuple[ClearingConfig, ...], Field(max_length=100)] = ()
    """More places to be kept free."""

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> Self:
        refuse(
            self,
            {
                (key,): f"has no meaning with kind `{self.kind}`, only with `{kind}`; delete it"
                for key, kind in _ONLY_FOR.items()
                if self.kind != kind and key in self.model_fields_set
            },
        )
        return self
