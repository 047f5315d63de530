"""Obstacles: the local map, and avoidance."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.core.config.base import Section

_Metres = Annotated[float, Field(gt=0, le=1000)]
_Seconds = Annotated[float, Field(gt=0, le=60)]


class ObstacleParameters(Section):
    """Parameters of the local map and of avoidance; braking and reaction times are those of `safety.gate`."""

    enabled: bool = False
    """Whether obstacles are detected and avoided."""
    range_m: _Metres = 15.0
    """Range of obstacle detection. The gate always assumes that cameras see this far."""
    height_band_m: _Metres = 0.75
    """Obstacles farther above or below the drone are ignored. The band covers rotors and errors of height."""
    below_m: _Metres = 1.5
    """The limit below the drone, if larger: lower down, trees are wide enough to be detected."""
    range_sigma: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Standard deviation of a range from the depth map, as a share of the range."""
    min_pixels: Annotated[int, Field(ge=1, le=10_000)] = 4
    """Least number of pixels that show an obstacle in a sector; every fourth pixel of each row and column is used."""
    memory_s: _Seconds = 3.0
    """Time for which the map keeps obstacles and free directions that are no longer in view."""
    clearance_m: Annotated[float, Field(gt=0, le=20)] = 0.9
    """Distance of the drone's centre from an obstacle's surface below which it flies away from the obstacle."""
    margin_m: Annotated[float, Field(ge=0, le=20)] = 0.5
    """Added to the clearance if there is room."""
    horizon_s: _Seconds = 3.0
    """A direction is free if the drone meets no obstacle within this time at the wanted speed. Among neighbours this
    speed counts up to 1.5 m/s, or up to theirs if that is faster."""
    sigmas: Annotated[float, Field(ge=0, le=10)] = 2.0
    """Number of standard deviations by which an obstacle is assumed nearer than measured."""
