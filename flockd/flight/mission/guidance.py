"""A mission's inputs and outputs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from flockd.core.messages import FloatArray, MissionOrder
from flockd.core.navigation import wrapped

SLOW_DOWN_S = 2.0
"""Near the last goal, the speed is at most the distance left over this."""
_COURSE_M_S = 0.2
"""A slower velocity has no course."""


@dataclass(frozen=True, eq=False)
class Moment:
    """The inputs of a mission in one step."""

    time_s: float
    """Time since the mission began."""
    position: FloatArray | None = None
    """(2,) metres north and east of home; None: not known."""
    middle: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) metres north and east from the drone to the centroid of itself and its neighbours."""
    home_deg: FloatArray | None = None
    """(2,) latitude and longitude of home; None: not known."""
    order: MissionOrder | None = None
    """An operator's new order; None: no new one."""
    heading_rad: float | None = None
    """The heading commanded last, clockwise from north; None: not known."""

    @property
    def flock(self) -> FloatArray | None:
        """(2,) metres north and east of home: the centroid of the visible flock."""
        return None if self.position is None else self.position + self.middle


@dataclass(frozen=True, eq=False)
class Guidance:
    """The outputs of a mission in one step."""

    velocity: FloatArray
    """(2,) m/s north and east: efv of Eq. 42."""
    sentence: str
    """What the mission does, for people."""
    course_rad: float | None = None
    """Heading, clockwise from north, `wrapped`; None: unchanged."""
    height_m: float | None = None
    """Height above home; None: unchanged."""
    goal: FloatArray | None = None
    """(2,) metres north and east of home; None: the mission has no goal."""
    arrived: bool = False
    """Whether the drone is at the last goal."""
    takeover: Literal["land", "return"] | None = None
    """The autopilot's mode at the end of the mission; None: it has not ended."""

    def __post_init__(self) -> None:
        if self.course_rad is not None:
            object.__setattr__(self, "course_rad", wrapped(self.course_rad))


class Mission(Protocol):
    """One kind of mission."""

    def step(self, moment: Moment) -> Guidance:
        """The guidance at a moment; called in order of time."""


def course_of(velocity: FloatArray) -> float | None:
    """Direction of a velocity (2,), radians clockwise from north; None if it is too slow."""
    return math.atan2(velocity[1], velocity[0]) if math.hypot(*velocity) > _COURSE_M_S else None


def towards(goal: FloatArray, here: FloatArray, speed_m_s: float, *, stops: bool) -> FloatArray:
    """The velocity, (2,) m/s, from `here` to `goal`; `stops`: slows down near it and stops there."""
    way = goal - here
    distance_m = math.hypot(*way)
    if stops:
        speed_m_s = min(speed_m_s, distance_m / SLOW_DOWN_S)
    return way * (speed_m_s / distance_m) if distance_m > 0 else np.zeros(2)
