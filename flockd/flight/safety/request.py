"""Inputs and outputs of the gate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.safety.policy import Action


@dataclass(frozen=True)
class Permission:
    """A decision of the supervisor, and its time."""

    action: Action
    time_s: float


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The drone's state, its neighbours and obstacles."""

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
    """(m, 2) metres, north and east, relative to the drone: the nearest possible points of obstacles."""
    neighbour_margins: FloatArray
    """(n, 2) how much nearer, m, and how much faster in approach, m/s, each neighbour may be."""
    neighbour_unseen_s: FloatArray
    """(n,) time since each neighbour was last seen: it may brake since then."""
    seen_m: FloatArray
    """(SECTORS,) metres: range of sight lately; beyond it there may be a drone."""

    @property
    def nearest_obstacle_m(self) -> float:
        """Range of the nearest obstacle; infinite without one."""
        return float(np.hypot(*self.obstacles.T).min(initial=math.inf))


@dataclass(frozen=True, eq=False)
class Request:
    """All inputs of the gate, as of one tick of the control loop."""

    permission: Permission
    wanted: Wanted
    wanted_s: float
    """When `wanted` was computed, on the permission's clock."""
    height_m: float
    """The height to hold if `wanted` gives none."""
    around: Surroundings
    fastest_m_s: float = math.inf
    """The autopilot's own speed limit for setpoints."""


class Objection(StrEnum):
    """Why a setpoint was not sent as requested. The value is its name in counts."""

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
    """The permitted setpoint, or None, and why it differs from the request."""

    setpoint: Setpoint | None
    objections: tuple[Objection, ...]
