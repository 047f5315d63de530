"""How drones pass each other: the velocity nearest to the law's that keeps the separation distance from all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.flocking.law import FlockingLaw, level_offsets, lookahead_s
from flockd.flight.geometry.level import SAME_SPOT_M
from flockd.flight.safety.half_planes import NO_LIMITS, ROUNDING_M_S, Limits, crossings

HORIZON_S = 2.5
"""Time within which a conflict with a neighbour is resolved: five steps of the paper's pilot."""
_SHARE = 0.5
"""Share of the needed change of velocity that each of two drones makes. If the other makes none, each next step makes
half of the rest. If the conflict with an approaching drone is within the horizon, the drone makes the whole change."""
_HEAD_ON_RAD = 0.1
"""Angle of a miss below which an encounter is head-on: each drone turns to its right, as aircraft do (ICAO Annex 2,
Rules of the Air, 3.2.2.2)."""
_COMES_M_S, _COMES_S = 0.5, 2 * HORIZON_S
"""Least closing speed of a neighbour that the drone sidesteps instead of backing off, and time within which it would be
too near."""

_Plane = tuple[FloatArray, float, float]
"""A half-plane of velocities, see `_half_plane`."""


class Passing:
    """One drone's passing of its neighbours: it keeps the side of each until it has passed.

    Without memory, noise would choose the side anew in each step of a nearly head-on course, and a drone that
    alternates stays in the way.
    """

    def __init__(self, law: FlockingLaw, vertical_m: float) -> None:
        """Neighbours at least `vertical_m` above or below are ignored."""
        self._law, self._vertical_m = law, vertical_m
        self._sides: dict[int, float] = {}

    def command(
        self,
        velocity: FloatArray,
        offsets: FloatArray,
        velocities: FloatArray,
        desired: FloatArray,
        step_s: float,
        tracks: Sequence[int],
        limits: Limits = NO_LIMITS,
        ages_s: FloatArray | float = math.inf,
    ) -> tuple[FloatArray, FloatArray]:
        """As of `FlockingLaw.command`, but clear of all neighbours; arguments as of `clear`.

        The acceleration, (2,) m/s^2, is the law's, or else the one that leads to the velocity within its sampling time.
        """
        wanted, acceleration = self._law.command(velocity, level_offsets(offsets), velocities, desired, step_s, ages_s)
        clear = self.clear(wanted, velocity, offsets, velocities, tracks, limits)
        return clear, acceleration if clear is wanted else (clear - velocity) / lookahead_s(step_s)

    def clear(
        self,
        wanted: FloatArray,
        velocity: FloatArray,
        offsets: FloatArray,
        velocities: FloatArray,
        tracks: Sequence[int],
        limits: Limits = NO_LIMITS,
    ) -> FloatArray:
        """The velocity nearest to the `wanted` one, (2,) m/s, that passes each neighbour at the separation distance.

        `velocity` (2,) m/s is the own one, `offsets` (n, 3) metres NED are the neighbours', `velocities` (n, 2) m/s
        theirs, over ground, and `tracks` their numbers. `limits` are the gate's: sides that it blocks are avoided.

        Optimal reciprocal collision avoidance (J. van den Berg, S. Guy, M. Lin, D. Manocha, "Reciprocal n-body
        collision avoidance", 2011): each neighbour permits one half-plane of velocities, so that the distance is kept
        for `HORIZON_S` if both take their share. One that is nearer already may come no nearer, and the law separates
        them. Without conflict the result is `wanted`. A half-plane is violated where satisfying it would take more than
        1 / `_SHARE` times as much change of velocity; then the other side of each neighbour is tried too: between two
        that come from opposite directions the usual sides are opposite, and the drone would stay in the middle.
        """
        distance_m, max_speed_m_s = self._law.parameters.separation_distance_m, self._law.parameters.max_speed_m_s
        ranges = np.hypot(offsets[:, 0], offsets[:, 1])
        near = ((np.abs(offsets[:, 2]) < self._vertical_m) & (ranges > SAME_SPOT_M)).nonzero()[0].tolist()

        def plane(one: int, side: float) -> _Plane:
            return _half_plane(velocity, offsets[one, :2], velocity - velocities[one], distance_m, side)

        planes = {one: plane(one, self._sides.get(tracks[one], 0.0)) for one in near}
        clear, least_m_s, resolved = _clearest(wanted, planes.values(), max_speed_m_s, limits)
        alternatives = [planes | {one: plane(one, -side)} for one, (_, _, side) in planes.items() if not resolved]
        for tried in alternatives:
            other, cost_m_s, _ = _clearest(wanted, tried.values(), max_speed_m_s, limits)
            if cost_m_s < least_m_s:
                clear, least_m_s, planes = other, cost_m_s, tried
        self._sides = {tracks[one]: side for one, (_, _, side) in planes.items()}
        return clear


