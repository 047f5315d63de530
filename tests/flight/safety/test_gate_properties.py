"""Gate and supervisor with inputs that cannot be: nothing unsafe is sent."""

from __future__ import annotations

import dataclasses
import math
from random import Random
from typing import Any

import numpy as np
import pytest

from flockd.core.config.safety import GateParameters, SafetyParameters
from flockd.flight.safety import (
    OFFBOARD,
    Action,
    CameraHealth,
    Inputs,
    State,
    Supervisor,
    Surroundings,
    Verdict,
    link_lost,
)
from tests.hostile import any_float, hostile

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest overflow
ROUNDING = 1e-6


def assert_safe(verdict: Verdict, p: GateParameters, action: Action, around: Surroundings) -> None:
    """Raises AssertionError for a setpoint that is not finite or outside the limits."""
    setpoint = verdict.setpoint
    if setpoint is None:
        return
    assert action is not Action.SILENCE, "a setpoint without permission"
    assert np.isfinite([*setpoint.velocity, setpoint.height_m, setpoint.yaw_rad]).all(), "a setpoint is not finite"
    assert abs(setpoint.yaw_rad) <= math.pi, f"a heading of {setpoint.yaw_rad}"
    assert p.min_height_m <= setpoint.height_m <= p.max_height_m, "a height outside the band"
    assert math.hypot(*setpoint.velocity) <= p.max_speed_m_s + ROUNDING, "a setpoint is too fast"
    if np.isfinite(around.position).all() and p.fence_radius_m is not None:
        distance = math.hypot(*around.position)
        if p.fence_radius_m < distance < 1e100:
            outward = float(around.position / distance @ setpoint.velocity)
            assert outward <= ROUNDING, f"{outward} m/s out of the fence"
    separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
    for offset in around.neighbours:
        level = math.hypot(*offset[:2])
        if np.isfinite(offset).all() and level > 0.1 and math.hypot(*offset) < separation_m - ROUNDING:
            assert offset[:2] / level @ setpoint.velocity <= ROUNDING, "towards a neighbour that is too near"


_NUMBERS = tuple(field.name for field in dataclasses.fields(Inputs) if field.type == "float")
_FLAGS = tuple(field.name for field in dataclasses.fields(Inputs) if field.type == "bool")
_COUNTS = tuple(field.name for field in dataclasses.fields(Inputs) if field.type == "int")
_SEEN = ("stream_fault", "foreign_setpoints", "parameter_fault")
"""What was seen, in words; None: nothing."""


def test_it_never_flies_without_the_pilot_a_link_and_an_estimate() -> None:
    parameters = SafetyParameters()

    @hostile(80)
    def check(random: Random) -> None:
        supervisor, now_s = Supervisor(parameters), 1000.0
        inputs = _quiet()
        for _ in range(random.randrange(1, 40)):
            now_s += random.choice((0.0, 0.05, 0.1, 1.0, 5.0))
            inputs = dataclasses.replace(inputs if random.random() < 0.7 else _quiet(), **_changes(random))
            decision = supervisor.step(now_s, inputs)
            moves = decision.action in (Action.FLY, Action.FLY_DEGRADED)
            if moves:
                assert inputs.flight_mode == OFFBOARD, "flies although the pilot does"
                assert inputs.armed, "flies although it is not armed"
                assert link_lost(inputs.heartbeat_age_s, inputs.message_age_s, parameters) is None, (
                    "flies without a link"
                )
                assert inputs.estimate_age_s <= parameters.estimate_timeout_s, "flies blindly"
                assert not (inputs.shutdown_asked or inputs.hold_asked or inputs.land_asked), "flies on"
            if decision.action is not Action.SILENCE and decision.state is not State.READY:
                assert inputs.flight_mode == OFFBOARD, "sends although the pilot flies"
            assert all(reason.sentence for reason in decision.reasons)

    check()


def _quiet() -> Inputs:
    """An undisturbed flight, on the ground or in the air by what is changed."""
    sees = CameraHealth(age_s=0.02, period_s=0.033, unplugged=False, frozen=False, noisy=False)
    fine: dict[str, Any] = dict.fromkeys(_NUMBERS, 0.01) | dict.fromkeys(_FLAGS, False) | dict.fromkeys(_COUNTS, 0)
    fine |= dict.fromkeys(_SEEN)
    fine |= {"nearest_neighbour_m": 3.0, "cameras": {"front": sees, "back": sees}, "temperature_c": 50.0}
    fine["velocity_late_s"] = 0.0
    return Inputs(**fine, dead_tasks=(), flight_mode=OFFBOARD, armed=True, in_air=True)


def _changes(random: Random) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for _ in range(random.choice((0, 0, 1, 2, 5))):
        match random.randrange(8):
            case 0:
                changes[random.choice(_NUMBERS)] = any_float(random)
            case 1:
                changes[random.choice(_FLAGS)] = True
            case 2:
                changes[random.choice(_COUNTS)] = random.choice((0, 1, 2, 6, 10**9))
            case 3:
                changes |= {"armed": random.choice((True, False, None)), "in_air": random.choice((True, False, None))}
            case 4:
                changes["flight_mode"] = random.choice((OFFBOARD, "hold", "", None))
            case 5:
                flags = [random.random() < 0.5 for _ in range(3)]
                one = CameraHealth(any_float(random), any_float(random), *flags)
                changes["cameras"] = {} if random.random() < 0.1 else {"front": one, "back": one}
            case 6:
                changes |= {"armed": False, "in_air": False, "resume_asked": random.random() < 0.5}
            case 7:
                changes[random.choice(_SEEN)] = random.choice(("seen", None))
    return changes
