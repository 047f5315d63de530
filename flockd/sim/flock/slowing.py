"""What gates slowed drones down for: shares of the time that they flew, by cause."""

from __future__ import annotations

import math
from collections.abc import Collection
from enum import StrEnum

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.safety import Action, Event, Objection, Request, Surroundings, Verdict
from flockd.flight.safety.approach import towards_neighbours

_SLOWED = 0.05
"""A velocity that differs from the one asked for by a smaller share of it counts as the same."""
_MATCH_M, _MATCH_SHARE = 1.0, 0.25
"""A track with no drone within this, or this share of its range, is a false one; as `match_neighbours`."""


class Cause(StrEnum):
    """Why a gate let its drone fly otherwise than asked for. The value is its name in summaries."""

    NEIGHBOUR = "neighbour"
    """A drone that was there: exact states at the same moment would have limited the speed too."""
    UNCERTAINTY = "uncertainty"
    """Likewise, but only the errors of its estimate, or the caution for them, limited it."""
    FALSE_DETECTION = "false_detection"
    """A track of something that is no drone."""
    OBSTACLE = "obstacle"
    FENCE = "fence"
    WIND = "wind"
    """The supervisor had it fly slower in strong gusts."""
    CAMERA = "camera"
    """Likewise, for a lost camera."""
    OTHER = "other"
    """A command that is old, or changes faster than the limit of acceleration; a height beyond the limits."""


_OF_EVENTS = {
    Event.VELOCITY_OFF: Cause.WIND,
    Event.NO_ROOM_TO_HOLD: Cause.WIND,
    Event.CAMERA_LOST: Cause.CAMERA,
    Event.FENCE_LEFT: Cause.FENCE,
}
"""Why the supervisor had a drone fly slower; another event is `OTHER`."""


class SlowedTime:
    """Sums up times. A moment may have several causes."""

    def __init__(self) -> None:
        self._flown_s = self._slowed_s = 0.0
        self._by_cause_s = dict.fromkeys(Cause, 0.0)

    def add(self, period_s: float, causes: frozenset[Cause]) -> None:
        """A drone flew for so long; without a cause as it was asked to."""
        self._flown_s += period_s
        self._slowed_s += period_s * bool(causes)
        for cause in causes:
            self._by_cause_s[cause] += period_s

    @property
    def share(self) -> float | None:
        """Of the time flown; None: none was."""
        return self._slowed_s / self._flown_s if self._flown_s else None

    @property
    def by_cause(self) -> dict[str, float]:
        """Shares of the time flown, of each cause that there was."""
        return {str(cause): self._by_cause_s[cause] / self._flown_s for cause in Cause if self._by_cause_s[cause]}


def is_slowed(request: Request, verdict: Verdict) -> bool:
    """Whether what is allowed is not what was asked for."""
    asked, setpoint = request.wanted.velocity, verdict.setpoint
    return setpoint is not None and math.hypot(*(setpoint.velocity - asked)) > _SLOWED * math.hypot(*asked)


def causes_of(
    p: GateParameters,
    request: Request,
    verdict: Verdict,
    truth: Surroundings,
    is_drone: BoolArray,
    degraded_by: Collection[Event] = (),
) -> frozenset[Cause]:
    """Why what was allowed is not what was asked for.

    `truth` is where the other drones truly are, and `is_drone` (n,) tells which of the request's neighbours are any.
    `degraded_by`: why the supervisor has a degraded drone fly slower.
    """
    asked, action, found = request.wanted.velocity, request.permission.action, set()
    if Objection.SEPARATION in verdict.objections:
        around = request.around
        if _limits(p, action, around, asked, ~is_drone):
            found.add(Cause.FALSE_DETECTION)
        if _limits(p, action, truth, asked, np.ones(len(truth.neighbours), dtype=bool)):
            found.add(Cause.NEIGHBOUR)
        elif _limits(p, action, around, asked, is_drone) or not found:
            found.add(Cause.UNCERTAINTY)
    named = {Objection.OBSTACLE: Cause.OBSTACLE, Objection.FENCE: Cause.FENCE}
    found |= {cause for objection, cause in named.items() if objection in verdict.objections}
    if action is Action.FLY_DEGRADED:
        found |= {_OF_EVENTS.get(event, Cause.OTHER) for event in degraded_by}
    return frozenset(found or {Cause.OTHER})


def _limits(p: GateParameters, action: Action, around: Surroundings, asked: FloatArray, chosen: BoolArray) -> bool:
    """Whether any of the chosen neighbours limits a velocity (2,) m/s that is asked for."""
    towards, most_m_s = towards_neighbours(
        p,
        around.neighbours[chosen],
        around.neighbour_velocities[chosen],
        p.min_separation_m if action is Action.FLY else p.degraded_separation_m,
        None if around.neighbour_margins is None else around.neighbour_margins[chosen],
        None if around.neighbour_unseen_s is None else around.neighbour_unseen_s[chosen],
    )
    over_m_s = np.maximum(towards @ around.velocity - most_m_s, 0.0)  # a drone that is too fast has to brake
    return bool((towards @ asked > most_m_s - over_m_s).any())


def which_are_drones(tracks: FloatArray, drones: FloatArray) -> BoolArray:
    """(n,): which of the places (n, 3) m of tracks have a drone near, of those at (k, 3) m; from one observer."""
    apart_m = np.linalg.norm(tracks[:, None] - drones[None], axis=2)
    near_m = np.maximum(_MATCH_M, _MATCH_SHARE * np.linalg.norm(drones, axis=1))
    return np.asarray((apart_m <= near_m).any(axis=1))
