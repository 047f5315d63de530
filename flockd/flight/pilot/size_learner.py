"""How large the others are: how far off what the networks judge may be, and what a drone that is to learns in flight.

An apparent size gives a range only in units of the drone's size. If the own drone moves by a known way that its
neighbours do not follow, their bearings shift by that way over the range: the shift gives the metres. Any other motion
gives nothing, as mates move as one does oneself. So, in units of the drones' size, a neighbour's height below the own
drone is a smooth course of its own plus the own weave over the size: linear in that scale, 1 / size, one for all.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.messages import FloatArray, GroundEstimate, LearnedSize, Neighbour, SizeStatus, VehicleState
from flockd.flight.pilot.weave import DURATION_S, PERIOD_S, Weave
from flockd.flight.tracking import Measurement

_KNOWN_SIGMA = 0.1
"""A learned size is used, and the drone weaves no more, below this relative standard deviation."""
_LEAST_SIGMA = 0.04
"""What the model does not know of adds this to it."""
_JUDGED_SIGMA = 0.5
"""By how much the judged size may be off, as a share, before anything is learned."""
_PLAUSIBLE = 2.0
"""No family that the networks do not know is judged wrong by more than this factor, but drones that rise together look
larger."""
_ROBUST_SIGMA, _TIMES = 2.5, 10
"""A track that is beyond this many standard deviations off the scale counts less and less: it may be of a tree. So many
times it is looked at which are."""
_LASTS_S = PERIOD_S / (2 * math.pi)
"""Errors of bearings and heights last. Of all that last for some time, as an Ornstein-Uhlenbeck process, those that
last so long have most power at the weave's frequency: as much as if each so long were one independent measurement."""
_JUDGED, _NEAR_M = 400, 8.0
"""So many judged sizes are kept, the newest, of drones so near: farther ones look like much."""
_FEWEST_DOUBTS, _DOUBTED = 8, 0.15
"""What the networks' own standard deviations of the log sizes say, at the median of so many, where they do not know the
drones: of families that they know it is 0.01 to 0.06, of two that they do not know 0.31. Beyond this, the gate reckons
with so much, twice its standard deviations being near what those two are off: with all of it drones would stop before
each other two thirds of the time."""


