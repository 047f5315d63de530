"""The gate's view of the neighbours: every track, confirmed or not, predicted to now."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from statistics import NormalDist

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import SECTORS, FloatArray, Neighbour, PossibleMotion
from flockd.flight.safety.approach import stopping_speed, towards_neighbours, towards_obstacles
from flockd.flight.safety.fence import towards_fence
from flockd.flight.safety.half_planes import NO_LIMITS, Limits
from flockd.flight.safety.request import Objection, Surroundings

_NORMAL = NormalDist()
BEYOND = _NORMAL.cdf(-2.0)
"""Probability that a neighbour is nearer, or approaches faster, than assumed: 2.3 %, as for two standard deviations."""


def surroundings(
    neighbours: Sequence[Neighbour],
    age_s: float,
    *,
    moved: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    yaw_rad: float,
    height_m: float,
    obstacles: FloatArray,
    seen_m: FloatArray | None,
) -> Surroundings:
    """The surroundings `age_s` after the step that gave the `neighbours`, which fly on at constant velocity.

    A neighbour that would have flown through the drone since then is assumed at its last position: such drones brake
    for each other, and one that has passed is detected behind the drone in the next step. Unconfirmed tracks count: a
    track limits the speed towards it from its first detection on, by its uncertainty. Each of its possible motions
    counts once, see `_credible`. `moved` (3,) m NED is the drone's displacement since then; `position` (2,) m from
    home, `velocity` (3,) m/s NED, NaN if not known; `obstacles` (m, 2) m from where the drone was then, and `seen_m`
    (SECTORS,); None: the range of sight is not known.
    """
    places, velocities, margins, unseen_s = _motions(neighbours, age_s, moved)
    return Surroundings(
        position=position,
        velocity=velocity[:2],
        yaw_rad=yaw_rad,
        neighbours=places,
        neighbour_velocities=velocities,
        neighbour_margins=margins,
        neighbour_unseen_s=unseen_s,
        height_m=height_m,
        obstacles=obstacles - moved[:2],
        seen_m=np.full(SECTORS, np.inf) if seen_m is None else seen_m - np.hypot(moved[0], moved[1]),
    )


def limits_towards(
    neighbours: Sequence[Neighbour], position: FloatArray | None, p: GateParameters, flies_on_s: float = 0.0
) -> Limits:
    """Directions (k, 2) to neighbours and the fence, and the greatest speed, (k,) m/s, that the gate permits there as
    the step ends.

    For a pilot, so that it does not command what the gate refuses. `position` (2,) m from home; None: not known. Before
    the fence the drone has room to fly on for `flies_on_s`.
    """
    places, velocities, margins, unseen_s = _motions(neighbours, 0.0, np.zeros(3))
    near = towards_neighbours(p, places, velocities, p.min_separation_m, margins, unseen_s)
    fence = NO_LIMITS if position is None else towards_fence(p, position, flies_on_s)
    return np.concatenate([near[0], fence[0]]), np.concatenate([near[1], fence[1]])


def limits_around(
    p: GateParameters, around: Surroundings, separation_m: float, late_s: float
) -> tuple[FloatArray, FloatArray, list[Objection]]:
    """Directions (n, 2), greatest speeds there, (n,) m/s, and what is there: the fence, a neighbour or an obstacle.

    For a vehicle that follows `late_s` later than expected. A drone measured to be faster than a limit has to brake:
    the limit is lowered by the excess. That is feedback of the velocity with a gain of one, which is stable with any
    lag and dead time.
    """
    later = {"reaction_s": p.reaction_s + late_s, "neighbour_reaction_s": p.neighbour_reaction_s + late_s}
    p = p.model_copy(update=later)
    neighbours = around.neighbours, around.neighbour_velocities
    limits = {
        Objection.FENCE: towards_fence(p, around.position),
        Objection.SEPARATION: towards_neighbours(
            p, *neighbours, separation_m, around.neighbour_margins, around.neighbour_unseen_s
        ),
        Objection.OBSTACLE: towards_obstacles(around.obstacles, p.obstacle_clearance_m, p.braking_m_s2, p.reaction_s),
    }
    directions = np.concatenate([towards for towards, _ in limits.values()])
    most_m_s = np.concatenate([most for _, most in limits.values()])
    if np.isfinite(around.velocity).all():
        most_m_s = np.maximum(most_m_s - np.maximum(directions @ around.velocity - most_m_s, 0.0), 0.0)
    return directions, most_m_s, [name for name, (_, most) in limits.items() for _ in most]


def into_the_unseen(
    p: GateParameters, around: Surroundings, separation_m: float, late_s: float, velocity: FloatArray
) -> float:
    """The greatest speed, m/s, in the direction of `velocity` (2,) from which the drone stops before unseen space.

    A neighbour extends into the sectors beside its own. A drone that is too near already may fly in any direction.
    """
    nearest_m = np.linalg.norm(around.neighbours, axis=1).min(initial=math.inf)
    if nearest_m < separation_m or around.nearest_obstacle_m < p.obstacle_clearance_m:
        return math.inf
    ahead = round(math.atan2(velocity[1], velocity[0]) * SECTORS / math.tau)
    left_m = np.fmax(around.seen_m, 0.0).take([ahead - 1, ahead, ahead + 1]).min() - separation_m
    return float(stopping_speed(left_m, p.braking_m_s2, p.neighbour_reaction_s + late_s))


def _motions(
    neighbours: Sequence[Neighbour], age_s: float, moved: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """All possible motions of neighbours by now: places (k, 3) m, velocities (k, 2) m/s, margins (k, 2), and the time
    since each was last seen, (k,) s."""
    found = [(motion, age_s + one.unseen_s) for one in neighbours for motion in _credible(one)]
    motions = [motion for motion, _ in found]
    k = len(motions)
    return (
        np.reshape([_by_now(one.position, age_s * one.velocity, moved) for one, _ in motions], (k, 3)),
        np.reshape([one.velocity[:2] for one, _ in motions], (k, 2)),
        np.reshape([(sigmas * one.range_sigma_m, sigmas * one.closing_sigma_m_s) for one, sigmas in motions], (k, 2)),
        np.array([unseen_s for _, unseen_s in found]),
    )


def _credible(neighbour: Neighbour) -> Iterator[tuple[PossibleMotion, float]]:
    """The possible motions of a neighbour, and by how many standard deviations each may be wrong.

    `BEYOND` is shared among the motions: the less probable a motion, the fewer standard deviations count, and a motion
    less probable than its share does not count. By Boole's inequality the neighbour is beyond all of them with a
    probability of at most `BEYOND`. A single detection is about as likely false: it slows the drone, but does not stop
    it.
    """
    possible = neighbour.possible or (
        PossibleMotion(
            1.0, neighbour.position, neighbour.velocity, neighbour.position_sigma_m, neighbour.velocity_sigma_m_s
        ),
    )
    share = BEYOND / len(possible)
    for motion in possible:
        probability = motion.probability * neighbour.existence_probability
        if probability > share:
            yield motion, -_NORMAL.inv_cdf(share / probability)


def _by_now(place: FloatArray, way: FloatArray, moved: FloatArray) -> FloatArray:
    """(3,) m from the drone, which moved: a neighbour that was at `place` and flew `way`; at `place` if `way` leads
    through the drone."""
    flown, braked = place + way - moved, place - moved
    return braked if flown[:2] @ braked[:2] <= 0 else flown
