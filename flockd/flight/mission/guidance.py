"""A mission's inputs and outputs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from flockd.core.messages import FloatArray, MissionOrder
from flockd.core.navigation import wrapped

SLOW_DOWN_S = 2.0
"""The way to the last goal is flown no faster than the distance left over this."""
_COURSE_M_S = 0.2
"""Slower than this is in no particular direction."""


@dataclass(frozen=True, eq=False)
class Moment:
    """The inputs of a mission in one step."""

    time_s: float
    """Since the mission began."""
    position: FloatArray | None = None
    """(2,) metres north and east of home; None: not known."""
    middle: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) metres north and east from the drone to the middle of it and of the neighbours that it sees."""
    home_deg: FloatArray | None = None
    """(2,) latitude and longitude; None: not known."""
    order: MissionOrder | None = None
    """An operator's, where a new one came."""

    @property
    def flock(self) -> FloatArray | None:
        """(2,) metres north and east of home: the middle of the flock, as far as it is seen."""
        return None if self.position is None else self.position + self.middle


@dataclass(frozen=True, eq=False)
class Guidance:
    """The outputs of a mission in one step."""

    velocity: FloatArray
    """(2,) m/s north and east: efv of Eq. 42."""
    sentence: str
    """What it does, for people."""
    course_rad: float | None = None
    """Heading to fly with, clockwise from north, `wrapped`; None: as before."""
    height_m: float | None = None
    """Above the ground at home; None: as before."""
    goal: FloatArray | None = None
    """(2,) metres north and east of home; None: the mission has no goal."""
    arrived: bool = False
    """At the last goal."""
    takeover: Literal["land", "return"] | None = None
    """The mode to ask the autopilot for at the end of the mission."""

    def __post_init__(self) -> None:
        if self.course_rad is not None:
            object.__setattr__(self, "course_rad", wrapped(self.course_rad))


class Mission(Protocol):
    """One kind of mission."""

    def step(self, moment: Moment) -> Guidance:
        """What it wants now; called in order of time."""


def course_of(velocity: FloatArray) -> float | None:
    """Direction of a velocity (2,), radians clockwise from north; None for hardly any."""
    return math.atan2(velocity[1], velocity[0]) if math.hypot(*velocity) > _COURSE_M_S else None


def towards(goal: FloatArray, here: FloatArray, speed_m_s: float, *, stops: bool) -> FloatArray:
    """The velocity, (2,) m/s, from `here` to `goal`; `stops`: slower near it, and none at it."""
    way = goal - here
    distance_m = math.hypot(*way)
    if stops:
        speed_m_s = min(speed_m_s, distance_m / SLOW_DOWN_S)
    return way * (speed_m_s / distance_m) if distance_m > 0 else np.zeros(2)
