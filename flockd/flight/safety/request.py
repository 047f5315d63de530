"""What the gate is asked, and what it answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.safety.policy import Action


@dataclass(frozen=True)
class Permission:
    """What the supervisor said, and when."""

    action: Action
    time_s: float


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Where the drone is, and who is near."""

    position: FloatArray
    """(2,) metres north and east of home."""
    velocity: FloatArray
    """(2,) m/s, north and east."""
    yaw_rad: float
    neighbours: FloatArray
    """(n, 3) metres, NED, relative to the drone."""
    neighbour_velocities: FloatArray
    """(n, 2) m/s over ground, north and east."""
    height_m: float
    """Height of the drone, as in `VehicleState`; NaN: not known."""
    obstacles: FloatArray
    """(m, 2) metres, north and east, relative to the drone: points of obstacles, each the nearest that it may be."""
    neighbour_margins: FloatArray
    """(n, 2) by how much each neighbour may be nearer, m, and come faster, m/s."""
    neighbour_unseen_s: FloatArray
    """(n,) how long ago each neighbour was seen last: it may brake since."""
    seen_m: FloatArray
    """(SECTORS,) metres: how far cameras looked lately; farther in a sector there may be anybody."""

    @property
    def nearest_obstacle_m(self) -> float:
        """Range of the nearest obstacle; infinite without one."""
        return float(np.hypot(*self.obstacles.T).min(initial=math.inf))


@dataclass(frozen=True, eq=False)
class Request:
    """All that the gate judges, as of one tick of the control loop."""

    permission: Permission
    wanted: Wanted
    wanted_s: float
    """When `wanted` was made, on the permission's clock."""
    height_m: float
    """To hold where `wanted` names no height."""
    around: Surroundings
    fastest_m_s: float = math.inf
    """The speed that the autopilot itself limits setpoints to."""


class Objection(StrEnum):
    """Why something was not sent as it was asked for. The value is its name in counts."""

    NOT_ALLOWED = "not_allowed"
    PERMISSION_STALE = "permission_stale"
    COMMAND_STALE = "command_stale"
    SETPOINT_NOT_FINITE = "setpoint_not_finite"
    COMMAND_NOT_FINITE = "command_not_finite"
    COMMAND_TOO_LARGE = "command_too_large"
    HEADING_NOT_FINITE = "heading_not_finite"
    POSITION_UNKNOWN = "position_unknown"
    NEIGHBOUR_UNKNOWN = "neighbour_unknown"
    OBSTACLE_UNKNOWN = "obstacle_unknown"
    SLOWED = "slowed"
    FENCE = "fence"
    HEIGHT = "height"
    SEPARATION = "separation"
    OBSTACLE = "obstacle"
    UNSEEN = "unseen"


@dataclass(frozen=True)
class Verdict:
    """What may be sent; None: nothing. And why it is not what was asked for."""

    setpoint: Setpoint | None
    objections: tuple[Objection, ...]
