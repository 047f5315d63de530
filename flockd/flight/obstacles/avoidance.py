"""Obstacle avoidance: steers the flocking law's velocity around obstacles and slows it in front of them."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges
from flockd.flight.flocking.law import FlockingLaw, level_offsets, lookahead_s
from flockd.flight.geometry.level import limit_norm
from flockd.flight.obstacles.local_map import AZIMUTHS, nearest_points
from flockd.flight.safety.approach import stopping_speed, towards_flying_on, towards_obstacles
from flockd.flight.safety.half_planes import nearest_within

TURNS = np.linspace(-math.pi, math.pi, 144, endpoint=False)
"""(n,) radians, clockwise from the wanted direction; 0 is one of them."""
LAST = 0.5
"""Cost of a turn away from the last direction, relative to one away from the wanted direction."""
RIGHT_RAD = 0.02
"""Extra cost of a turn to the left: of two equal ways all drones take that to the right."""
LEAST_SHARE = 0.3
"""Least share of the wanted speed, at any turn: the drone has to leave dead ends."""
PACE_M_S = 1.5
"""Among neighbours, a direction has to be free for at most this speed, or theirs if that is faster."""
BESIDE_M = 0.02
"""Near an obstacle, the radius that has to be free is reduced to the obstacle's distance minus this."""


class Avoidance:
    """Obstacle avoidance of one drone. It keeps the side on which it passes."""

    def __init__(self, parameters: ObstacleParameters, gate: GateParameters, step_s: float) -> None:
        self._parameters = parameters
        # Towards neighbours as towards obstacles, a step counts as reaction; the gate keeps its own, longer distance.
        self._gate = gate.model_copy(update={"neighbour_reaction_s": gate.reaction_s})
        self._step_s = step_s
        self._reaction_s = gate.reaction_s + step_s
        self._steering = Steering(parameters)

    def command(
        self,
        law: FlockingLaw,
        velocity: FloatArray,
        neighbours: FloatArray,
        velocities: FloatArray,
        desired: FloatArray,
        ranges: ObstacleRanges,
        ages_s: FloatArray | float = math.inf,
    ) -> tuple[FloatArray, FloatArray]:
        """The velocity to command, (2,) m/s, and the acceleration that leads to it, (2,) m/s^2.

        Arguments as of `FlockingLaw.command`, but `neighbours` are (n, 3) metres NED from the drone. Under the law the
        velocity tends to V + u: that is steered around obstacles, and the velocity after the step has to be safe.
        """
        u = law.acceleration(velocity, level_offsets(neighbours), velocities, desired, ages_s)
        wanted = limit_norm(velocity + u, law.parameters.max_speed_m_s)
        flock = velocities.mean(axis=0) if len(velocities) else np.zeros(2)
        asked, _ = law.limited(velocity, self.steered(wanted, ranges, flock) - velocity, self._step_s)
        safe = self.within(asked, ranges, neighbours, velocities)
        return safe, (safe - velocity) / lookahead_s(self._step_s)

    def steered(self, wanted: FloatArray, ranges: ObstacleRanges, flock: FloatArray) -> FloatArray:
        """The velocity (2,) m/s to fly with instead of the `wanted` one, to which the flocking law tends.

        It is no faster than the drone can stop within the free distance. `flock` (2,) m/s is the neighbours' mean
        velocity, zero without neighbours.
        """
        velocity, free_m = self._steering.around(wanted, ranges, flock)
        most_m_s = float(stopping_speed(np.array(free_m), self._gate.braking_m_s2, self._reaction_s))
        return limit_norm(velocity, most_m_s) + self._away(ranges)

    def within(
        self, velocity: FloatArray, ranges: ObstacleRanges, neighbours: FloatArray, velocities: FloatArray
    ) -> FloatArray:
        """The velocity (2,) m/s nearest to the given one from which the drone can stop in time.

        `neighbours` (n, 3) metres NED from the drone, with their `velocities` (n, 2) m/s. The time until the next
        velocity counts as reaction time. Neighbours sidestep without notice here, so the degraded separation is kept.
        """
        p, gate = self._parameters, self._gate
        points = nearest_points(ranges, p.sigmas)
        to_obstacles = towards_obstacles(points, p.clearance_m, gate.braking_m_s2, self._reaction_s)
        exactly = np.zeros_like(velocities)
        to_neighbours = towards_flying_on(gate, neighbours, velocities, gate.degraded_separation_m, exactly)
        directions, most_m_s = zip(to_obstacles, to_neighbours, strict=True)
        return nearest_within(velocity, np.concatenate(directions), np.concatenate(most_m_s))

    def _away(self, ranges: ObstacleRanges) -> FloatArray:
        """(2,) m/s away from the nearest obstacle if it is within the clearance: restores the clearance in a second."""
        points = nearest_points(ranges, self._parameters.sigmas)
        away_m = np.hypot(*points.T)
        if not (away_m < self._parameters.clearance_m).any():
            return np.zeros(2)
        nearest = int(np.argmin(away_m))
        missing_m = self._parameters.clearance_m - away_m[nearest]
        away: FloatArray = -missing_m * points[nearest] / away_m[nearest]
        return away


