"""The last gate: of what is asked for, what may be sent to the autopilot. Silent until allowed.

It is independent of pilot and networks: it checks every command, whatever produced it, and limits what it can do.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.geometry.level import limit_norm
from flockd.flight.safety.approach import towards_neighbours, towards_obstacles
from flockd.flight.safety.fence import outside_fence, towards_fence
from flockd.flight.safety.half_planes import nearest_within
from flockd.flight.safety.policy import Action
from flockd.flight.safety.response import ResponseMonitor


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
    obstacles: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """(m, 2) metres, north and east, relative to the drone: points of obstacles, each the nearest that it may be."""
    neighbour_margins: FloatArray | None = None
    """(n, 2) by how much each neighbour may be nearer, m, and come faster, m/s; None: exact."""
    neighbour_unseen_s: FloatArray | None = None
    """(n,) how long ago each neighbour was seen last: it may brake since; None: each flies as it is said to."""

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


@dataclass(frozen=True)
class Verdict:
    """What may be sent; None: nothing. And why it is not what was asked for."""

    setpoint: Setpoint | None
    objections: tuple[Objection, ...]


COLUMN = 1.5
"""A neighbour is above or below where its level range is less than this many times the degraded separation: downwash
widens on its way down, and neither drone stays exactly where it is."""
_HEIGHT_NOISE_M = 0.3
"""Noise of a height over a few seconds: a difference this small between asked and own height is no climb."""

_MOVES = frozenset({Action.FLY, Action.FLY_DEGRADED})
_STANDS_STILL = frozenset({Action.OFFER, Action.HOVER, Action.ASK_HOLD, Action.ASK_RETURN, Action.ASK_LAND})


class Gate:
    """Passes each setpoint, makes it smaller, or sends nothing.

    A speed above the limit or a number that is not finite is refused: the drone is brought to a standstill instead.
    Towards a neighbour, an obstacle or the fence the drone flies no faster than it can brake before the minimum
    distance. Every change of velocity stays within the acceleration limit, except that this one wins.

    Wind is left to the autopilot, whose velocity controller integrates: a second loop around it, here, oscillated with
    PX4's real response. A drone that is measured to be faster than a limit brakes harder; one that is measured to
    follow late keeps the distance that it then needs, and one that does not follow (`ResponseMonitor`) is for the
    supervisor.
    """

    def __init__(self, parameters: GateParameters) -> None:
        self._parameters = parameters
        self._last: Setpoint | None = None
        self._response = ResponseMonitor(parameters.reaction_s)
        self.counts: Counter[Objection] = Counter()
        """Objections since the start."""

    @property
    def velocity_error_m_s(self) -> float:
        """By how much the drone's velocity was off its setpoints in the last seconds; see `ResponseMonitor`."""
        return self._response.error_m_s

    @property
    def velocity_late_s(self) -> float:
        """By how much later than expected it follows them; see `ResponseMonitor`."""
        return self._response.late_s

    def step(self, now_s: float, request: Request) -> Verdict:
        """What may be sent at `now_s`, on the clock of the other times; never raises, whatever the numbers are."""
        objections: list[Objection] = []
        last, measured = self._recent(now_s), request.around.velocity
        if last is None or request.permission.action is Action.OFFER:
            self._response.restart(measured)
        else:
            self._response.step(measured, last.velocity, now_s - last.time_s)
        self._last = self._setpoint(now_s, request, objections)
        self.counts.update(objections)
        return Verdict(self._last, tuple(objections))

    def _setpoint(self, now_s: float, request: Request, objections: list[Objection]) -> Setpoint | None:
        permission, wanted, around = request.permission, request.wanted, request.around
        if permission.action not in _MOVES | _STANDS_STILL:
            objections.append(Objection.NOT_ALLOWED)
            return None
        if not abs(now_s - permission.time_s) <= self._parameters.permission_timeout_s:
            objections.append(Objection.PERMISSION_STALE)
            return None
        yaw_rad = self._last.yaw_rad if self._last is not None else around.yaw_rad
        target = np.zeros(2)
        if permission.action in _MOVES:
            if not abs(now_s - request.wanted_s) <= self._parameters.command_timeout_s:
                objections.append(Objection.COMMAND_STALE)
                return None
            if wanted.yaw_rad is not None and math.isfinite(wanted.yaw_rad):
                yaw_rad = wanted.yaw_rad
            elif wanted.yaw_rad is not None:
                objections.append(Objection.HEADING_NOT_FINITE)
            if self._accepts(wanted, around, objections):
                slowed = self._slowed(wanted.velocity, now_s - request.wanted_s, permission.action)
                target = limit_norm(slowed, request.fastest_m_s)
                if (target != wanted.velocity).any():
                    objections.append(Objection.SLOWED)
        if permission.action is Action.OFFER:  # whatever flies it: the takeover begins at the velocity that it has
            self._last = None
        velocity = self._within_acceleration(target, now_s, around)
        sent = self._within_space(velocity, permission.action, around, objections)
        wanted_m = request.height_m if wanted.height_m is None else wanted.height_m
        if not all(map(math.isfinite, (*sent, wanted_m, yaw_rad))):
            objections.append(Objection.SETPOINT_NOT_FINITE)
            return None
        height_m = self._within_climb(now_s, wanted_m, request, objections)
        return Setpoint(now_s, sent, self._within_heights(height_m, objections), yaw_rad)

    def _slowed(self, velocity: FloatArray, age_s: float, action: Action) -> FloatArray:
        """A command's velocity: slower once a newer command is missed, nothing when it is too old, slow if degraded."""
        p = self._parameters
        limit_m_s = p.degraded_speed_m_s if action is Action.FLY_DEGRADED else p.max_speed_m_s
        return limit_norm(self._share(age_s) * velocity, limit_m_s)

    def _share(self, age_s: float) -> float:
        """How much of a command is flown at its age: all while it is fresh, nothing at the time-out."""
        p = self._parameters
        return min((p.command_timeout_s - age_s) / (p.command_timeout_s - p.command_fresh_s), 1.0)

    def _accepts(self, wanted: Wanted, around: Surroundings, objections: list[Objection]) -> bool:
        """Whether what is wanted may move the drone at all."""
        refusals = (
            (Objection.COMMAND_NOT_FINITE, not all(map(math.isfinite, wanted.velocity))),
            (Objection.COMMAND_TOO_LARGE, math.hypot(*wanted.velocity) > self._parameters.max_speed_m_s),
            (
                Objection.POSITION_UNKNOWN,
                outside_fence(self._parameters, around.position) and not np.isfinite(around.position).all(),
            ),
            (
                Objection.NEIGHBOUR_UNKNOWN,
                not (np.isfinite(around.neighbours).all() and np.isfinite(around.neighbour_velocities).all()),
            ),
            (
                Objection.NEIGHBOUR_UNKNOWN,
                around.neighbour_margins is not None and not (around.neighbour_margins > -math.inf).all(),
            ),
            (Objection.OBSTACLE_UNKNOWN, not np.isfinite(around.obstacles).all()),
        )
        found = [objection for objection, holds in refusals if holds]
        objections.extend(found)
        return not found

    def _within_acceleration(self, target: FloatArray, now_s: float, around: Surroundings) -> FloatArray:
        """The velocity nearest to the target that can be reached from the last one, or else from the measured one."""
        p, last = self._parameters, self._recent(now_s)
        if last is not None:
            start, elapsed_s = last.velocity, max(now_s - last.time_s, 0.0)
        elif np.isfinite(around.velocity).all():
            start, elapsed_s = limit_norm(around.velocity, p.max_speed_m_s), 0.0
        else:
            start, elapsed_s = np.zeros(2), 0.0
        return start + limit_norm(target - start, p.max_acceleration_m_s2 * elapsed_s)

    def _recent(self, now_s: float) -> Setpoint | None:
        """The last setpoint; None where that is too long ago to go on from it."""
        last = self._last
        return None if last is None or now_s - last.time_s > self._parameters.permission_timeout_s else last

    def _space(self, action: Action, around: Surroundings) -> dict[Objection, tuple[FloatArray, FloatArray]]:
        """Directions (n, 2), and how fast to fly there, (n,) m/s: to the fence, to neighbours and to obstacles."""
        p, late_s = self._parameters, self._response.late_s
        later = {"reaction_s": p.reaction_s + late_s, "neighbour_reaction_s": p.neighbour_reaction_s + late_s}
        p = p.model_copy(update=later)
        separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
        return {
            Objection.FENCE: towards_fence(p, around.position),
            Objection.SEPARATION: towards_neighbours(
                p,
                around.neighbours,
                around.neighbour_velocities,
                separation_m,
                around.neighbour_margins,
                around.neighbour_unseen_s,
            ),
            Objection.OBSTACLE: towards_obstacles(
                around.obstacles, p.obstacle_clearance_m, p.braking_m_s2, p.reaction_s
            ),
        }

    def _within_space(
        self, velocity: FloatArray, action: Action, around: Surroundings, objections: list[Objection]
    ) -> FloatArray:
        """The velocity, (2,) m/s, without what leads too fast anywhere.

        A drone that is measured to be faster than a limit has to brake: the limit counts as lower by as much. That
        feeds the velocity back with a gain of one, which no lag and no dead time make unstable.
        """
        limits = self._space(action, around)
        directions = np.concatenate([towards for towards, _ in limits.values()])
        most_m_s = np.concatenate([most for _, most in limits.values()])
        names = np.repeat(np.arange(len(limits)), [len(most) for _, most in limits.values()])
        if np.isfinite(around.velocity).all():
            most_m_s = np.maximum(most_m_s - np.maximum(directions @ around.velocity - most_m_s, 0.0), 0.0)
        over = directions @ velocity > most_m_s
        objections.extend(list(limits)[i] for i in np.unique(names[over]))
        return nearest_within(velocity, directions, most_m_s)

    def _within_climb(self, now_s: float, wanted_m: float, request: Request, objections: list[Objection]) -> float:
        """The height nearest to the one to hold that may be asked for now.

        It changes no faster than the limit, as much slower as the velocity of an old command, and not at all where the
        drone is to stand still in flight. It leads no nearer to a neighbour that is near above or below.
        """
        action, around = request.permission.action, request.around
        if action is Action.OFFER:  # on the ground, or flown by the pilot: as high as the control loop says
            return wanted_m
        last = self._recent(now_s)
        if last is not None:
            start_m, elapsed_s = last.height_m, max(now_s - last.time_s, 0.0)
        else:
            start_m, elapsed_s = (around.height_m if math.isfinite(around.height_m) else wanted_m), 0.0
        most_m = 0.0
        if action in _MOVES:
            most_m = self._parameters.max_climb_m_s * elapsed_s * self._share(now_s - request.wanted_s)
        height_m = start_m + min(max(wanted_m - start_m, -most_m), most_m)
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
        near = np.hypot(offsets[:, 0], offsets[:, 1]) < COLUMN * p.degraded_separation_m
        if not near.any():
            return -math.inf, math.inf
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
