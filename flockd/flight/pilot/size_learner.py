"""The size of the other drones: its uncertainty for the gate, and how a drone learns it in flight if configured.

An apparent size gives the range only in units of the drone's size. If the own drone moves by a known distance and its
neighbours do not follow, their bearings shift by that distance over the range, which gives metres. Flock mates follow
every horizontal motion, so the drone weaves up and down. In units of the drones' size, a neighbour's height below the
own drone is a smooth course of its own plus the own weave over the size. That is linear in the scale, 1 / size, which
all neighbours share.
"""

from __future__ import annotations

import math
import zlib
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray, GroundEstimate, LearnedSize, Neighbour, SizeStatus, VehicleState
from flockd.flight.safety.approach import COLUMN
from flockd.flight.tracking import Measurement

_ASKED_M = 0.43
"""Amplitude of the commanded height; the drone moves by about 0.34 m."""
PERIOD_S, DURATION_S = 6.0, 12.0
"""Period of the sine, and duration of a weave."""
_DRAWN_WITHIN_S = 8.0
"""The start is drawn from an interval of this length, so that not all drones weave at once; if the drone may not weave
then, it is drawn again from half of it."""
_CLIMB_M_S = 0.2
"""A neighbour with a higher vertical speed is weaving; the drone waits until half a period after it."""
_ROOM_M = 0.5
"""Largest distance from the mission's height at the start, and margin to the gate's height limits: the lower one is
near the ground."""
_ABOVE_GROUND_M = 2.0
"""Least height above the ground at the start; the ground may be higher than at home."""
_KNOWN_SIGMA = 0.1
"""Relative standard deviation below which a learned size is used and the drone stops weaving."""
_LEAST_SIGMA = 0.04
"""Relative standard deviation added for errors that the model leaves out."""
_JUDGED_SIGMA = 0.5
"""Relative standard deviation of the networks' size before anything is learned."""
_PLAUSIBLE = 2.0
"""Largest factor between a learned size and the networks': drones that rise together look larger."""
_ROBUST_SIGMA, _TIMES = 2.5, 10
"""Standard deviations beyond which a track's scale loses weight, because it may be of a tree; iterations of the
weighting."""
_LASTS_S = PERIOD_S / (2 * math.pi)
"""Time between independent measurements: errors of bearings and heights persist, as an Ornstein-Uhlenbeck process. With
this time constant they have the most power at the weave's frequency."""
_JUDGED, _NEAR_M = 400, 8.0
"""Number of the networks' newest sizes that are kept, and largest range of their drones: farther ones are
unreliable."""
_FEWEST_DOUBTS, _DOUBTED = 8, 0.15
"""The networks do not know the drones if the median of this number of their standard deviations of log size is above
the limit; it is 0.01 to 0.06 for families of the training, 0.31 for two others. The gate then uses the limit, twice of
which is near the error of these two. With 0.31 drones would stop in front of each other most of the time."""


class SizeLearner:
    """The size learner of one drone, for one flight."""

    def __init__(self, config: DroneConfig, learned: LearnedSize | None = None, *, flies: bool = True) -> None:
        """``learned``: the size from an earlier flight. Without ``flies`` the autopilot or a person flies the drone,
        and it does not weave."""
        self._is_said = config.perception.drone_size_m is not None
        self._learns, self._gate, self._name = config.flocking.size == "learn", config.safety.gate, config.name
        self._weave: Weave | None = None
        self._may_weave = flies and config.safety.first_flight_layer is None
        self.learned = learned if self._learns else None
        """The size for ranges and for the next flight; None: the networks' or the configured one is used."""
        self._known: tuple[float, float] | None = None
        """The scale, 1 / size in 1/m, from all weaves, and its variance."""
        self._judged: deque[float] = deque(maxlen=_JUDGED)
        """Sizes of confirmed neighbours by the networks, in m."""
        self._doubts: deque[float] = deque(maxlen=_JUDGED)
        """Their standard deviations of log size, by the networks."""
        self._risen_m = 0.0
        self._shown: defaultdict[int, list[tuple[float, float, float]]] = defaultdict(list)
        """Of the current weave, by track: time in s, height of the own drone since the flight began in m, and the
        neighbour's height below it in drone sizes."""

    @property
    def status(self) -> SizeStatus | None:
        """The size as of now; None: nothing is learned."""
        weaves = self._weave is not None and self._weave.moves
        if self.learned is not None:
            return SizeStatus(weaves, self.learned.size_m, self.learned.sigma)
        return SizeStatus(weaves) if weaves else None

    @property
    def sentence(self) -> str:
        """A phrase for people, appended to the mission's; empty if there is nothing to say."""
        weaves = "; weaves up and down to learn the others' size" if self._weave and self._weave.moves else ""
        return weaves + (f"; has found the others to be {self.learned.size_m:.2f} m large" if self.learned else "")

    def see(
        self, time_s: float, sunk_m: float, measured: Mapping[int, Measurement], neighbours: Sequence[Neighbour]
    ) -> float | None:
        """Takes a step's measurements by track. Returns the size in metres for ranges from now on, if it is new.

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
        """Robust mean of the known scale and of the scale that each track showed, by iterated weighting."""
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
        """The height to command, with the weave added, as of `Wanted`. ``ends``: the mission is over."""
        if not self._learns:
            return wanted_m
        if self._weave is None:  # not by name: simulated drones may share one
            begun = np.array([vehicle.height_m, *vehicle.R_ned_body.flat])
            self._weave = Weave(self._gate, self._name.encode() + begun.tobytes())
        needed = self._may_weave and self.learned is None and not ends
        above_ground_m = vehicle.height_m if ground is None else ground.height_m
        return self._weave.height(time_s, vehicle.height_m, above_ground_m, wanted_m, neighbours, needed=needed)

    def cautious(self, neighbours: Sequence[Neighbour]) -> tuple[Neighbour, ...]:
        """The neighbours with the size's uncertainty, the same in all steps, added to their range sigmas for the gate.

        It is that of the learned size; before, `_DOUBTED` for drones that the networks do not know.
        """
        if self.learned is not None:
            sigma = self.learned.sigma
        elif len(self._doubts) >= _FEWEST_DOUBTS and np.median(self._doubts) > _DOUBTED:
            sigma = _DOUBTED
        else:
            return tuple(neighbours)
        return tuple(_as_uncertain(one, sigma) for one in neighbours)


def scale_of(shown: FloatArray) -> tuple[float, float] | None:
    """The scale, 1 / size in 1/m, and its variance, from one track in a weave, (n, 3) as in `SizeLearner`.

    Least squares of the neighbour's height over the own height and a parabola in time, its own course. None: too few
    measurements, or the own drone did not move otherwise.
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


