"""How hard drones manoeuvre just now, by the own drone's motion."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import FloatArray

_OF_MEANS = 2.0 / 3.0
"""White acceleration noise of density q changes the mean velocity from one interval T to the next by a variance of
2/3 q T: the two means are integrals of the same random walk."""


class Manoeuvres:
    """The density of the acceleration noise that neighbours are taken to have: as much as the own drone had of late.

    What moves this drone, gusts, a turn of the flock or a tree in the way, moves its neighbours too. Never less than
    the parameters say, and at first as much as they say for that. North and east have one density, down has its own.
    """

    def __init__(self, parameters: TrackingParameters) -> None:
        self._least = parameters.acceleration_sigma_m_s2**2 * parameters.manoeuvre_time_s
        self._memory_s = parameters.own_manoeuvre_memory_s
        self._shortest_s = parameters.evidence_interval_s / 2
        self._own: FloatArray = np.full(3, parameters.first_acceleration_sigma_m_s2**2 * parameters.manoeuvre_time_s)
        self._last: tuple[FloatArray, float] | None = None
        """Velocity (3,) m/s of the last interval, and its variance an axis."""
        self._way: FloatArray = np.zeros(3)
        self._way_variance = 0.0
        self._interval_s = 0.0

    @property
    def density(self) -> FloatArray:
        """(3,) m^2/s^3, north, east and down."""
        return np.maximum(self._least, self._own)

    def see(self, own_displacement: FloatArray | None, sigma_m: float, interval_s: float) -> None:
        """The way (3,) NED metres that the own drone went in an interval, and its deviation an axis; None: not known.

        What that deviation adds to the changes of velocity is taken off again, so that errors are no manoeuvres.
        """
        if own_displacement is None or interval_s <= 0:
            self._last = None
            self._begin_interval()
            return
        self._way = self._way + own_displacement
        self._way_variance += sigma_m**2
        self._interval_s += interval_s
        if self._interval_s < self._shortest_s:  # a velocity would be more error than motion
            return
        taken_s, velocity = self._interval_s, self._way / self._interval_s
        variance = self._way_variance / taken_s**2
        if self._last is not None:
            before, variance_before = self._last
            excess = ((velocity - before) ** 2 - variance - variance_before) / (_OF_MEANS * taken_s)
            level = excess[:2].mean()
            keep = math.exp(-taken_s / self._memory_s)
            self._own = np.maximum(keep * self._own + (1 - keep) * np.array([level, level, excess[2]]), 0.0)
        self._last = velocity, variance
        self._begin_interval()

    def _begin_interval(self) -> None:
        self._way = np.zeros(3)
        self._way_variance, self._interval_s = 0.0, 0.0
