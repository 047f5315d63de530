"""Obstacle avoidance: steers the flocking law's velocity around obstacles and slows it in front of them."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray, ObstacleRanges
from flockd.flight.flocking import FlockingLaw, level_offsets, lookahead_s
from flockd.flight.geometry.level import limit_norm
from flockd.flight.obstacles.local_map import nearest_points
from flockd.flight.obstacles.steering import Steering
from flockd.flight.safety.approach import stopping_speed, towards_flying_on, towards_obstacles
from flockd.flight.safety.half_planes import nearest_within


class Avoidance:
    """Obstacle avoidance of one drone. It keeps the side on which it passes."""

    def __init__(self, parameters: ObstacleParameters, gate: GateParameters, step_s: float) -> None:
        self._parameters = parameters
        # The next velocity comes a step later here too; the gate behind keeps its own, longer distance.
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
