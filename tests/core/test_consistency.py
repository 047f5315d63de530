"""The table of checks of sensors against each other, and those who go by it."""

from __future__ import annotations

from functools import reduce
from types import SimpleNamespace
from typing import Any

import pytest

from flockd.core.config.geometry import GeometryParameters
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.safety import SafetyParameters
from flockd.core.consistency import CHECKS, RESPONSE, RESPONSE_DEGRADED, Check
from flockd.flight.safety.policy import rules

SECTIONS: Any = SimpleNamespace(safety=SafetyParameters(), perception=PerceptionConfig(), geometry=GeometryParameters())


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: str(check.compared))
def test_its_keys_begin_with_its_limit_and_it_says_where_that_comes_from(check: Check) -> None:
    assert check.limit > 0.0
    assert check.source
    for key in check.keys:
        assert reduce(getattr, key.split("."), SECTIONS) == check.limit


def test_reactions_that_are_events_are_in_the_supervisors_table() -> None:
    named = {check.reaction for check in CHECKS if " " not in check.reaction}
    assert named == {RESPONSE.reaction, RESPONSE_DEGRADED.reaction} == {"velocity_off", "velocity_far_off"}
    assert named <= {event.value for event in rules(SafetyParameters())}


def test_innovations_are_gated_no_wider_than_px4_gates_its_own() -> None:
    """EKF2_RNG_GATE and EKF2_EVV_GATE of PX4 1.18, in standard deviations."""
    of_px4 = {"range to the ground": 5.0, "way flown by the images": 3.0}
    for begin, gate in of_px4.items():
        (check,) = [one for one in CHECKS if one.compared.startswith(begin)]
        assert (check.unit, check.limit <= gate) == ("SD", True)
