"""The last gate: of what is asked for, what may be sent to the autopilot. Silent until allowed.

It stands apart from all that is clever: it trusts neither the pilot nor the networks, and limits what both can do.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from flockd.config.safety import GateParameters
from flockd.messages import FloatArray, Setpoint, VelocityCommand
from flockd.safety.fence import is_fenced, offsets_outside
from flockd.safety.policy import Action


@dataclass(frozen=True)
class Permission:
    """What the supervisor said, and when."""

    action: Action
    time_s: float


@dataclass(frozen=True, eq=False)
class Wanted:
    """What the pilot's code asks for."""

    command: VelocityCommand | None
    """None before the first."""
    time_s: float
    """When the command was made."""
    height_m: float
    """To hold."""


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


class Objection(StrEnum):
    """Why something was not sent as it was asked for. The value is its name in counts."""

    NOT_ALLOWED = "not_allowed"
    PERMISSION_STALE = "permission_stale"
    COMMAND_STALE = "command_stale"
    SETPOINT_NOT_FINITE = "setpoint_not_finite"
    COMMAND_NOT_FINITE = "command_not_finite"
    COMMAND_TOO_LARGE = "command_too_large"
    POSITION_UNKNOWN = "position_unknown"
    NEIGHBOUR_UNKNOWN = "neighbour_unknown"
    SLOWED = "slowed"
    FENCE = "fence"
    HEIGHT = "height"
    SEPARATION = "separation"


@dataclass(frozen=True)
class Verdict:
    """What may be sent; None: nothing. And why it is not what was asked for."""

    setpoint: Setpoint | None
    objections: tuple[Objection, ...]


_ROUNDING_M_S = 1e-9

_MOVES = frozenset({Action.FLY, Action.FLY_DEGRADED})
_STANDS_STILL = frozenset({Action.OFFER, Action.HOVER, Action.ASK_HOLD, Action.ASK_RETURN, Action.ASK_LAND})


