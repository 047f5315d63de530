"""The last gate: of what is asked for, what may be sent to the autopilot. Silent until allowed.

It is independent of pilot and networks: it checks every command, whatever produced it, and limits what it can do.
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
    neighbour_velocities: FloatArray
    """(n, 2) m/s over ground, north and east."""
    height_m: float
    """Of the drone, as in `VehicleState`; NaN: not known."""


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
_PARALLEL = 1e-6
"""Sine of the angle between two directions below which their limits are not combined."""

_COLUMN = 1.5
"""A neighbour is above or below where its level range is less than this many times the degraded separation: downwash
widens on its way down, and neither drone stays exactly where it is."""
_HEIGHT_NOISE_M = 0.3
"""Of a height over a few seconds: a difference this small between asked and own height is no climb."""

SAME_SPOT_M = 0.1
"""A neighbour whose level range is smaller is above or below, in no direction: cameras do not measure one that well."""

_MOVES = frozenset({Action.FLY, Action.FLY_DEGRADED})
_STANDS_STILL = frozenset({Action.OFFER, Action.HOVER, Action.ASK_HOLD, Action.ASK_RETURN, Action.ASK_LAND})


class Gate:
    """Passes each setpoint, makes it smaller, or sends nothing.

    A speed above the limit or a number that is not finite is refused: the drone is brought to a standstill instead.
    Towards a neighbour the drone flies no faster than it can brake before the minimum distance. Every change of
    velocity stays within the acceleration limit, except that this one, and no velocity outward beyond the fence, win.
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
                target = self._slowed(wanted.command.velocity, now_s - wanted.time_s, permission.action)
                if (target != wanted.command.velocity).any():
                    objections.append(Objection.SLOWED)
        velocity = self._within_acceleration(target, now_s, around)
        velocity = self._within_space(velocity, permission.action, around, objections)
        if not np.isfinite([*velocity, wanted.height_m, yaw_rad]).all():
            objections.append(Objection.SETPOINT_NOT_FINITE)
            return None
        height_m = self._within_climb(now_s, permission.action, wanted, around, objections)
        return Setpoint(now_s, velocity, self._within_heights(height_m, objections), yaw_rad)

    def _slowed(self, velocity: FloatArray, age_s: float, action: Action) -> FloatArray:
        """A command's velocity: slower once a newer command is missed, nothing when it is too old, slow if degraded."""
        p = self._parameters
        limit_m_s = p.degraded_speed_m_s if action is Action.FLY_DEGRADED else p.max_speed_m_s
        return _limited(self._share(age_s) * velocity, limit_m_s)

    def _share(self, age_s: float) -> float:
        """How much of a command is flown at its age: all while it is fresh, nothing at the time-out."""
        p = self._parameters
        return min((p.command_timeout_s - age_s) / (p.command_timeout_s - p.command_fresh_s), 1.0)

    def _accepts(self, command: VelocityCommand, around: Surroundings, objections: list[Objection]) -> bool:
        """Whether the command may move the drone at all."""
        refusals = (
            (
                Objection.COMMAND_NOT_FINITE,
                not (np.isfinite(command.velocity).all() and math.isfinite(command.yaw_rad)),
            ),
            (Objection.COMMAND_TOO_LARGE, math.hypot(*command.velocity) > self._parameters.max_speed_m_s),
            (Objection.POSITION_UNKNOWN, is_fenced(self._parameters) and not np.isfinite(around.position).all()),
            (
                Objection.NEIGHBOUR_UNKNOWN,
                not (np.isfinite(around.neighbours).all() and np.isfinite(around.neighbour_velocities).all()),
            ),
        )
        found = [objection for objection, holds in refusals if holds]
        objections.extend(found)
        return not found

    def _within_acceleration(self, target: FloatArray, now_s: float, around: Surroundings) -> FloatArray:
        """The velocity nearest to the target that can be reached from the last one sent, or else from the true one."""
        p, last = self._parameters, self._recent(now_s)
        if last is not None:
            start, elapsed_s = last.velocity, max(now_s - last.time_s, 0.0)
        elif np.isfinite(around.velocity).all():
            start, elapsed_s = _limited(around.velocity, p.max_speed_m_s), 0.0
        else:
            start, elapsed_s = np.zeros(2), 0.0
        return start + _limited(target - start, p.max_acceleration_m_s2 * elapsed_s)

    def _recent(self, now_s: float) -> Setpoint | None:
        """The last setpoint; None where that is too long ago to go on from it."""
        last = self._last
        return None if last is None or now_s - last.time_s > self._parameters.permission_timeout_s else last

    def _within_space(
        self, velocity: FloatArray, action: Action, around: Surroundings, objections: list[Objection]
    ) -> FloatArray:
        """The velocity without what leads farther out of the fence or too fast towards a neighbour."""
        p = self._parameters
        separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
        outward = _units(offsets_outside(p, around.position))
        towards, most_m_s = self._approaches(around, separation_m)
        limits = np.concatenate([np.zeros(len(outward)), most_m_s])
        for objection, directions, most in (
            (Objection.FENCE, outward, np.zeros(len(outward))),
            (Objection.SEPARATION, towards, most_m_s),
        ):
            if (directions @ velocity > most).any():
                objections.append(objection)
        return _within(velocity, np.concatenate([outward, towards]), limits)

    def _approaches(self, around: Surroundings, separation_m: float) -> tuple[FloatArray, FloatArray]:
        """For each neighbour about at the drone's height its direction, (n, 2), and how fast to fly there, (n,) m/s.

        Nearer than the separation: not at all. Farther, so fast that the distance left suffices if both brake, as in
        Shalev-Shwartz et al. 2017, "On a formal model of safe and scalable self-driving cars": with v towards a
        neighbour that comes at w (negative: goes), the drone's reaction time r and its braking b,
        (v + w) r + v^2 / 2b + w |w| / 2b <= distance left. The neighbour's gate may let it begin to come just now; so,
        but for following one that goes, this has to hold for w = v too.
        """
        p = self._parameters
        offsets = around.neighbours
        ranges = np.hypot(offsets[:, 0], offsets[:, 1])
        about_m = max(separation_m, p.vertical_separation_m)
        meets = (ranges >= SAME_SPOT_M) & (ranges < math.inf) & (np.abs(offsets[:, 2]) < about_m)
        offsets, ranges = offsets[meets], ranges[meets]
        towards = offsets[:, :2] / ranges[:, None]
        velocities = np.nan_to_num(around.neighbour_velocities[meets], posinf=0.0, neginf=0.0)
        comes = -np.clip(np.sum(velocities * towards, axis=1), -p.max_speed_m_s, p.max_speed_m_s)
        left_m = ranges - separation_m
        lag = p.braking_m_s2 * p.reaction_s
        square = lag**2 + 2 * p.braking_m_s2 * (left_m - comes * p.reaction_s) - comes * np.abs(comes)
        most_m_s = np.sqrt(np.maximum(square, lag**2)) - lag
        if_both_come = np.sqrt(lag**2 + p.braking_m_s2 * np.maximum(left_m, 0.0)) - lag
        most_m_s = np.minimum(most_m_s, np.maximum(if_both_come, -comes))
        return towards, np.where(left_m > 0, most_m_s, 0.0)

    def _within_climb(
        self, now_s: float, action: Action, wanted: Wanted, around: Surroundings, objections: list[Objection]
    ) -> float:
        """The height nearest to the one to hold that may be asked for now.

        It changes no faster than the limit, as much slower as the velocity of an old command, and not at all where the
        drone is to stand still in flight. It leads no nearer to a neighbour that is near above or below.
        """
        if action is Action.OFFER:  # on the ground, or flown by the pilot: as high as the control loop says
            return wanted.height_m
        last = self._recent(now_s)
        if last is not None:
            start_m, elapsed_s = last.height_m, max(now_s - last.time_s, 0.0)
        else:
            start_m, elapsed_s = (around.height_m if math.isfinite(around.height_m) else wanted.height_m), 0.0
        most_m = 0.0
        if action in _MOVES:
            most_m = self._parameters.max_climb_m_s * elapsed_s * self._share(now_s - wanted.time_s)
        height_m = start_m + min(max(wanted.height_m - start_m, -most_m), most_m)
        lowest_m, highest_m = self._between_neighbours(start_m, around)
        between_m = min(max(height_m, lowest_m), highest_m)
        if between_m != height_m:
            objections.append(Objection.SEPARATION)
        return between_m

    def _between_neighbours(self, start_m: float, around: Surroundings) -> tuple[float, float]:
        """From which height to which one may be asked for, from `start_m` on, where neighbours are above or below.

        A height that was asked for already, and from which the drone's own differs by noise only, stays. A drone that
        does not know its height counts as where it was asked to be.
        """
        p, offsets = self._parameters, around.neighbours
        own_m = around.height_m if math.isfinite(around.height_m) else start_m
        near = np.hypot(offsets[:, 0], offsets[:, 1]) < _COLUMN * p.degraded_separation_m
        up = -offsets[near, 2]
        room_up = np.maximum(up[up > 0] - p.vertical_separation_m, 0.0).min(initial=math.inf)
        room_down = np.maximum(-up[up < 0] - p.vertical_separation_m, 0.0).min(initial=math.inf)
        highest_m = max(own_m + float(room_up), min(start_m, own_m + _HEIGHT_NOISE_M))
        lowest_m = min(own_m - float(room_down), max(start_m, own_m - _HEIGHT_NOISE_M))
        return lowest_m, highest_m

    def _within_heights(self, height_m: float, objections: list[Objection]) -> float:
        within = min(max(height_m, self._parameters.min_height_m), self._parameters.max_height_m)
        if within != height_m:
            objections.append(Objection.HEIGHT)
        return within


