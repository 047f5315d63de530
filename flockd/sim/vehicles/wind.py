"""Gusts over open ground: a turbulent wind field, so that drones near each other are pushed nearly alike."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np

from flockd.core.messages import FloatArray
from flockd.sim.scenario import VehicleConfig

GUST_TIME_S = 2.0
"""How long a gust lasts at one place: its length over the mean wind that carries the field along."""
_MODES = 128


class GustField(NamedTuple):
    """What gusts add to the acceleration of a drone, at each place and time.

    An isotropic, incompressible, Gaussian field in three dimensions as a sum of plane waves (R. Kraichnan, "Diffusion
    by a random velocity field", Physics of Fluids 13(1), 1970), which the mean wind carries along as it is (G. Taylor's
    hypothesis). Its spectrum is the one whose sections along the wind and across it are Dryden's of MIL-F-8785C, 3.7.2:
    E(k) ~ (L k)^4 / (1 + (L k)^2)^3. The wind's correlation at a distance r is so exp(-r / L) along r, and
    (1 - r / 2 L) exp(-r / L) across.
    """

    waves: FloatArray
    """(m, 8) of each: the wave vector (1/m, NED), the angular frequency (1/s), and the pushes (m/s^2, north and
    east) that go with its cosine and its sine. (0, 8): no gusts."""

    @classmethod
    def of(cls, vehicle: VehicleConfig, seed: int) -> Self:
        """The field in which such a vehicle's velocity deviates by `gust_m_s` while its setpoint stays the same."""
        if not vehicle.gust_m_s:
            return cls(np.empty((0, 8)))
        random, length_m = np.random.default_rng(seed), vehicle.gust_length_m
        toward = random.normal(size=(_MODES, 3))
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        k = _wave_numbers(_MODES)[:, None] / length_m * toward
        bearing_rad = random.uniform(0.0, 2 * math.pi)
        wind_m_s = length_m / GUST_TIME_S * np.array([math.cos(bearing_rad), math.sin(bearing_rad), 0.0])
        sigma = push_sigma_m_s2(vehicle) * math.sqrt(1.5 / _MODES)  # two of three directions are across k
        free = random.normal(scale=sigma, size=(2, _MODES, 3))
        across = free - (free * toward).sum(axis=2, keepdims=True) * toward
        return cls(np.column_stack([k, k @ wind_m_s, across[0, :, :2], across[1, :, :2]]))

    def push(self, time_s: float, positions: FloatArray) -> FloatArray:
        """(n, 2) m/s^2 north and east at places (n, 3) m NED."""
        phase = positions @ self.waves[:, :3].T - time_s * self.waves[:, 3]
        pushes: FloatArray = np.cos(phase) @ self.waves[:, 4:6] + np.sin(phase) @ self.waves[:, 6:]
        return pushes


def push_sigma_m_s2(vehicle: VehicleConfig) -> float:
    """Standard deviation of the gusts' push, each axis, by which the velocity deviates by `gust_m_s`.

    A lag of time constant tau passes a^2 tau times the integral of R(t) exp(-t / tau) of the variance of a push a with
    autocorrelation R, here the mean of those along the wind and across it.
    """
    tau, rate = vehicle.velocity_time_constant_s, 1 / vehicle.velocity_time_constant_s + 1 / GUST_TIME_S
    along = 1 / rate
    across = along - 1 / (2 * GUST_TIME_S * rate**2)
    return vehicle.gust_m_s / math.sqrt(tau * (along + across) / 2)


def _wave_numbers(count: int) -> FloatArray:
    """(count,) wave numbers times L, of equal shares of the energy: the middle of each in x^4 / (1 + x^2)^3."""
    x = np.tan(np.linspace(0.0, math.pi / 2, 20_001)[:-1])
    below = 2 / math.pi * (np.arctan(x) - x * (5 * x**2 + 3) / (3 * (1 + x**2) ** 2))
    return np.interp((np.arange(count) + 0.5) / count, below, x)
