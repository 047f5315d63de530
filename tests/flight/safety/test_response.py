"""The gate closes the loop: in wind the velocity that results is the one that it lets through, within all limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from flockd.core.messages import FloatArray, Wanted
from flockd.flight.safety import Action, Gate, GateParameters, Permission, Request, Surroundings
from flockd.flight.safety.response import ResponseObserver

TICK_S = 0.05
RESPONSE_S = 0.25
FREE = GateParameters(fence_radius_m=None, response_s=RESPONSE_S)
NOWHERE = Surroundings(np.zeros(2), np.zeros(2), 0.0, np.empty((0, 3)), np.empty((0, 2)), 5.0)


def flown(
    asked: ArrayLike,
    wind: ArrayLike,
    gate: Gate,
    *,
    around: Surroundings = NOWHERE,
    response_s: float = RESPONSE_S,
    late: int = 0,
    ticks: int = 200,
    action: Action = Action.FLY,
) -> tuple[FloatArray, FloatArray]:
    """Setpoints and velocities (ticks, 2) m/s of a drone that settles at its setpoint and the ``wind``, from rest.

    It is a first-order lag, whose setpoints come so many ticks ``late``.
    """  # fmt: skip
    velocity, wanted = np.zeros(2), Wanted(np.array(asked, float), np.zeros(2), 0.0)
    setpoints, velocities = [np.zeros(2)] * late, []
    keep = math.exp(-TICK_S / response_s)
    for tick in range(ticks):
        now_s = tick * TICK_S
        request = Request(Permission(action, now_s), wanted, now_s, 5.0, replace(around, velocity=velocity))
        setpoint = gate.step(now_s, request).setpoint
        assert setpoint is not None
        setpoints.append(setpoint.velocity)
        velocity = keep * velocity + (1 - keep) * (setpoints[-1 - late] + np.array(wind))
        velocities.append(velocity)
    return np.array(setpoints[late:]), np.array(velocities)


def test_in_steady_wind_the_drone_flies_as_asked() -> None:
    setpoints, velocities = flown([1.0, -0.5], [-0.6, 0.8], Gate(FREE))
    np.testing.assert_allclose(velocities[-1], [1.0, -0.5], atol=1e-6)
    np.testing.assert_allclose(setpoints[-1], [1.6, -1.3], atol=1e-6)


def test_without_a_drift_it_does_not() -> None:
    _, velocities = flown([1.0, -0.5], [-0.6, 0.8], Gate(FREE.model_copy(update={"max_drift_m_s": 0.0})))
    np.testing.assert_allclose(velocities[-1], [0.4, 0.3], atol=1e-6)


@pytest.mark.parametrize("response_s", [0.12, 0.5])
@pytest.mark.parametrize("late", [0, 2, 4])
def test_a_drone_that_answers_otherwise_than_configured_settles_all_the_same(response_s: float, late: int) -> None:
    _, velocities = flown([1.0, 0.0], [-0.5, 0.5], Gate(FREE), response_s=response_s, late=late, ticks=400)
    np.testing.assert_allclose(velocities[-20:], np.tile([1.0, 0.0], (20, 1)), atol=0.01)
    assert np.abs(velocities).max() < 2.0


def test_a_drift_is_limited() -> None:
    gate = Gate(FREE)
    setpoints, _ = flown([0.0, 0.0], [3.0, 4.0], gate)
    np.testing.assert_allclose(gate.drift, [1.2, 1.6], rtol=1e-3)  # of 5 m/s, 2
    assert gate.gusts_m_s > gate.drift[1]
    np.testing.assert_allclose(setpoints[-1], [-1.2, -1.6], rtol=1e-3)


def test_what_is_sent_stays_within_the_speed_limit() -> None:
    setpoints, _ = flown([3.5, 0.0], [-1.5, 0.0], Gate(FREE))
    assert np.linalg.norm(setpoints, axis=1).max() <= FREE.max_speed_m_s


def test_blown_towards_a_neighbour_the_drone_does_not_move_there() -> None:
    """0.9 m north of it; the wind is such that a setpoint of standstill would be 0.5 m/s towards it."""
    around = replace(NOWHERE, neighbours=np.array([[0.9, 0.0, 0.0]]), neighbour_velocities=np.zeros((1, 2)))
    setpoints, velocities = flown([0.5, 0.2], [0.5, 0.0], Gate(FREE), around=around)
    np.testing.assert_allclose(velocities[-1], [0.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(setpoints[-1], [-0.5, 0.2], atol=1e-6)


def test_blown_away_from_a_neighbour_it_is_not_sent_there() -> None:
    """The wind may end at any time."""
    around = replace(NOWHERE, neighbours=np.array([[0.9, 0.0, 0.0]]), neighbour_velocities=np.zeros((1, 2)))
    setpoints, velocities = flown([0.5, 0.2], [-0.5, 0.0], Gate(FREE), around=around)
    assert setpoints[:, 0].max() <= 1e-9
    np.testing.assert_allclose(velocities[-1], [-0.5, 0.2], atol=1e-6)


def test_blown_from_a_neighbour_to_a_tree_it_stands() -> None:
    """What is comes before what could be, were the wind to end."""
    around = replace(
        NOWHERE, neighbours=np.array([[-0.9, 0.0, 0.0]]), neighbour_velocities=np.zeros((1, 2)),
        obstacles=np.array([[0.5, 0.0]]),
    )  # fmt: skip
    setpoints, velocities = flown([0.0, 0.0], [0.8, 0.0], Gate(FREE), around=around)
    np.testing.assert_allclose(velocities[-1], [0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(setpoints[-1], [-0.8, 0.0], atol=1e-6)


def test_blown_past_a_tree_it_counters_no_more_than_leads_there() -> None:
    """The tree is to the north-east, the wind blows north, and to the south a neighbour is near.

    Of the wind the half that leads to the tree, (0.4, 0.4), is taken off; the rest leads to nothing.
    """
    around = replace(
        NOWHERE, neighbours=np.array([[-0.9, 0.0, 0.0]]), neighbour_velocities=np.zeros((1, 2)),
        obstacles=np.array([[0.35, 0.35]]),
    )  # fmt: skip
    setpoints, velocities = flown([0.0, 0.0], [0.8, 0.0], Gate(FREE), around=around)
    np.testing.assert_allclose(setpoints[-1], [-0.4, -0.4], atol=1e-6)
    np.testing.assert_allclose(velocities[-1], [0.4, -0.4], atol=1e-6)


def test_a_drift_that_needs_all_of_the_speed_limit_leaves_none_for_what_is_asked() -> None:
    """Blown at 2 m/s to a tree in the north, and asked to fly east at 2 m/s: 2.5 m/s are allowed in all."""
    p = FREE.model_copy(update={"max_speed_m_s": 2.5})
    around = replace(NOWHERE, obstacles=np.array([[0.5, 0.0]]))
    setpoints, velocities = flown([0.0, 2.0], [2.0, 0.0], Gate(p), around=around)
    np.testing.assert_allclose(velocities[-1], [0.0, 0.5], atol=1e-6)
    assert np.linalg.norm(setpoints, axis=1).max() <= 2.5 + 1e-9


def test_a_drift_that_is_more_than_the_speed_limit_is_countered_before_all_else() -> None:
    p = FREE.model_copy(update={"max_speed_m_s": 1.0})
    setpoints, _ = flown([0.0, 0.5], [2.0, 0.0], Gate(p), around=replace(NOWHERE, obstacles=np.array([[0.5, 0.0]])))
    np.testing.assert_allclose(setpoints[-1], [-1.0, 0.0], atol=1e-6)


def test_measured_faster_than_a_limit_it_brakes_harder() -> None:
    """2 m from a neighbour that may begin to come, 0.75 v + v^2 / 3 = 0.5 m gives the limit."""
    limit = math.sqrt(0.75**2 + 1.5) - 0.75
    p = FREE.model_copy(update={"max_acceleration_m_s2": 1e6, "max_drift_m_s": 0.0})
    around = replace(NOWHERE, neighbours=np.array([[2.0, 0.0, 0.0]]), neighbour_velocities=np.zeros((1, 2)))
    sent = {}
    for measured in (0.0, 0.9):
        gate, here = Gate(p), replace(around, velocity=np.array([measured, 0.0]))
        for now_s in (0.0, TICK_S):
            request = Request(
                Permission(Action.FLY, now_s), Wanted(np.array([1.0, 0.0]), np.zeros(2), 0.0), now_s, 5.0, here
            )
            verdict = gate.step(now_s, request)
        assert verdict.setpoint is not None
        sent[measured] = float(verdict.setpoint.velocity[0])
    assert sent[0.0] == pytest.approx(limit, abs=1e-9)
    assert sent[0.9] == pytest.approx(limit - (0.9 - limit), abs=1e-9)


def test_while_another_flies_the_drone_nothing_is_learnt() -> None:
    """Standstill is offered, and the pilot flies at 2 m/s."""
    gate = Gate(FREE)
    flown([1.0, 0.0], [2.0, 0.0], gate, action=Action.OFFER)
    np.testing.assert_array_equal(gate.drift, [0.0, 0.0])
    assert gate.gusts_m_s == 0.0


def settled() -> ResponseObserver:
    """An observer of a drone that flies at 0.5 m/s north where it should stand."""
    observer = ResponseObserver(RESPONSE_S, 2.0)
    for _ in range(40):
        observer.step(np.array([0.5, 0.0]), np.zeros(2), TICK_S)
    assert observer.drift[0] == pytest.approx(0.5, abs=0.01)
    return observer


@pytest.mark.parametrize(
    ("velocity", "elapsed_s"),
    [((math.nan, 0.0), TICK_S), ((math.inf, 0.0), TICK_S), ((100.1, 0.0), TICK_S), ((1.0, 0.0), math.nan)],
)
def test_what_is_no_velocity_ends_the_drift_and_not_what_is_known_of_gusts(
    velocity: tuple[float, float], elapsed_s: float
) -> None:
    observer = settled()
    before = observer.gusts_m_s
    observer.step(np.array(velocity), np.zeros(2), elapsed_s)
    np.testing.assert_array_equal(observer.drift, [0.0, 0.0])
    assert observer.gusts_m_s == before > 0.0
    for _ in range(40):
        observer.step(np.array([0.5, 0.0]), np.zeros(2), TICK_S)
    assert observer.drift[0] == pytest.approx(0.5, abs=0.01)


def test_at_first_there_is_no_drift_and_100_m_s_is_a_velocity() -> None:
    observer = ResponseObserver(RESPONSE_S, 2.0)
    np.testing.assert_array_equal(observer.drift, [0.0, 0.0])
    for _ in range(2):
        observer.step(np.array([100.0, 0.0]), np.zeros(2), TICK_S)
    assert observer.drift[0] == pytest.approx(2.0)


def test_its_poles_are_10_per_second() -> None:
    """A drone that does not answer is pushed: with p = exp(-10 t), 1 - (1 + k (1 - p)) p^k is learnt in k steps."""
    push, response_s = 0.3, 1e9
    observer = ResponseObserver(response_s, math.inf)
    p = math.exp(-10 * TICK_S)
    for k in range(20):
        observer.step(np.array([push * k * TICK_S, 0.0]), np.zeros(2), TICK_S)
        learnt = observer.drift[0] / response_s / push
        assert learnt == pytest.approx(1 - (1 + k * (1 - p)) * p**k, abs=1e-6)


def test_two_readings_at_one_time_change_nothing() -> None:
    observer = settled()
    before = observer.drift.copy()
    observer.step(np.array([0.9, 0.0]), np.zeros(2), 0.0)
    np.testing.assert_array_equal(observer.drift, before)


def test_how_strong_gusts_are_is_learnt_in_ten_seconds_and_forgotten_when_another_flies() -> None:
    """Of a steady 0.5 m/s the root mean square comes up with a time constant of 10 s in its square."""
    observer = ResponseObserver(RESPONSE_S, 2.0)
    observer.step(np.array([0.5, 0.0]), np.zeros(2), TICK_S)
    for _ in range(200):
        observer.step(np.array([0.5, 0.0]), np.zeros(2), TICK_S)
    assert observer.gusts_m_s == pytest.approx(0.5 * math.sqrt(1 - math.exp(-1)), rel=0.03)
    observer.restart(np.array([0.5, 0.0]))
    assert observer.gusts_m_s == 0.0
    np.testing.assert_array_equal(observer.drift, [0.0, 0.0])