def _within(velocity: FloatArray, directions: FloatArray, limits: FloatArray) -> FloatArray:
    """The nearest velocity whose part along each direction, (n, 2) of length 1, is within its limit, (n,), 0 or more.

    In the plane that is the velocity itself, or its foot on the line where one limit is reached, or the point where
    two such lines cross. Standstill always fits.
    """
    over = directions @ velocity - limits
    if (over <= 0).all():
        return velocity
    feet = velocity - over[:, None] * directions
    candidates = np.vstack([np.zeros(2), feet, _crossings(directions, limits)])
    fitting = candidates[np.max(candidates @ directions.T - limits, axis=1) <= _ROUNDING_M_S]
    nearest: FloatArray = fitting[np.argmin(np.linalg.norm(fitting - velocity, axis=1))]
    return nearest


def _crossings(directions: FloatArray, limits: FloatArray) -> FloatArray:
    """(m, 2): where two of the lines n . v = limit cross, for each two that are not parallel (Cramer's rule)."""
    i, j = np.triu_indices(len(directions), 1)
    a, b = directions[i], directions[j]
    determinants = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    cross = np.abs(determinants) > _PARALLEL
    a, b, c, d = a[cross], b[cross], limits[i][cross], limits[j][cross]
    crossings: FloatArray = (
        np.column_stack([c * b[:, 1] - d * a[:, 1], d * a[:, 0] - c * b[:, 0]]) / determinants[cross, None]
    )
    return crossings


def _units(vectors: FloatArray) -> FloatArray:
    """The vectors (n, 2) at length 1, without those of no length."""
    lengths = np.hypot(vectors[:, 0], vectors[:, 1])
    units: FloatArray = vectors[lengths > 0] / lengths[lengths > 0, None]
    return units


def _limited(vector: FloatArray, limit: float) -> FloatArray:
    """The vector itself if it is no longer than `limit`, else the one of that length in its direction."""
    length = math.hypot(*vector)
    return vector if length <= limit else vector * (limit / length)
