"""The last gate before the autopilot: limits each requested setpoint, or sends nothing. Silent until permitted.

It is independent of pilot and networks: it checks every command, whatever produced it.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import Setpoint, Wanted
from flockd.flight.geometry.level import limit_norm
from flockd.flight.safety.approach import between_neighbours
from flockd.flight.safety.fence import outside_fence
from flockd.flight.safety.half_planes import nearest_within
from flockd.flight.safety.policy import Action
from flockd.flight.safety.request import Objection, Request, Surroundings, Verdict
from flockd.flight.safety.response import ResponseMonitor
from flockd.flight.safety.surroundings import into_the_unseen, limits_around

_MOVES = frozenset({Action.FLY, Action.FLY_DEGRADED})


class Gate:
    """Passes each setpoint, reduces it, or sends nothing.

    A speed above the limit or a number that is not finite is refused: the drone is brought to a standstill instead.
    Towards a neighbour, an obstacle or the fence, and into sectors that no camera has seen, the drone flies no faster
    than it can brake before the minimum distance. Every change of velocity is within the acceleration limit, unless
    braking needs more.

    Wind is left to the autopilot, whose velocity controller integrates: a second loop around it, here, oscillated with
    PX4's real response. A drone measured to be faster than a limit brakes harder; one that follows late keeps the
    distance that it then needs; the supervisor handles one that does not follow (`ResponseMonitor`).
    """

    def __init__(self, parameters: GateParameters) -> None:
        self._parameters = parameters
        self._last: Setpoint | None = None
        self.response = ResponseMonitor(parameters.reaction_s)
        """How well, and how late, the drone follows its setpoints."""
        self.counts: Counter[Objection] = Counter()
        """Objections since the start."""

    def step(self, now_s: float, request: Request) -> Verdict:
        """The setpoint at `now_s`, on the clock of the other times; never raises, whatever the numbers are."""
        last, measured = self._last, request.around.velocity
        if last is not None and now_s - last.time_s > self._parameters.permission_timeout_s:
            last = None  # too old to continue from
        if request.permission.action is Action.OFFER:  # the takeover starts at the drone's own velocity and height
            last = None
        if last is None:
            self.response.restart(measured)
        else:
            self.response.step(measured, last.velocity, now_s - last.time_s)
        refusal = self._refusal(now_s, request)
        verdict = self._limited(now_s, request, last) if refusal is None else Verdict(None, (refusal,))
        self._last = verdict.setpoint
        self.counts.update(verdict.objections)
        return verdict

    def _refusal(self, now_s: float, request: Request) -> Objection | None:
        """Why no setpoint may be sent; None: one may."""
        p, permission = self._parameters, request.permission
        if permission.action is Action.SILENCE:
            return Objection.NOT_ALLOWED
        if not abs(now_s - permission.time_s) <= p.permission_timeout_s:
            return Objection.PERMISSION_STALE
        if permission.action in _MOVES and not abs(now_s - request.wanted_s) <= p.command_timeout_s:
            return Objection.COMMAND_STALE
        return None

    def _limited(self, now_s: float, request: Request, last: Setpoint | None) -> Verdict:
        """The setpoint nearest to the wanted one, or to standstill, that the limits permit after the last one."""
        p, action, wanted, around = self._parameters, request.permission.action, request.wanted, request.around
        height_m = request.height_m if wanted.height_m is None else wanted.height_m
        start = last or self._as_it_flies(now_s, around, height_m)
        elapsed_s = max(now_s - start.time_s, 0.0)
        target, yaw_rad, share = np.zeros(2), start.yaw_rad, 0.0
        objections: list[Objection] = []
        if action in _MOVES:
            age_s = now_s - request.wanted_s  # slower once a newer command is due, zero at the time-out
            share = min((p.command_timeout_s - age_s) / (p.command_timeout_s - p.command_fresh_s), 1.0)
            if wanted.yaw_rad is not None and math.isfinite(wanted.yaw_rad):
                yaw_rad = wanted.yaw_rad
            elif wanted.yaw_rad is not None:
                objections.append(Objection.HEADING_NOT_FINITE)
            faults = self._faults(wanted, around)
            objections.extend(faults)
            if not faults:
                limit_m_s = p.degraded_speed_m_s if action is Action.FLY_DEGRADED else p.max_speed_m_s
                target = limit_norm(share * wanted.velocity, min(limit_m_s, request.fastest_m_s))
                if (target != wanted.velocity).any():
                    objections.append(Objection.SLOWED)

        velocity = start.velocity + limit_norm(target - start.velocity, p.max_acceleration_m_s2 * elapsed_s)
        separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
        directions, most_m_s, there = limits_around(p, around, separation_m, self.response.late_s)
        objections.extend(dict.fromkeys(there[i] for i in (directions @ velocity > most_m_s).nonzero()[0]))
        velocity = nearest_within(velocity, directions, most_m_s)
        if not all(map(math.isfinite, (*velocity, height_m, yaw_rad))):
            return Verdict(None, (*objections, Objection.SETPOINT_NOT_FINITE))
        seen = limit_norm(velocity, into_the_unseen(p, around, separation_m, self.response.late_s, velocity))
        if (seen != velocity).any():
            objections.append(Objection.UNSEEN)

        most_m = p.max_climb_m_s * elapsed_s * share
        climbed_m = _within(height_m, start.height_m - most_m, start.height_m + most_m)
        height_m = _within(climbed_m, *between_neighbours(p, start.height_m, around.height_m, around.neighbours))
        if height_m != climbed_m:
            objections.append(Objection.SEPARATION)
        sent_m = _within(height_m, p.min_height_m, p.max_height_m)
        if sent_m != height_m:
            objections.append(Objection.HEIGHT)
        return Verdict(Setpoint(now_s, seen, sent_m, yaw_rad), tuple(objections))

    def _as_it_flies(self, now_s: float, around: Surroundings, height_m: float) -> Setpoint:
        """The start without a last setpoint: the drone's own velocity, height and heading, as far as they are known."""
        own = around.velocity if np.isfinite(around.velocity).all() else np.zeros(2)
        own_m = around.height_m if math.isfinite(around.height_m) else height_m
        return Setpoint(now_s, limit_norm(own, self._parameters.max_speed_m_s), own_m, around.yaw_rad)

    def _faults(self, wanted: Wanted, around: Surroundings) -> list[Objection]:
        """Why the wanted velocity may not move the drone at all."""
        p, neighbours = self._parameters, np.hstack([around.neighbours, around.neighbour_velocities])
        known = np.isfinite(neighbours).all() and (around.neighbour_margins > -math.inf).all()
        faults = (
            (Objection.COMMAND_NOT_FINITE, not np.isfinite(wanted.velocity).all()),
            (Objection.COMMAND_TOO_LARGE, math.hypot(*wanted.velocity) > p.max_speed_m_s),
            (Objection.POSITION_UNKNOWN, outside_fence(p, around.position) and not np.isfinite(around.position).all()),
            (Objection.NEIGHBOUR_UNKNOWN, not known),
            (Objection.OBSTACLE_UNKNOWN, not np.isfinite(around.obstacles).all()),
        )
        return [objection for objection, holds in faults if holds]


def _within(value: float, lowest: float, highest: float) -> float:
    return min(max(value, lowest), highest)