class Weave:
    """Decides when one drone weaves, twelve seconds up and down, and at which height.

    The flocking law is horizontal, so neighbours do not follow. One drone weaves at a time: if two rise together, no
    bearing shifts.
    """

    def __init__(self, gate: GateParameters, own: bytes) -> None:
        """``own``: bytes that no two drones share, so that they draw different times."""
        self._gate = gate
        self._random = np.random.default_rng(zlib.crc32(own))
        self._next_s: float | None = None
        self._climbed_s = -math.inf
        """When a neighbour last rose or sank."""
        self._began_s: float | None = None
        self._base_m: float | None = None
        """Height at which the newest weave began; the drone stays at it if the mission gives no height."""
        self._wanted_m: float | None = None
        """The mission's height when it began: a flock changes its height together, so the weave then ends."""

    @property
    def moves(self) -> bool:
        """Whether the drone weaves now."""
        return self._began_s is not None

    def is_over(self, time_s: float) -> bool:
        """Whether the current weave has lasted its full duration."""
        return self._began_s is not None and time_s - self._began_s >= DURATION_S

    def height(
        self,
        time_s: float,
        height_m: float,
        above_ground_m: float,
        wanted_m: float | None,
        neighbours: Sequence[Neighbour],
        *,
        needed: bool,
    ) -> float | None:
        """The height to command instead of the mission's, `wanted_m`; None: the height at which the flight began.

        The drone is at `height_m` above home. `needed`: there is something to learn, and nothing forbids it.
        """
        if any(one.confirmed and abs(one.velocity[2]) > _CLIMB_M_S for one in neighbours):
            self._climbed_s = time_s
        if self._began_s is None:
            begin_m = height_m if wanted_m is None else wanted_m
            if needed and self._begins(time_s, height_m, above_ground_m, begin_m, neighbours):
                self._began_s, self._base_m, self._wanted_m = time_s, height_m, wanted_m
        elif not needed or wanted_m != self._wanted_m or self.is_over(time_s):
            self._began_s, self._next_s = None, time_s + _DRAWN_WITHIN_S  # others first
        base_m = self._base_m if wanted_m is None else wanted_m
        if self._began_s is None or base_m is None:
            return base_m
        return base_m + _ASKED_M * math.sin(2 * math.pi * (time_s - self._began_s) / PERIOD_S)

    def _begins(
        self, time_s: float, height_m: float, above_ground_m: float, base_m: float, neighbours: Sequence[Neighbour]
    ) -> bool:
        if self._next_s is None:
            self._next_s = time_s + self._random.uniform(0.0, _DRAWN_WITHIN_S)
        if time_s < self._next_s:
            return False
        self._next_s = time_s + self._random.uniform(0.0, _DRAWN_WITHIN_S / 2)
        room_m = min(base_m - self._gate.min_height_m, self._gate.max_height_m - base_m)
        seen = [one for one in neighbours if one.confirmed]
        column_m = COLUMN * self._gate.degraded_separation_m
        return (
            above_ground_m >= _ABOVE_GROUND_M
            and abs(height_m - base_m) <= _ROOM_M
            and room_m >= _ASKED_M + _ROOM_M
            and time_s - self._climbed_s >= PERIOD_S / 2
            and bool(seen)
            and all(math.hypot(*one.position[:2]) >= column_m for one in seen)
        )
