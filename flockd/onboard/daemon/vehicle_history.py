"""The vehicle's states of the last seconds, interpolated at the time of a frame."""

from __future__ import annotations

import bisect
from collections import deque
from itertools import pairwise

import numpy as np

from flockd.core import services
from flockd.core.messages import FloatArray, RangeReading, VehicleState
from flockd.flight.geometry import rotation_from_vector, vector_from_rotation

HISTORY_S = services.VEHICLE_STATE.timeout


class VehicleHistory:
    """The vehicle's states of the last `HISTORY_S` seconds."""

    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque()

    def add(self, state: VehicleState) -> None:
        """Adds the newest state; one that is not newer than the last is ignored."""
        if not self._states or state.time_s > self._states[-1].time_s:
            self._states.append(state)
        while self._states[-1].time_s - self._states[0].time_s > HISTORY_S:
            self._states.popleft()

    def at(self, time_s: float) -> VehicleState | None:
        """The state at that time, interpolated; the newest for a time of another clock; None before the first."""
        if not self._states:
            return None
        if not self._states[0].time_s - HISTORY_S <= time_s <= self._states[-1].time_s + HISTORY_S:
            return self._states[-1]
        later = bisect.bisect_left(self._states, time_s, key=lambda state: state.time_s)
        if later in (0, len(self._states)):
            return self._states[max(0, later - 1)]
        return _between(self._states[later - 1], self._states[later], time_s)

    def moved_since(self, time_s: float) -> FloatArray:
        """(3,) m NED from where the vehicle was then to where it was last, by its velocities; 0 where none are known.

        Positions of an autopilot jump when its estimator is reset; velocities hardly do.
        """
        then = self.at(time_s)
        states = [*([] if then is None else [then]), *(one for one in self._states if one.time_s > time_s)]
        known = [(one.time_s, one.velocity_ned) for one in states if one.velocity_ned is not None]
        moved = np.zeros(3)
        for (before_s, before), (after_s, after) in pairwise(known):
            moved += (after_s - before_s) * (before + after) / 2
        return moved


def _between(before: VehicleState, after: VehicleState, time_s: float) -> VehicleState:
    """At constant rates of turn and motion from the one to the other."""
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    turn = vector_from_rotation(before.R_ned_body.T @ after.R_ned_body)
    return VehicleState(
        time_s=time_s,
        R_ned_body=before.R_ned_body @ rotation_from_vector(share * turn),
        height_m=before.height_m + share * (after.height_m - before.height_m),
        velocity_ned=_between_vectors(before.velocity_ned, after.velocity_ned, share),
        position=_between_vectors(before.position, after.position, share),
        home_deg=after.home_deg,
        ground_range=_nearest_range(before.ground_range, after.ground_range, time_s),
        turn_rate=turn / (after.time_s - before.time_s),
    )


def _nearest_range(before: RangeReading | None, after: RangeReading | None, time_s: float) -> RangeReading | None:
    """The reading that was taken nearest to a time: ranges jump at edges, so that nothing is between two."""
    if before is None or after is None:
        return after or before
    return min(before, after, key=lambda reading: abs(reading.time_s - time_s))


def _between_vectors(before: FloatArray | None, after: FloatArray | None, share: float) -> FloatArray | None:
    """The later one where only that is known."""
    return after if before is None or after is None else before + share * (after - before)