class Steering:
    """Chooses the direction around obstacles: the one nearest to the wanted direction that is free for some seconds.

    After Ulrich and Borenstein 1998, "VFH+: reliable obstacle avoidance for fast mobile robots". Directions in which an
    obstacle, enlarged by the clearance, is met too soon are closed. Of the others the cheapest is taken; a direction
    near the last one costs less, so that the next step passes on the same side.
    """

    def __init__(self, parameters: ObstacleParameters) -> None:
        self._parameters = parameters
        self._last_rad: float | None = None

    def around(self, wanted: FloatArray, ranges: ObstacleRanges, flock: FloatArray) -> tuple[FloatArray, float]:
        """The velocity (2,) m/s in a free direction, and the free distance in that direction, metres.

        The more it turns away from the wanted direction, the slower it is: by (1 + cos(turn)) / 2, at least
        `LEAST_SHARE`. A drone that leaves the flock to pass an obstacle is pulled back the harder, so the law asks for
        a higher speed. That speed does not lengthen the distance that has to be free: among trees only the way back
        would be long enough. It is only flown if nothing is met within `horizon_s`.

        `wanted` (2,) m/s; `flock` (2,) m/s is the neighbours' mean velocity, zero without neighbours.
        """
        p = self._parameters
        speed = math.hypot(*wanted)
        if speed == 0.0:
            return wanted, 0.0
        wanted_rad = math.atan2(wanted[1], wanted[0])
        points = nearest_points(ranges, p.sigmas)
        pace = min(speed, max(math.hypot(*flock), PACE_M_S)) if flock.any() else speed
        azimuths = wanted_rad + TURNS
        seen_m = ranges.seen_m[np.round(azimuths / AZIMUTHS[1]).astype(np.int64) % SECTORS]
        cost = self._cost(azimuths)
        nearest_m = float(np.hypot(*points.T).min(initial=np.inf))
        with_margin_m = min(max(nearest_m - BESIDE_M, p.clearance_m), p.clearance_m + p.margin_m)
        for radius_m in (with_margin_m, p.clearance_m):
            free_m = free_way(points, radius_m, azimuths)
            free_m = np.minimum(free_m, seen_m - radius_m)
            is_free = free_m >= min(pace * p.horizon_s, p.range_m - radius_m)
            if is_free.any():
                return self._taken(int(np.argmin(np.where(is_free, cost, np.inf))), wanted, pace, free_m)
        return self._taken(int(np.argmax(free_m - cost)), wanted, pace, free_m)

    def _cost(self, azimuths: FloatArray) -> FloatArray:
        cost = np.abs(TURNS) + np.where(TURNS < 0, RIGHT_RAD, 0.0)
        if self._last_rad is not None:
            cost = cost + LAST * np.abs((azimuths - self._last_rad + math.pi) % math.tau - math.pi)
        return cost

    def _taken(self, index: int, wanted: FloatArray, pace: float, free_m: FloatArray) -> tuple[FloatArray, float]:
        turn, free = float(TURNS[index]), max(float(free_m[index]), 0.0)
        wanted = limit_norm(wanted, max(pace, free / self._parameters.horizon_s))
        turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ wanted
        velocity: FloatArray = max((1.0 + math.cos(turn)) / 2.0, LEAST_SHARE) * turned
        self._last_rad = math.atan2(velocity[1], velocity[0]) if turn else None
        return velocity, free


def free_way(points: FloatArray, radius_m: float, azimuths: FloatArray) -> FloatArray:
    """(k,) m: how far a disc can move in each direction, (k,) rad, before it touches one of the points (m, 2).

    inf if it touches none. From a point inside the disc it can move away, but no nearer.
    """
    ahead_m = points @ np.array([np.cos(azimuths), np.sin(azimuths)])
    square = radius_m**2 - (np.sum(points**2, axis=1)[:, None] - ahead_m**2)
    meets = (square > 0) & (ahead_m > 0)
    way_m = np.where(meets, np.maximum(ahead_m - np.sqrt(np.maximum(square, 0.0)), 0.0), np.inf)
    free: FloatArray = way_m.min(axis=0, initial=np.inf)
    return free
