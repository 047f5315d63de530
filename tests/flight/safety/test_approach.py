"""How fast a drone may fly towards a neighbour, and what is expected of the vehicle: against the analytic solution."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.flight.safety import Action, Gate, GateParameters
from flockd.flight.safety.approach import towards_neighbours
from tests.make import around, request


@pytest.mark.parametrize(("distance_m", "comes_m_s"), [(2.0, 3.0), (2.0, 1.4), (9.0, 1.5), (30.0, 2.0)])
@pytest.mark.parametrize("neighbour_reaction_s", [0.6, 1.0, 1.5])
def test_both_stop_within_the_distance_left_and_the_drone_stands_where_no_speed_would_do(
    distance_m: float, comes_m_s: float, neighbour_reaction_s: float
) -> None:
    """(v + w) r + v^2 / 2b + w^2 / 2b = distance left, by bisection; never a speed away from it."""
    p = GateParameters(neighbour_reaction_s=neighbour_reaction_s)
    separation_m = 1.0

    def needed_m(speed: float, other: float, reaction_s: float) -> float:
        return (speed + other) * reaction_s + (speed**2 + other**2) / (2 * p.braking_m_s2)

    def fastest(other: float, reaction_s: float) -> float:
        low, high = 0.0, 50.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            fits = needed_m(middle, middle if math.isnan(other) else other, reaction_s) <= distance_m - separation_m
            low, high = (middle, high) if fits else (low, middle)
        return low

    _, most_m_s = towards_neighbours(p, np.array([[distance_m, 0.0, 0.0]]), np.array([[-comes_m_s, 0.0]]), separation_m)
    expected = min(fastest(comes_m_s, neighbour_reaction_s), fastest(math.nan, p.reaction_s))
    assert most_m_s == pytest.approx([expected], abs=1e-6)


def test_a_vehicle_that_follows_as_expected_has_no_error_at_whatever_time_it_flies() -> None:
    """A first-order lag of `reaction_s` behind a step of the setpoint, in closed form."""
    p = GateParameters(max_acceleration_m_s2=50.0)
    gate, speed, errors = Gate(p), 0.0, []
    for tick in range(100):
        now_s = 500.0 + 0.05 * tick
        gate.step(now_s, request(now_s, [1.0, 0.0], Action.FLY, around(velocity=[speed, 0.0])))
        errors.append(gate.velocity_error_m_s)
        speed = 1.0 - math.exp(-0.05 * tick / p.reaction_s)
    assert max(errors) < 0.05
