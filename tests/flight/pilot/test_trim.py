"""The trim against an autopilot that believes wrongly of its own velocity."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import EgoMotion, FloatArray, VehicleState
from flockd.flight.flocking import FlockingLaw, FlockingParameters
from flockd.flight.geometry import rotation_from_euler
from flockd.flight.pilot.trim import VelocityTrim
from flockd.flight.safety import Gate, GateParameters
from tests import make

STEP_S = 0.5
GATE_M_S = 4.0
R_NED_BODY = rotation_from_euler(0.0, 0.0, 0.7)


def vehicle(step: int, believed: FloatArray | None, step_s: float = STEP_S) -> VehicleState:
    return make.vehicle(step_s * step, R_ned_body=R_NED_BODY, velocity_ned=believed)


def ego(moved_with: FloatArray | None, step_s: float = STEP_S) -> EgoMotion | None:
    """As measured by a pilot whose drone moved so (NED m/s) since the last step."""
    if moved_with is None:
        return None
    return EgoMotion(np.eye(3), R_NED_BODY.T @ moved_with * step_s, step_s, 100, 90, 0.1)


def test_a_drone_flies_as_commanded_although_its_autopilot_errs() -> None:
    """The autopilot makes its own estimate what it is told; the truth is less by what it errs."""
    wanted, errs = np.array([1.0, 0.3]), np.array([0.2, -0.15, 0.05])
    trim = VelocityTrim(0.5, 0.7, GATE_M_S)
    moved = np.full(3, np.nan)
    for step in range(20):
        moved = np.array([*(wanted + trim.velocity), 0.0]) - errs
        trim.update(vehicle(step, moved + errs), ego(moved if step else None))
    assert moved[:2] == pytest.approx(wanted, abs=5e-3)


@pytest.mark.parametrize("limit_m_s", [0.0, 0.3])
def test_no_trim_is_larger_than_allowed_and_a_wild_measurement_is_soon_forgotten(limit_m_s: float) -> None:
    trim, still = VelocityTrim(limit_m_s, 0.7, GATE_M_S), np.zeros(3)
    trim.update(vehicle(0, still), ego(None))
    for step in range(1, 10):
        trim.update(vehicle(step, still), ego(np.array([-9.0, 12.0, 0.0])))
    assert trim.velocity == pytest.approx(limit_m_s * np.array([0.6, -0.8]))
    for step in range(10, 20):
        trim.update(vehicle(step, still), ego(still))
    assert np.linalg.norm(trim.velocity) <= 0.1 * limit_m_s


def test_a_law_and_a_trim_at_their_limits_pass_the_gate_though_rounding_adds_up() -> None:
    """3.5 and 0.5 m/s in one direction, where the gate refuses more than 4 m/s: 500 directions."""
    gate = Gate(GateParameters(max_speed_m_s=GATE_M_S))
    for angle in np.random.default_rng(1).uniform(0, 2 * math.pi, 500):
        direction = np.array([math.cos(angle), math.sin(angle)])
        trim = VelocityTrim(0.5, 0.0, GATE_M_S)
        trim.update(vehicle(0, np.array([*direction, 0.0])), ego(None))
        trim.update(vehicle(1, np.array([*direction, 0.0])), ego(np.zeros(3)))
        law, _ = FlockingLaw(FlockingParameters(max_speed_m_s=3.5)).limited(9.0 * direction, np.zeros(2), 0.5)
        wanted = trim.corrected(law)
        assert math.hypot(*wanted) == pytest.approx(4.0)
        gate.step(0.0, make.request(0.0, wanted))
    assert gate.counts == {}


def test_short_steps_forget_as_much_in_half_a_second_as_one_long_step() -> None:
    trims = []
    for step_s in (0.5, 0.1):
        trim = VelocityTrim(0.5, 0.7, GATE_M_S)
        for step in range(round(2.0 / step_s) + 1):
            moved = ego(np.array([-0.2, 0.1, 0.0]) if step else None, step_s)
            trim.update(vehicle(step, np.zeros(3), step_s), moved)
        trims.append(trim.velocity)
    assert trims[1] == pytest.approx(trims[0])
    assert trims[0] == pytest.approx((1.0 - 0.7**4) * np.array([0.2, -0.1]))


@pytest.mark.parametrize(("scale", "speed_m_s", "doubted"), [(2.0, 1.0, True), (0.4, 2.0, True), (1.1, 2.0, False)])
def test_images_that_show_another_speed_than_the_autopilot_are_doubted(
    scale: float, speed_m_s: float, doubted: bool
) -> None:
    """As over ground that is not at the height of home, with PX4's own errors of 0.15 m/s beside it."""
    trim, rng, north = VelocityTrim(0.0, 0.7, GATE_M_S), np.random.default_rng(0), np.array([speed_m_s, 0.0, 0.0])
    doubts = []
    for step in range(40):
        trim.update(vehicle(step, north + rng.normal(0.0, 0.15, 3)), ego(scale * north if step else None))
        doubts.append(trim.doubt_m_s)
    assert (doubts[-1] == pytest.approx(abs(scale - 1.0) * speed_m_s, abs=0.15)) is doubted
    assert any(doubts) is doubted
