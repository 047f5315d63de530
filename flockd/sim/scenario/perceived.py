"""What separates what drones perceive of each other from the truth, as measured from flights by sight."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core.config.base import Distance, Duration, NonNegative, Section, Share, refuse
from flockd.core.config.document import read_document
from flockd.core.config.loader import validated

_Angle = Annotated[float, Field(ge=0, le=90)]


class Spread(Section):
    """How large an error is: half of its absolute values are below `median`, and 95 % below `p95`."""

    median: NonNegative
    p95: NonNegative

    @model_validator(mode="after")
    def _can_be_drawn(self) -> Self:
        if self.p95 < 2.9 * self.median:
            raise ValueError(
                f"p95 {self.p95:g} is below 2.9 times the median {self.median:g}, as of no error that is about normal; "
                "write a larger one"
            )
        return self


class AtDistance(Section):
    """What is perceived of a neighbour that is so far away; between two of these it is interpolated."""

    distance_m: Distance
    missed: Share
    """Share of the steps without a confirmed track of a neighbour that nothing hides."""
    range_bias: Annotated[float, Field(ge=-0.5, le=0.5)]
    """Logarithm of estimated over true range, median."""
    range_error: Spread
    """Spread of that logarithm about its median."""
    bearing_error_deg: Spread
    """In the plane."""
    velocity_error_m_s: Spread
    """Over ground, each axis."""
    samples: Annotated[int, Field(ge=0)]
    """Neighbours in steps of which these figures are."""


class FalseNeighbours(Section):
    """Confirmed tracks where there is no drone."""

    at_once: NonNegative
    """How many a drone has, mean."""
    lifetime_s: Duration
    """Mean lifetime of each."""
    distances_m: tuple[NonNegative, NonNegative, NonNegative]
    """Tenth, fiftieth and ninetieth percentile of how far away they are."""


class PerceivedErrors(Section):
    """Errors of perception by distance, and how long they last."""

    perception: str
    """Whose errors these are."""
    provenance: tuple[str, ...]
    """Which flights, and what of them was counted."""
    by_distance: Annotated[tuple[AtDistance, ...], Field(min_length=1, max_length=32)]
    """From near to far."""
    range_limit_m: Distance
    """Nobody farther away is perceived."""
    elevation_limit_deg: _Angle
    """Nor anybody farther above or below the horizon."""
    hidden_limit: Share
    """A neighbour of which nearer drones hide more than this share is not perceived."""
    drone_radius_m: Distance
    """Radius of the disc that a drone hides."""
    error_time_s: Duration
    """Time constant of errors of range, bearing and velocity."""
    missed_time_s: Duration
    """The same, of what is missed."""
    own_velocity_error_m_s: Spread
    """Error of a drone's estimate of its own velocity, each axis."""
    own_velocity_time_s: Duration
    false_neighbours: FalseNeighbours

    @model_validator(mode="after")
    def _goes_outwards(self) -> Self:
        faults: dict[tuple[str | int, ...], str] = {}
        distances = [entry.distance_m for entry in self.by_distance]
        for number, (near, far) in enumerate(itertools.pairwise(distances), start=1):
            if far <= near:
                faults["by_distance", number, "distance_m"] = f"is not above the one before, {near:g}; sort the list"
        refuse(self, faults)
        return self


def load_perceived_errors(path: Path | str) -> PerceivedErrors:
    """How perception errs, as `tools.training.fit_perception` writes it. Raises ConfigError with every problem
    found."""
    return validated(PerceivedErrors, read_document(Path(path)))
