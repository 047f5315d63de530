"""From the law's sums to a command, and the vehicles' flight towards it, for all drones of many flights. Compiled.

The same motion as `flockd.sim.vehicles.Vehicles`, which a test holds equal: a first-order lag of limited acceleration,
heights as by a critically damped controller. Attitudes move nothing and are left out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import njit

from flockd.core.config.scenario import VehicleConfig
from flockd.sim.vehicles import MAX_LEAN_M_S2

MAX_SUBSTEP_S = 0.02
MAX_CLIMB_M_S = 1.5
CLIMB_TIME_S = 1.0
_BLOCK = 128
"""Drones that are moved together: their states stay in the processor's fastest memory."""


class Substeps(NamedTuple):
    """How a step is divided."""

    times: int
    dt_s: float
    answer_per_s: float
    """The mean acceleration over `dt_s` for each m/s between setpoint and velocity."""
    max_acceleration_m_s2: float

    @classmethod
    def of(cls, vehicle: VehicleConfig, step_s: float) -> Substeps:
        """The substeps of a vehicle that gets a setpoint every `step_s`."""
        count = math.ceil(step_s / MAX_SUBSTEP_S - 1e-9)
        dt_s = step_s / count
        answer_per_s = -math.expm1(-dt_s / vehicle.velocity_time_constant_s) / dt_s
        return cls(count, dt_s, answer_per_s, vehicle.max_acceleration_m_s2)


@njit(nogil=True, cache=True, error_model="numpy")
def commands(
    begin: int, end: int, sums: Any, desired: Any, following: float, own: Any, lookahead_s: float, most_u: float,
    most_v: float, out: Any,
) -> None:  # fmt: skip
    """Velocities to ask for, (2, flights * n) m/s: `FlockingLaw.limited`, with u_vf of Eq. 42 added.

    `sums` (2, flights * n) m/s^2, `desired` (2, flights * n) m/s, `own` (2, flights * n) m/s.
    """
    for i in range(begin, end):
        un = sums[0, i] + following * desired[0, i]
        ue = sums[1, i] + following * desired[1, i]
        norm = math.sqrt(un * un + ue * ue)
        if norm > most_u:
            un *= most_u / norm
            ue *= most_u / norm
        vn = own[0, i] + un * lookahead_s
        ve = own[1, i] + ue * lookahead_s
        norm = math.sqrt(vn * vn + ve * ve)
        if norm > most_v:
            vn *= most_v / norm
            ve *= most_v / norm
        out[0, i] = vn
        out[1, i] = ve


@njit(nogil=True, cache=True, error_model="numpy")
def fly(
    begin: int, end: int, begin_s: float, states: Any, blown: Any, setpoints: Any, gusts: Any, substeps: Any
) -> None:  # fmt: skip
    """Moves drones on by one step: `states` (6, flights * n) in place, towards `setpoints` (2, flights * n) m/s.

    `blown` (2, flights * n) m/s, in place, is what of the velocities gusts added, and `gusts` (flights, m, 8) are the
    waves of each flight's `GustField`.
    """
    count, dt, answer, most = substeps
    x, y, z, vx, vy, bx, by = states[0], states[1], states[2], states[3], states[4], blown[0], blown[1]
    n = states.shape[1] // gusts.shape[0]
    gusty = gusts.shape[1] > 0
    for a in range(begin, end, _BLOCK):
        b = min(a + _BLOCK, end)
        for s in range(count):
            for i in range(a, b):
                an = (setpoints[0, i] - (vx[i] - bx[i])) * answer
                ae = (setpoints[1, i] - (vy[i] - by[i])) * answer
                share = min(1.0, most / max(math.sqrt(an * an + ae * ae), 1e-12))
                an *= share
                ae *= share
                if gusty:
                    ln = an - bx[i] * answer
                    le = ae - by[i] * answer
                    share = min(1.0, MAX_LEAN_M_S2 / max(math.sqrt(ln * ln + le * le), 1e-12))
                    push_n, push_e = _push(gusts[i // n], x[i], y[i], z[i], begin_s + s * dt)
                    bx[i] += (share * ln - an + push_n) * dt
                    by[i] += (share * le - ae + push_e) * dt
                    an = share * ln + push_n
                    ae = share * le + push_e
                x[i] += vx[i] * dt + an * (dt * dt / 2)
                y[i] += vy[i] * dt + ae * (dt * dt / 2)
                vx[i] += an * dt
                vy[i] += ae * dt


@njit(nogil=True, cache=True, error_model="numpy")
def _push(waves: Any, north: float, east: float, down: float, time_s: float) -> tuple[float, float]:
    """As `GustField.push`, of one place, m NED."""
    push_n = push_e = 0.0
    for w in range(waves.shape[0]):
        phase = waves[w, 0] * north + waves[w, 1] * east + waves[w, 2] * down - waves[w, 3] * time_s
        cos, sin = math.cos(phase), math.sin(phase)
        push_n += waves[w, 4] * cos + waves[w, 6] * sin
        push_e += waves[w, 5] * cos + waves[w, 7] * sin
    return push_n, push_e


@njit(nogil=True, cache=True, error_model="numpy")
def climb(begin: int, end: int, states: Any, heights: Any, substeps: Any) -> None:
    """Heights after one step: `heights` (flights * n) m, up positive; NaN: as high as now."""
    count, dt = substeps[0], substeps[1]
    down, sink = states[2], states[5]
    for i in range(begin, end):
        for _ in range(count):
            wanted = 0.0
            if not math.isnan(heights[i]):
                wanted = min(max((-heights[i] - down[i]) / CLIMB_TIME_S, -MAX_CLIMB_M_S), MAX_CLIMB_M_S)
            sink[i] += (wanted - sink[i]) * min(1.0, 4.0 * dt / CLIMB_TIME_S)
            down[i] += sink[i] * dt
            if down[i] >= 0.0:
                sink[i] = min(sink[i], 0.0)
                down[i] = 0.0
