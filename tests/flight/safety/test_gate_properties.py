"""The gate with random numbers, and with ones that cannot be: nothing unsafe is sent."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.config.safety import GateParameters
from flockd.flight.safety import Action, Gate, Objection, Surroundings, Verdict
from tests.flight.safety.test_fence import is_inside, outline
from tests.make import around, request

ROUNDING = 1e-6


def assert_safe(verdict: Verdict, p: GateParameters, action: Action, near: Surroundings) -> None:
    """Raises AssertionError for a setpoint that is not finite or outside the limits."""
    setpoint = verdict.setpoint
    if setpoint is None:
        return
    assert action is not Action.SILENCE, "a setpoint without permission"
    assert np.isfinite([*setpoint.velocity, setpoint.height_m, setpoint.yaw_rad, setpoint.time_s]).all()
    assert abs(setpoint.yaw_rad) <= math.pi, f"a heading of {setpoint.yaw_rad}"
    assert p.min_height_m <= setpoint.height_m <= p.max_height_m, "a height outside the band"
    assert math.hypot(*setpoint.velocity) <= p.max_speed_m_s + ROUNDING, "a setpoint is too fast"
    here = near.position
    if (np.abs(here) < 1e100).all():
        if p.fence_radius_m is not None and math.hypot(*here) > p.fence_radius_m:
            assert here / math.hypot(*here) @ setpoint.velocity <= ROUNDING, "out of the fence"
        if p.fence_corners_m and (np.abs(here) < 1e6).all() and not is_inside(here, p.fence_corners_m):
            border = outline(p.fence_corners_m)
            foot = border[np.argmin(np.linalg.norm(border - here, axis=1))]  # the fence's nearest point, to 5 cm
            assert setpoint.velocity @ (here - foot) <= 0.03 * np.linalg.norm(setpoint.velocity) + ROUNDING
    separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
    for offset in near.neighbours:
        level = math.hypot(*offset[:2])
        if np.isfinite(offset).all() and level > 0.1 and math.hypot(*offset) < separation_m - ROUNDING:
            assert offset[:2] / level @ setpoint.velocity <= ROUNDING, "towards a neighbour that is too near"


PARAMETERS = GateParameters(
    max_speed_m_s=3.0, max_acceleration_m_s2=4.0, degraded_speed_m_s=1.0, min_separation_m=1.0,
    degraded_separation_m=1.5, fence_radius_m=12.0, min_height_m=2.0, max_height_m=20.0,
    fence_corners_m=((-8.0, -10.0), (-8.0, 10.0), (10.0, 10.0), (10.0, 2.0), (2.0, 2.0), (2.0, -10.0)),
)  # fmt: skip
MOVES = (Action.FLY, Action.FLY_DEGRADED)


@pytest.mark.parametrize("odd", [0.0, 0.02, 0.2])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
def test_whatever_is_asked_for_what_is_sent_is_safe(seed: int, odd: float) -> None:
    """The measured velocity is random too: the drone seems to be blown about. `odd`: so many numbers cannot be."""
    rng = np.random.default_rng(seed)

    def number(scale: float) -> float:
        if rng.random() < odd:
            return float(rng.choice([math.nan, math.inf, -math.inf, 1e300, -1e9, 0.0]))
        return float(rng.normal(0.0, scale))

    def numbers(scale: float, *shape: int) -> list[list[float]]:
        drawn: list[list[float]] = np.reshape([number(scale) for _ in range(math.prod(shape))], shape).tolist()
        return drawn

    gate, last, now_s, moving, climbing = Gate(PARAMETERS), None, 0.0, 0, 0
    for _ in range(600):
        now_s += float(rng.choice([0.0, 0.05, 0.05, 0.05, 0.2]))
        action = Action(rng.choice([Action.FLY, Action.FLY, Action.FLY_DEGRADED, *Action]))
        many, height_m = int(rng.integers(0, 4)), 10.0 + number(3.0)
        near = around(
            [number(6.0), number(6.0)], [number(2.0), number(2.0)], neighbours=numbers(1.0, many, 3),
            neighbour_velocities=np.reshape(numbers(1.0, many, 2), (many, 2)), yaw_rad=number(2.0), height_m=height_m,
        )  # fmt: skip
        permitted_s, wanted_s = now_s - abs(number(0.1)), now_s - abs(number(0.6))
        asked = request(permitted_s, [number(1.5), number(1.5)], action, near, yaw_rad=number(2.0), wanted_s=wanted_s,
                        height_m=10.0 + number(8.0))  # fmt: skip
        verdict = gate.step(now_s, asked)
        assert_safe(verdict, PARAMETERS, action, near)
        setpoint = verdict.setpoint
        fresh = now_s - permitted_s <= 0.3 and action is not Action.SILENCE
        fresh &= action not in MOVES or now_s - wanted_s <= 1.5
        assert fresh or setpoint is None
        assert setpoint is not None or odd or not fresh
        if setpoint is not None and last is not None:
            elapsed_s, climb_m = now_s - last.time_s, setpoint.height_m - last.height_m
            if action is not Action.OFFER and not {Objection.FENCE, Objection.SEPARATION} & {*verdict.objections}:
                assert np.linalg.norm(setpoint.velocity - last.velocity) <= 4.0 * elapsed_s + 1e-9
            if action is not Action.OFFER and Objection.SEPARATION not in verdict.objections:
                assert abs(climb_m) <= (1.5 * elapsed_s if action in MOVES else 0.0) + 1e-9
            moving += bool(np.linalg.norm(setpoint.velocity) > 0.1)
            climbing += abs(climb_m) > 0.01
        if setpoint is not None and action is not Action.OFFER and math.isfinite(height_m):
            for north, east, down in near.neighbours:  # no more than by noise towards one that is less than 3 m off
                if np.isfinite([north, east, down]).all() and math.hypot(north, east) < 2.25 and 0 < abs(down) < 3.0:
                    over_m = (setpoint.height_m - height_m) * (-1 if down > 0 else 1)
                    assert over_m <= 0.3 + 1e-9 or setpoint.height_m in (2.0, 20.0)
        last = setpoint
    assert min(moving, climbing, gate.counts[Objection.FENCE], gate.counts[Objection.SEPARATION]) > 20
