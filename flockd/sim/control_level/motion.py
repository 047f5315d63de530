"""The vehicles' flight towards their commands, for all drones of many flights.

The same motion as `flockd.sim.vehicles.vehicles.Vehicles`, which a test holds equal: a first-order lag of limited
acceleration, heights as by a critically damped controller. Attitudes move nothing and are left out.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray
from flockd.sim.scenario import VehicleConfig
from flockd.sim.vehicles.vehicles import CLIMB_TIME_S, MAX_CLIMB_M_S, MAX_LEAN_M_S2, limit_norms
from flockd.sim.vehicles.wind import GustField

_MAX_SUBSTEP_S = 0.02


class Motion:
    """The vehicles of a batch of flights; remembers what gusts added to their velocities."""

    def __init__(self, vehicle: VehicleConfig, seeds: list[int], drones: int) -> None:
        """`seeds` of the flights, of so many `drones` each."""
        self._vehicle, self._shape = vehicle, (len(seeds), drones)
        self._gusts = GustField(np.stack([GustField.of(vehicle, seed).waves for seed in seeds]))
        self._blown = np.zeros((len(seeds) * drones, 2))

    def fly(
        self, begin_s: float, interval_s: float, states: FloatArray, setpoints: FloatArray, heights: FloatArray
    ) -> None:
        """Moves `states` (6, flights, n) in place for `interval_s`, towards `setpoints` (2, flights, n) m/s.

        `heights` (flights, n) m, up positive; NaN: as high as now.
        """
        count = math.ceil(interval_s / _MAX_SUBSTEP_S - 1e-9)
        dt_s = interval_s / count
        climbs = bool(np.isfinite(heights).any())
        wanted, place, velocity = (part.reshape(len(part), -1).T for part in (setpoints, states[:3], states[3:]))
        for substep in range(count):
            self._substep(begin_s + substep * dt_s, dt_s, place, velocity, wanted)
            if climbs:
                _climb(dt_s, place[:, 2], velocity[:, 2], heights.reshape(-1))

    def _substep(self, now_s: float, dt_s: float, place: FloatArray, velocity: FloatArray, wanted: FloatArray) -> None:
        answer_per_s = -math.expm1(-dt_s / self._vehicle.velocity_time_constant_s) / dt_s
        most_m_s2 = self._vehicle.max_acceleration_m_s2
        acceleration = limit_norms((wanted - (velocity[:, :2] - self._blown)) * answer_per_s, most_m_s2)
        if self._gusts.waves.size:
            steered = limit_norms(acceleration - self._blown * answer_per_s, MAX_LEAN_M_S2)
            push = self._gusts.push(now_s, place.reshape(*self._shape, 3)).reshape(-1, 2)
            self._blown = self._blown + (steered - acceleration + push) * dt_s
            acceleration = steered + push
        place[:, :2] += velocity[:, :2] * dt_s + acceleration * (dt_s**2 / 2)
        velocity[:, :2] += acceleration * dt_s


def _climb(dt_s: float, down: FloatArray, sink: FloatArray, heights: FloatArray) -> None:
    wanted = np.clip(np.nan_to_num((-heights - down) / CLIMB_TIME_S), -MAX_CLIMB_M_S, MAX_CLIMB_M_S)
    sink += (wanted - sink) * min(1.0, 4.0 * dt_s / CLIMB_TIME_S)
    down += sink * dt_s
    landed = down >= 0.0
    sink[landed], down[landed] = np.minimum(sink[landed], 0.0), 0.0