class Gate:
    """Passes each setpoint, makes it smaller, or sends nothing.

    A speed above the limit or a number that is not finite is refused: the drone is brought to a standstill instead.
    Every change of velocity stays within the acceleration limit, except that towards a neighbour too near, or outward
    beyond the fence, nothing is sent at all.
    """

    def __init__(self, parameters: GateParameters) -> None:
        self._parameters = parameters
        self._last: Setpoint | None = None
        self.counts: Counter[Objection] = Counter()
        """Objections since the start."""

    def step(self, now_s: float, permission: Permission, wanted: Wanted, around: Surroundings) -> Verdict:
        """What may be sent at `now_s`, on the clock of the other times; never raises, whatever the numbers are."""
        objections: list[Objection] = []
        self._last = self._setpoint(now_s, permission, wanted, around, objections)
        self.counts.update(objections)
        return Verdict(self._last, tuple(objections))

    def _setpoint(
        self, now_s: float, permission: Permission, wanted: Wanted, around: Surroundings, objections: list[Objection]
    ) -> Setpoint | None:
        if permission.action not in _MOVES | _STANDS_STILL:
            objections.append(Objection.NOT_ALLOWED)
            return None
        if not abs(now_s - permission.time_s) <= self._parameters.permission_timeout_s:
            objections.append(Objection.PERMISSION_STALE)
            return None
        yaw_rad = self._last.yaw_rad if self._last is not None else around.yaw_rad
        target = np.zeros(2)
        if permission.action in _MOVES:
            if wanted.command is None or not abs(now_s - wanted.time_s) <= self._parameters.command_timeout_s:
                objections.append(Objection.COMMAND_STALE)
                return None
            if math.isfinite(wanted.command.yaw_rad):
                yaw_rad = wanted.command.yaw_rad
            if self._accepts(wanted.command, around, objections):
                target = wanted.command.velocity
            if permission.action is Action.FLY_DEGRADED and math.hypot(*target) > self._parameters.degraded_speed_m_s:
                target = _limited(target, self._parameters.degraded_speed_m_s)
                objections.append(Objection.SLOWED)
        velocity = self._within_acceleration(target, now_s, around)
        velocity = self._within_space(velocity, permission.action, around, objections)
        if not np.isfinite([*velocity, wanted.height_m, yaw_rad]).all():
            objections.append(Objection.SETPOINT_NOT_FINITE)
            return None
        return Setpoint(now_s, velocity, self._within_heights(wanted.height_m, objections), yaw_rad)

    def _accepts(self, command: VelocityCommand, around: Surroundings, objections: list[Objection]) -> bool:
        """Whether the command may move the drone at all."""
        refusals = (
            (
                Objection.COMMAND_NOT_FINITE,
                not (np.isfinite(command.velocity).all() and math.isfinite(command.yaw_rad)),
            ),
            (Objection.COMMAND_TOO_LARGE, math.hypot(*command.velocity) > self._parameters.max_speed_m_s),
            (Objection.POSITION_UNKNOWN, is_fenced(self._parameters) and not np.isfinite(around.position).all()),
            (Objection.NEIGHBOUR_UNKNOWN, not np.isfinite(around.neighbours).all()),
        )
        found = [objection for objection, holds in refusals if holds]
        objections.extend(found)
        return not found

    def _within_acceleration(self, target: FloatArray, now_s: float, around: Surroundings) -> FloatArray:
        """The velocity nearest to the target that can be reached from the last one sent, or else from the true one."""
        p = self._parameters
        if self._last is not None and now_s - self._last.time_s <= p.permission_timeout_s:
            start, elapsed_s = self._last.velocity, max(now_s - self._last.time_s, 0.0)
        elif np.isfinite(around.velocity).all():
            start, elapsed_s = _limited(around.velocity, p.max_speed_m_s), 0.0
        else:
            start, elapsed_s = np.zeros(2), 0.0
        return start + _limited(target - start, p.max_acceleration_m_s2 * elapsed_s)

    def _within_space(
        self, velocity: FloatArray, action: Action, around: Surroundings, objections: list[Objection]
    ) -> FloatArray:
        """The velocity without what leads farther out of the fence or towards a neighbour too near."""
        p = self._parameters
        separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
        near = around.neighbours[np.linalg.norm(around.neighbours, axis=1) < separation_m, :2]
        outward, towards = _units(offsets_outside(p, around.position)), _units(near)
        for objection, directions in ((Objection.FENCE, outward), (Objection.SEPARATION, towards)):
            if (directions @ velocity > 0).any():
                objections.append(objection)
        return _without(velocity, np.concatenate([outward, towards]))

    def _within_heights(self, height_m: float, objections: list[Objection]) -> float:
        within = min(max(height_m, self._parameters.min_height_m), self._parameters.max_height_m)
        if within != height_m:
            objections.append(Objection.HEIGHT)
        return within


def _without(velocity: FloatArray, directions: FloatArray) -> FloatArray:
    """The nearest velocity that has no part along any of the directions, (n, 2) of length 1; standstill always fits.

    In the plane that is the velocity itself, or it with its part along one direction taken away, or zero.
    """
    along = directions @ velocity
    if (along <= 0).all():
        return velocity
    candidates = np.vstack([np.zeros(2), velocity - along[:, None] * directions])
    fitting = candidates[np.max(candidates @ directions.T, axis=1) <= _ROUNDING_M_S]
    nearest: FloatArray = fitting[np.argmax(np.linalg.norm(fitting, axis=1))]  # of such projections, the longest
    return nearest


def _units(vectors: FloatArray) -> FloatArray:
    """The vectors (n, 2) at length 1, without those of no length: straight above or below is in no direction."""
    somewhere = vectors[np.any(vectors != 0, axis=1)]
    units: FloatArray = somewhere / np.linalg.norm(somewhere, axis=1, keepdims=True)
    return units


def _limited(vector: FloatArray, limit: float) -> FloatArray:
    """The vector itself if it is no longer than `limit`, else the one of that length in its direction."""
    length = math.hypot(*vector)
    return vector if length <= limit else vector * (limit / length)
