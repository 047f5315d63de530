"""What a drone learns in flight of the others' size, when it weaves for that, and whether ranges follow from it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.messages import (
    FloatArray,
    GroundEstimate,
    LearnedSize,
    Neighbour,
    Reason,
    ReasonKind,
    SizeStatus,
    VehicleState,
)
from flockd.flight.perception.maps import KnownSize
from flockd.flight.pilot.weave import Weave
from flockd.flight.tracking import Measurement
from flockd.flight.tracking.flock_size import FlockSize, SizeEstimate

_USED_BEYOND, _USED_UNTIL = 2.0, 1.5
"""The learned size is used once the sizes that the networks judge are off it by so many of its standard deviations,
root mean square, until they are so near: those of drones that they know they judge better. Where they say that they do
not know the drones it is used at once."""
_PLAUSIBLE = 2.0
"""A learned size is not used if it is more than so many times what the networks judge, or less than the share: none of
the families that they do not know is judged so wrong, but drones that rise together look larger."""
_MOST_OFF = 0.5
"""One judged size counts as no farther off, in log size: it may be of something else."""
_OTHERWISE = 2.0
"""One neighbour's own size is used where it is off that of all by so many standard deviations of both."""
_CONTRADICTED = 3.0
"""A size that the configuration says is contradicted by one that is so many standard deviations off."""
_REFRESHED = 0.25
"""Ranges follow the estimate once it has moved by this share of its standard deviation."""
_JUDGED, _FEWEST_JUDGED, _NEAR_M = 400, 24, 8.0
"""So many judged sizes are kept, the newest, so many are enough, and of drones so near: farther ones look like much."""
_FEWEST_DOUBTS = 8
"""Of what the networks say that those may be off fewer are enough: it differs by five times between drones that they
know and others."""
_VIEWS_S = 0.45
"""Judged sizes nearer to each other in time are of one view, and only one of them counts."""
_SCATTER = 0.05
"""Standard deviation of the judged log sizes from which the networks do not know the drones. Of eleven families that
they know it is 0.003 to 0.03, of a twelfth, 0.26 m large, 0.16, and of two that they do not know 0.08 to 0.25."""
_DOUBTED = 0.15
"""What the networks' own standard deviations of the log sizes say that for, at the median: of families that they know
it is 0.01 to 0.06, of two that they do not know 0.31. Beyond this, the gate reckons with so much, twice its standard
deviations being near what those two are off: with all of it drones would stop before each other two thirds of the
time."""
_MIDDLE = 2.563
"""Standard deviations of a normal distribution within which 80 % are."""
_VAGUE = 0.07
"""A relative standard deviation beyond which the drone weaves, though it has seen another do so."""
_OLD_S = 600.0
"""The drone weaves again when its last weave is so long ago."""


