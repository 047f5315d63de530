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
    """Obstacles beyond this do not count, and cameras are taken to see no farther, whether obstacles are avoided or
    not."""
    height_band_m: _Metres = 0.75
    """Obstacles more than this above or below the drone do not count: room for its rotors and for errors in height."""
    below_m: _Metres = 1.5
    """Instead, downwards, if it is more: a tree's top may be too thin to be seen, lower down it is wider."""
    range_sigma: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Standard deviation of a range from the depth map, as a share of it."""
    min_pixels: Annotated[int, Field(ge=1, le=10_000)] = 4
    """Pixels of a sector that have to show an obstacle, of every fourth of each row and column."""
    memory_s: _Seconds = 3.0
    """How long the map keeps what is no longer seen: an obstacle, and that a direction was empty."""
    clearance_m: Annotated[float, Field(gt=0, le=20)] = 0.9
    """From the drone's middle to an obstacle's surface: nearer than this, it flies away from it."""
    margin_m: Annotated[float, Field(ge=0, le=20)] = 0.5
    """Added to the clearance where there is room."""
    horizon_s: _Seconds = 3.0
    """A direction is free where nothing is met within this time, at the wanted speed; with neighbours near, at theirs
    or 1.5 m/s at most."""
    sigmas: Annotated[float, Field(ge=0, le=10)] = 2.0
    """An obstacle counts as nearer than measured by this many standard deviations."""