class SizeLearner:
    """One drone's, for one flight."""

    def __init__(self, config: DroneConfig, learned: LearnedSize | None = None, *, flies: bool = True) -> None:
        """``learned``: before the flight. Without ``flies`` the autopilot or a person flies the drone, and it does not
        weave."""
        self._is_said = config.perception.drone_size_m is not None
        self._learns, self._gate, self._name = config.flocking.size == "learn", config.safety.gate, config.name
        self._weave: Weave | None = None
        self._may_weave = flies and config.safety.first_flight_layer is None
        self.learned = learned if self._learns else None
        """What ranges follow from, and what goes into the next flight; None: from what the networks judge, or the
        configuration says."""
        self._known: tuple[float, float] | None = None
        """The scale, 1 / size in 1/m, by all weaves, and its variance."""
        self._judged: deque[float] = deque(maxlen=_JUDGED)
        """Sizes of confirmed neighbours as the networks judge them."""
        self._doubts: deque[float] = deque(maxlen=_JUDGED)
        """What they say that the logarithms of those may be off."""
        self._risen_m = 0.0
        self._shown: defaultdict[int, list[tuple[float, float, float]]] = defaultdict(list)
        """Of the weave that moves the drone, by track: times in s, how far the drone has risen since the flight began
        in m, and how far the neighbour is below it in drone sizes."""

    @property
    def status(self) -> SizeStatus | None:
        """As of now; None: nothing is learned."""
        weaves = self._weave is not None and self._weave.moves
        if self.learned is not None:
            return SizeStatus(weaves, self.learned.size_m, self.learned.sigma)
        return SizeStatus(weaves) if weaves else None

    @property
    def sentence(self) -> str:
        """For people, to be added to what the mission does; empty where there is nothing to say."""
        weaves = "; weaves up and down to learn the others' size" if self._weave and self._weave.moves else ""
        return weaves + (f"; has found the others to be {self.learned.size_m:.2f} m large" if self.learned else "")

    def see(
        self, time_s: float, sunk_m: float, measured: Mapping[int, Measurement], neighbours: Sequence[Neighbour]
    ) -> float | None:
        """Take in a step's measurements by track; the size in metres that ranges follow from now on, if it is new.

        `sunk_m` is how far the drone went down since the last step.
        """
        if self._is_said:
            return None
        seen = {one.track: measured[one.track] for one in neighbours if one.confirmed and one.track in measured}
        if self.learned is None:
            near = [one for one in seen.values() if one.range_m < _NEAR_M]
            self._judged.extend(one.size_m for one in near)
            self._doubts.extend(one.log_size_sigma for one in near)
        self._risen_m -= sunk_m
        if self._weave is None or not self._weave.moves:
            self._shown.clear()
            return None
        for track, one in seen.items():
            self._shown[track].append((time_s, self._risen_m, float(one.position[2]) / one.size_m))
        if not self._weave.is_over(time_s) or not self._judged:
            return None
        self._learn()
        return None if self.learned is None else self.learned.size_m

    def _learn(self) -> None:
        """The mean of what is known of the one scale and of what each track showed, weighed again and again."""
        judged = 1 / float(np.median(self._judged))
        known = self._known or (judged, (_JUDGED_SIGMA * judged) ** 2)
        found = [one for one in map(scale_of, map(np.array, self._shown.values())) if one is not None]
        scales, variances = np.array([known, *found]).T
        scale, weights = float(np.median(scales)), 1 / variances
        for _ in range(_TIMES):
            weights = 1 / np.maximum(variances, ((scales - scale) / _ROBUST_SIGMA) ** 2)
            scale = float(weights @ scales / weights.sum())
        self._known = scale, 1 / float(weights.sum())
        sigma = math.hypot(math.sqrt(self._known[1]) / scale, _LEAST_SIGMA)
        if 1 / _PLAUSIBLE < scale / judged < _PLAUSIBLE and sigma < _KNOWN_SIGMA:
            self.learned = LearnedSize(1 / scale, sigma)

    def height(
        self,
        time_s: float,
        vehicle: VehicleState,
        ground: GroundEstimate | None,
        wanted_m: float | None,
        neighbours: Sequence[Neighbour],
        *,
        ends: bool,
    ) -> float | None:
        """The height to ask for, with the weave in it; as of `Wanted`. ``ends``: the mission is over."""
        if not self._learns:
            return wanted_m
        if self._weave is None:  # simulated drones may have one name
            begun = np.array([vehicle.height_m, *vehicle.R_ned_body.flat])
            self._weave = Weave(self._gate, self._name.encode() + begun.tobytes())
        needed = self._may_weave and self.learned is None and not ends
        above_ground_m = vehicle.height_m if ground is None else ground.height_m
        return self._weave.height(time_s, vehicle.height_m, above_ground_m, wanted_m, neighbours, needed=needed)

    def cautious(self, neighbours: Sequence[Neighbour]) -> tuple[Neighbour, ...]:
        """With what the size may be off in the ranges that the gate reckons with: it errs alike in all steps.

        That of the learned size; before, of drones that the networks do not know, `_DOUBTED`.
        """
        if self.learned is not None:
            sigma = self.learned.sigma
        elif len(self._doubts) >= _FEWEST_DOUBTS and np.median(self._doubts) > _DOUBTED:
            sigma = _DOUBTED
        else:
            return tuple(neighbours)
        return tuple(_as_uncertain(one, sigma) for one in neighbours)


def scale_of(shown: FloatArray) -> tuple[float, float] | None:
    """The scale, 1 / size in 1/m, by what one track showed in a weave, (n, 3) as of `SizeLearner`, and its variance.

    Least squares of the neighbour's height over the own one and a parabola in time, its own course. None: it was seen
    too seldom, or the drone did not move otherwise.
    """
    time_s, risen_m, below = shown.T
    independent = min(len(shown), float(np.ptp(time_s)) / _LASTS_S)
    past = (time_s - time_s[0]) / DURATION_S
    design = np.column_stack([risen_m - risen_m[0], np.ones(len(shown)), past, past**2])
    fitted, _, rank, _ = np.linalg.lstsq(design, below)
    if rank < design.shape[1] or independent <= rank + 1:
        return None
    square = float(np.sum((below - design @ fitted) ** 2)) / (independent - rank)
    return float(fitted[0]), square * float(np.linalg.inv(design.T @ design)[0, 0])


def _as_uncertain(neighbour: Neighbour, sigma: float) -> Neighbour:
    possible = tuple(
        replace(one, range_sigma_m=math.hypot(one.range_sigma_m, sigma * float(np.linalg.norm(one.position))))
        for one in neighbour.possible or ()
    )
    return replace(neighbour, possible=possible or None)
