"""Obstacles: how they are kept in mind, and how the drone flies around them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.core.config.base import Section

_Metres = Annotated[float, Field(gt=0, le=1000)]
_Seconds = Annotated[float, Field(gt=0, le=60)]


class ObstacleParameters(Section):
    """Parameters for the local map and for avoidance; braking and reaction are those of `safety.gate`."""

    enabled: bool = False
    """Whether obstacles are looked for and avoided. Without it trees and walls are seen, but not flown around."""
    range_m: _Metres = 15.0
    """Farther obstacles do not count, and cameras count as seeing no farther, whether obstacles are avoided or not."""
    height_band_m: _Metres = 0.75
    """What is higher or lower than the drone by more is no obstacle: room for its rotors and for errors in height."""
    below_m: _Metres = 1.5
    """Downwards it is this, if this is more: a tree's top may be too thin to be seen, and what is lower is not."""
    range_sigma: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Standard deviation of a range from the depth map, as a share of it."""
    min_pixels: Annotated[int, Field(ge=1, le=10_000)] = 4
    """So many of a sector's pixels, every fourth of each row and column, have to show an obstacle."""
    memory_s: _Seconds = 3.0
    """For how long what is not seen any more stays in the map: an obstacle, and that nobody is in a direction."""
    clearance_m: Annotated[float, Field(gt=0, le=20)] = 0.9
    """From the drone's middle to an obstacle's surface: nearer than this, away from it."""
    margin_m: Annotated[float, Field(ge=0, le=20)] = 0.5
    """Added to the clearance where there is room."""
    horizon_s: _Seconds = 3.0
    """A direction is free where nothing is met within this time, at the wanted speed; among neighbours at no more than
    theirs or 1.5 m/s."""
    sigmas: Annotated[float, Field(ge=0, le=10)] = 2.0
    """An obstacle counts as nearer than measured by so many standard deviations."""
