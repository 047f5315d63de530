"""The flocking law of the paper: from the neighbours' positions and velocities to an acceleration (Eq. 38-42)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from flockd.core.config.flocking import FlockingParameters, WeightParameters
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.level import SAME_SPOT_M, limit_norm

_MIN_DISTANCE_M = 1e-3
"""Least distance in Eq. 39 and 41, which have a pole at zero."""
SAMPLING_TIME_S = 0.5
"""The sampling time st of the paper, and the shortest one used. A command is the own velocity plus u st. A lasting
error e of the own velocity shifts the equilibrium to u = -e / st, so short steps would amplify it."""


class FlockingLaw:
    """Eq. 38-42. Stateless and deterministic."""

    def __init__(self, parameters: FlockingParameters | None = None) -> None:
        self.parameters = parameters or FlockingParameters()

    def acceleration(
        self,
        velocity: ArrayLike,
        positions: ArrayLike,
        velocities: ArrayLike,
        desired_velocity: ArrayLike,
        ages_s: ArrayLike = math.inf,
    ) -> FloatArray:
        """U of Eq. 38: (2,) m/s^2, not limited.

        All arguments are horizontal, north and east. `velocity` (2,) is the own one over ground; `positions` (n, 2)
        metres are the neighbours' relative to the own drone (Q_j - Q_i); `velocities` (n, 2) theirs over ground;
        `desired_velocity` (2,) is efv of Eq. 42. `ages_s` (n,), or one for all, is the age of their tracks: see
        `FlockingParameters.cohesion_time_s`. n may be 0. A neighbour at distance zero counts as 1 mm to the north;
        `level_offsets` avoids that. Raises ValueError for other shapes and for numbers that are not finite.
        """
        own = _finite(velocity, (2,), "the own velocity")
        desired = _finite(desired_velocity, (2,), "the desired velocity")
        offsets = _finite(positions, (-1, 2), "the neighbours' positions")
        theirs = _finite(velocities, (len(offsets), 2), "the neighbours' velocities")
        ages = np.broadcast_to(np.asarray(ages_s, dtype=float), len(offsets))
        p = self.parameters
        offsets = np.where(np.any(offsets != 0, axis=1, keepdims=True), offsets, [_MIN_DISTANCE_M, 0.0])
        distances = np.hypot(offsets[:, 0], offsets[:, 1])
        near = distances <= max(p.observation_distance_m, p.separation_distance_m)
        offsets, theirs, ages, distances = offsets[near], theirs[near], ages[near], distances[near]
        directions = offsets / distances[:, None]
        observed = distances <= p.observation_distance_m
        distances = np.maximum(distances, _MIN_DISTANCE_M)

        pull = p.cohesion * distances * np.log(distances / p.desired_distance_m)
        weights = influence_weights(p.weight, distances, observed)
        if p.cohesion_time_s is not None:
            pull = np.minimum(pull, p.max_acceleration_m_s2 * (ages / p.cohesion_time_s) ** 2)
        cohesion = (weights * pull)[:, None] * directions  # Eq. 39
        alignment = (p.alignment * weights)[:, None] * (theirs - own)  # Eq. 40
        crowding = np.maximum(1 / distances - 1 / p.separation_distance_m, 0.0)  # 0 beyond D_II
        separation = (-p.separation * crowding**2)[:, None] * directions  # Eq. 41
        following = p.velocity * p.own_weight * desired  # Eq. 42
        u: FloatArray = (cohesion + alignment + separation).sum(axis=0) + following - own  # Eq. 38
        return u

    def command(
        self,
        velocity: ArrayLike,
        positions: ArrayLike,
        velocities: ArrayLike,
        desired: ArrayLike,
        step_s: float,
        ages_s: ArrayLike = math.inf,
    ) -> tuple[FloatArray, FloatArray]:
        """The velocity to command, (2,) m/s, and the acceleration that leads to it, (2,) m/s^2, both within limits.

        The acceleration's norm is limited first, then that of V + u * st. Arguments and errors as of `acceleration`;
        `step_s` is the sampling time st; a shorter one than `SAMPLING_TIME_S` is replaced by that.
        """
        return self.limited(velocity, self.acceleration(velocity, positions, velocities, desired, ages_s), step_s)

    def limited(self, velocity: ArrayLike, acceleration: FloatArray, step_s: float) -> tuple[FloatArray, FloatArray]:
        """As `command`, for an acceleration (2,) m/s^2 without limits."""
        if not (math.isfinite(step_s) and step_s > 0):
            raise ValueError(f"the step must be finite and positive, not {step_s} s")
        u = limit_norm(acceleration, self.parameters.max_acceleration_m_s2)
        asked = np.asarray(velocity, dtype=float) + u * lookahead_s(step_s)
        return limit_norm(asked, self.parameters.max_speed_m_s), u


def lookahead_s(step_s: float) -> float:
    """The st of V + u st, s, for steps of this length."""
    return max(step_s, SAMPLING_TIME_S)


def level_offsets(offsets: FloatArray) -> FloatArray:
    """(n, 2) metres north and east of neighbours at (n, 3) metres NED, adjusted so that drones above each other
    separate.

    Directions within `SAME_SPOT_M` are noise; two drones with the same noise would fly off in the same direction. Such
    a neighbour is placed at that distance to the west if it is below, else to the east. Both fly apart: the upper one
    east.
    """
    same_spot = np.hypot(offsets[:, 0], offsets[:, 1]) < SAME_SPOT_M
    sides = np.where(offsets[:, 2] > 0, -SAME_SPOT_M, SAME_SPOT_M)
    aside = np.column_stack([np.zeros(len(offsets)), sides])
    level: FloatArray = np.where(same_spot[:, None], aside, offsets[:, :2])
    return level


def influence_weights(parameters: WeightParameters, distances: FloatArray, observed: BoolArray) -> FloatArray:
    """W of Eq. 39 and 40, which the paper does not define: (n,) of 0 and 1; 0 where the mask `observed` (n,) is false.

    `uniform` gives all 1, as in the paper's flight of five. `nearest` gives 1 to the k nearest, which changes nothing
    in flocks of up to k + 1 drones and keeps larger ones from collapsing; of two at equal distance the first counts as
    nearer.
    """
    weights = observed.astype(float)
    if parameters.kind == "nearest":
        weights[np.argsort(distances, kind="stable")[parameters.nearest :]] = 0.0
    return weights


def _finite(values: ArrayLike, shape: tuple[int, int] | tuple[int], name: str) -> FloatArray:
    """`values` as an array of `shape` (-1: any length), or ValueError."""
    array = np.asarray(values, dtype=float)
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        wanted = tuple("n" if want == -1 else want for want in shape)
        raise ValueError(f"{name} must have the shape {wanted}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array