def _clearest(
    wanted: FloatArray, planes: Iterable[_Plane], max_speed_m_s: float, limits: Limits
) -> tuple[FloatArray, float, bool]:
    """The velocity (2,) m/s with the least sum of its distance from `wanted` and the largest violation / `_SHARE`; that
    sum, m/s; and whether it is in all half-planes.

    An exact penalty: it is the nearest velocity in all half-planes, unless those are nearly opposite and meet far away.
    There the least violation alone would lead sideways at the highest speed.
    """
    normals, least = np.reshape([one[0] for one in planes], (-1, 2)), np.array([one[1] for one in planes])
    if (normals @ wanted >= least - ROUNDING_M_S).all():
        return wanted, 0.0, True
    towards, most_m_s = (one[limits[1] < max_speed_m_s] for one in limits)  # no velocity exceeds the others
    across, at_m_s = np.vstack([normals, towards]), np.concatenate([least, most_m_s])
    feet = wanted + (at_m_s - across @ wanted)[:, None] * across
    tried = np.vstack([np.zeros(2), feet, crossings(across, at_m_s)])
    tried *= np.minimum(1.0, max_speed_m_s / np.maximum(np.linalg.norm(tried, axis=1), ROUNDING_M_S))[:, None]
    tried = tried[(tried @ towards.T <= most_m_s + ROUNDING_M_S).all(axis=1)]
    off = np.maximum(least - tried @ normals.T, 0.0).max(axis=1)
    costs = np.linalg.norm(tried - wanted, axis=1) + off / _SHARE
    nearest = int(np.argmin(costs))
    return tried[nearest], float(costs[nearest]), bool(off[nearest] <= ROUNDING_M_S)


def _half_plane(
    velocity: FloatArray, offset: FloatArray, relative: FloatArray, distance_m: float, side: float
) -> _Plane:
    """One neighbour's half-plane: its normal (2,), the least component of the own velocity along it, m/s, and its side.

    The normal leads to the nearest point outside the cone of relative velocities that lead to a conflict, cut off at
    the horizon. The cone's apex is zero; its end is a circle of radius `distance_m` / horizon around offset / horizon.
    Against an approaching neighbour backing off would only delay the conflict: the cone is not cut off. A `side` (0:
    none) is kept while the relative velocity is inside the cone.
    """
    range_m = math.hypot(*offset)
    ahead = offset / range_m
    closing_m_s = float(relative @ ahead)
    if range_m <= distance_m:
        return -ahead, float(velocity @ -ahead) + max(closing_m_s, 0.0), side
    comes = closing_m_s - float(velocity @ ahead) > _COMES_M_S and closing_m_s * _COMES_S > range_m - distance_m
    beyond = relative - offset / HORIZON_S
    along = float(beyond @ offset)
    if not comes and along < 0 and along**2 > distance_m**2 * float(beyond @ beyond):
        normal = beyond / math.hypot(*beyond)
        change = distance_m / HORIZON_S - math.hypot(*beyond)
    else:
        right = np.array([-ahead[1], ahead[0]])  # north and east: a quarter turn clockwise
        sine = distance_m / range_m
        cosine, to_right_m_s = math.sqrt(1 - sine**2), float(relative @ right)
        if cosine * abs(to_right_m_s) > sine * closing_m_s or not side:  # outside the cone, or no side yet
            head_on = abs(to_right_m_s) < _HEAD_ON_RAD * math.hypot(*relative)
            side = math.copysign(1.0, to_right_m_s) if side or not head_on else 1.0
        normal = cosine * side * right - sine * ahead
        change = -float(relative @ normal)
    share = 1.0 if comes and closing_m_s * HORIZON_S > range_m - distance_m else _SHARE
    return normal, float(velocity @ normal) + (share * change if change > 0 else change), side