class SizeLearner:
    """One drone's, for one flight."""

    def __init__(self, config: DroneConfig, learned: LearnedSize | None = None, *, flies: bool = True) -> None:
        """``learned``: before the flight. Without ``flies`` the autopilot or a person flies the drone: however it rises
        and sinks then, nobody answers, and it does not weave."""
        size_m = config.perception.drone_size_m
        self._said = None if size_m is None else SizeEstimate(size_m, config.perception.drone_size_sigma_m / size_m)
        self._weave, self._sizes = Weave(config.safety.gate), FlockSize()
        self._flies = flies
        self._allowed = flies and config.safety.first_flight_layer is None
        self._always = config.flocking.size == "weave"
        self._name = config.name
        self._random: np.random.Generator | None = None
        self._found: SizeEstimate | None = None
        self._used: SizeEstimate | None = None
        self._own: dict[int, SizeEstimate] = {}
        """By track, of those whose own size is another than that of all."""
        self._judged: list[float] = []
        """Log sizes of confirmed neighbours as the networks judged them, while nothing else is used."""
        self._doubts: list[float] = []
        """What they said those may be off."""
        self._looks_m = 0.0
        """Their median."""
        self._unjudged_s = math.inf
        """Since the newest of them."""
        self._wove_s: float | None = None
        self._was_doubted = False
        """Whether the networks said so before the flight."""
        self._contradiction: str | None = None
        if learned is not None and self._said is None:
            self._begin_with(learned)

    @property
    def used(self) -> KnownSize | None:
        """What ranges follow from; None: from what the networks judge, or the configuration says."""
        used = self._used
        return None if used is None else KnownSize(used.size_m, used.sigma * used.size_m, self._looks_m)

    @property
    def learned(self) -> LearnedSize | None:
        """What goes into the next flight; None: nothing but what the networks judge."""
        used = self._used
        return None if used is None else LearnedSize(used.size_m, used.sigma, self._looks_m, self._is_doubted)

    @property
    def status(self) -> SizeStatus | None:
        """As of now; None: nothing was learned yet."""
        if self._found is None:
            return SizeStatus(weaves=True) if self._weave.moves else None
        return SizeStatus(self._weave.moves, self._found.size_m, self._found.sigma, used=self._used is not None)

    @property
    def sentence(self) -> str:
        """For people, to be added to what the mission does; empty where there is nothing to say."""
        parts = []
        if self._weave.moves:
            parts.append("; weaves up and down to learn the others' size")
        sizes = [one.size_m for one in (*((self._used,) if self._used else ()), *self._own.values())]
        if sizes:
            parts.append(f"; has found the others to be {_listed(sizes)} m large")
        return "".join(parts)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """That the configuration says another size, or that the drone does not weave as it should."""
        return tuple(Reason(ReasonKind.SIZE, text) for text in (self._contradiction, self._weave.given_up) if text)

    def see(
        self, interval_s: float, way: FloatArray, measured: Mapping[int, Measurement], neighbours: Sequence[Neighbour]
    ) -> tuple[float, float] | None:
        """Take in a step's measurements by track, `interval_s` after the last.

        Where ranges now follow another size: the one until now, and that one, in metres.

        `way` (3,) metres NED is how far the drone went since then; of it the weave's part is what is vertical, while it
        moves the drone, and before a flight all that is.
        """
        wove = np.array([0.0, 0.0, way[2] if self._weave.moves or not self._flies else 0.0])
        self._sizes.step(interval_s, wove, {number: self._as_judged(one) for number, one in measured.items()})
        self._sizes.keep({one.track for one in neighbours})
        confirmed = {one.track for one in neighbours if one.confirmed}
        self._unjudged_s += interval_s
        if self._used is None and self._unjudged_s >= _VIEWS_S:
            self._unjudged_s = 0.0
            judged = confirmed - self._own.keys()
            known = [one for number, one in measured.items() if number in judged and one.range_m < _NEAR_M]
            logs = [math.log(one.size_m) for one in known]
            self._judged = [*self._judged, *logs][-_JUDGED:]
            self._doubts = [*self._doubts, *(one.log_size_sigma for one in known)][-_JUDGED:]
            self._looks_m = math.exp(float(np.median(self._judged))) if self._judged else 0.0
        self._found = self._sizes.of_looks(self._looks_m) if self._judged else None
        before_m = self._looks_m if self._used is None else self._used.size_m
        changed = self._choose()
        return (before_m, self._used.size_m) if changed and self._used is not None else None

    def own_sizes(self, neighbours: Sequence[Neighbour]) -> dict[int, float]:
        """In metres by track, of those that have just been found to be otherwise than all, or than they were.

        After `see`. In a flock of several types not all are alike, however they look.
        """
        self._own = {one.track: self._own[one.track] for one in neighbours if one.track in self._own}
        if self._said is not None:
            return {}
        changed = {}
        of_all_m = self._looks_m if self._used is None else self._used.size_m
        for number in [one.track for one in neighbours if one.confirmed]:
            found, own = self._sizes.of_track(number), self._own.get(number)
            if found is None or not self._may_be(found):
                continue
            if own is None:
                is_new = found.deviations(of_all_m, found.sigma) > _OTHERWISE
            else:
                is_new = found.deviations(own.size_m) > _REFRESHED
            if is_new:
                self._own[number] = found
                changed[number] = found.size_m
        return changed

    def _begin_with(self, learned: LearnedSize) -> None:
        self._used = self._found = SizeEstimate(learned.size_m, learned.sigma)
        self._looks_m, self._judged = learned.looks_m, [math.log(learned.looks_m)]
        self._was_doubted = learned.doubted
        self._sizes.remember(learned.looks_m, self._used)

    def _may_be(self, found: SizeEstimate) -> bool:
        return self._looks_m > 0.0 and 1 / _PLAUSIBLE < found.size_m / self._looks_m < _PLAUSIBLE

    @property
    def _is_unknown_type(self) -> bool:
        """Whether the networks judge the others' size otherwise from view to view, or say that they do not know it."""
        if self._said is not None:
            return False
        if self._is_doubted:
            return True
        if len(self._judged) < _FEWEST_JUDGED:
            return False
        low, high = np.quantile(self._judged, [0.1, 0.9])
        return float(high - low) > _SCATTER * _MIDDLE

    @property
    def _is_doubted(self) -> bool:
        """Whether the networks say, or did before the flight, that they do not know the others' size."""
        return self._was_doubted or self._doubt > _DOUBTED

    @property
    def _doubt(self) -> float:
        """What the networks say that the judged log sizes may be off: a standard deviation."""
        return float(np.median(self._doubts)) if len(self._doubts) >= _FEWEST_DOUBTS else 0.0

    def _as_judged(self, measurement: Measurement) -> Measurement:
        """With the range that follows from the size that the networks judge, as far as that is still known."""
        if self._used is None or not math.isclose(measurement.size_m, self._used.size_m):
            return measurement
        return measurement.of_size(self._looks_m)

    def _choose(self) -> bool:
        """Whether the size that is used has changed."""
        found, used = self._found, self._used
        if found is None:
            return False
        if self._said is not None:
            if self._contradiction is None and found.deviations(self._said.size_m, self._said.sigma) > _CONTRADICTED:
                self._contradiction = (
                    f"size: perception.drone_size_m says {self._said.size_m:.2f} m, and the flight shows "
                    f"{found.size_m:.2f} +-{found.sigma * found.size_m:.2f} m; measure the drones"
                )
            return False
        judged = np.minimum(np.abs(np.array(self._judged) - math.log(found.size_m)), _MOST_OFF)
        off = math.inf if self._is_doubted else float(np.sqrt(np.mean(judged**2))) / found.sigma
        if not self._may_be(found):
            self._used = None
        elif used is None:
            self._used = found if off > _USED_BEYOND else None
        elif off < _USED_UNTIL:
            self._used = None
        elif found.deviations(used.size_m) > _REFRESHED:
            self._used = found
        return self._used is not used

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
        if self._random is None:
            seed = vehicle.R_ned_body.tobytes() + np.float64(vehicle.height_m).tobytes()
            self._random = np.random.default_rng(zlib.crc32(seed, zlib.crc32(self._name.encode())))
        if self._weave.moves:
            self._wove_s = time_s
        is_old = self._wove_s is None or time_s - self._wove_s > _OLD_S
        asked = self._allowed and not ends and (self._always or self._is_unknown_type)
        is_vague = self._found is None or self._found.sigma > _VAGUE
        needed = asked and (self._weave.moves or is_vague or is_old)
        above_ground_m = vehicle.height_m if ground is None else ground.height_m
        return self._weave.height(
            time_s, vehicle.height_m, above_ground_m, wanted_m, neighbours, self._random, needed=needed
        )

    def cautious(self, neighbours: Sequence[Neighbour]) -> tuple[Neighbour, ...]:
        """With what the size may be off in the ranges that the gate reckons with: it errs alike in all steps.

        That of the learned size; before, of drones that the networks do not know, `_DOUBTED`.
        """
        return tuple(_as_uncertain(one, self._sigma_of(one.track)) for one in neighbours)

    def _sigma_of(self, track: int) -> float:
        own = self._own.get(track, self._used)
        if own is not None:
            return own.sigma
        if self._said is not None or self._doubt <= _DOUBTED:
            return 0.0
        return min(_DOUBTED, math.inf if self._found is None else _USED_BEYOND * self._found.sigma)


def _listed(sizes_m: Sequence[float]) -> str:
    """Each once, as people read them."""
    *words, last = dict.fromkeys(f"{size_m:.2f}" for size_m in sorted(sizes_m))
    return f"{', '.join(words)} and {last}" if words else last


def _as_uncertain(neighbour: Neighbour, sigma: float) -> Neighbour:
    if sigma == 0.0:
        return neighbour
    possible = tuple(
        replace(one, range_sigma_m=math.hypot(one.range_sigma_m, sigma * float(np.linalg.norm(one.position))))
        for one in neighbour.possible or ()
    )
    return replace(neighbour, possible=possible or None)
