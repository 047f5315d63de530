"""The tables of messages' ages and of sensors checked against each other, and those who go by them."""

from __future__ import annotations

from functools import reduce
from types import SimpleNamespace
from typing import Any

import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.safety import SafetyParameters
from flockd.core.config.source import SourceParameters
from flockd.core.consistency import CHECKS, Check
from flockd.core.services import CONTROL, HEARTBEAT, PERMISSION, SERVICES, Service
from flockd.flight.safety.policy import rules
from flockd.onboard.telemetry.topics import TOPICS

SECTIONS: Any = SimpleNamespace(
    safety=SafetyParameters(),
    autopilot=AutopilotParameters(),
    perception=PerceptionConfig(),
    source=SourceParameters(kind="shared_memory"),
)


@pytest.mark.parametrize("row", [*SERVICES, *CHECKS], ids=str)
def test_the_keys_of_a_row_begin_with_its_limit(row: Service | Check) -> None:
    limit = row.timeout if isinstance(row, Service) else row.limit
    for key in row.keys:
        assert reduce(getattr, key.split("."), SECTIONS) == limit


@pytest.mark.parametrize("service", SERVICES, ids=lambda service: f"{service.message}, {service.timeout:g}")
def test_a_time_out_forgives_a_message_that_is_late(service: Service) -> None:
    periods = service.timeout if service.unit == "periods" else service.timeout * service.rate_hz
    assert periods >= 1.8, "a step and its duration, at the least"


def test_two_heartbeats_may_be_lost_and_half_a_second_after_a_stall_nothing_is_sent() -> None:
    """R3 of the safety case; a setpoint may be on its way for another period."""
    assert HEARTBEAT.timeout >= 3.4 * HEARTBEAT.period_s
    assert max(PERMISSION.timeout, CONTROL.timeout) + 2 * CONTROL.period_s <= 0.5


def test_every_key_that_is_an_age_or_a_time_out_of_a_message_is_in_the_table() -> None:
    """Beside them only: how long an autopilot that was asked has to answer."""
    keys = {f"autopilot.{name}" for name in AutopilotParameters.model_fields if name.endswith("_age_s")}
    for section, model in (("safety", SafetyParameters), ("safety.gate", type(SafetyParameters().gate))):
        keys |= {f"{section}.{name}" for name in model.model_fields if "timeout" in name}
    assert keys - {"safety.ask_timeout_s"} <= {key for service in SERVICES for key in service.keys}


def test_reactions_that_are_events_are_in_the_supervisors_table() -> None:
    reactions = {row.reaction for row in SERVICES} | {row.reaction for row in CHECKS}
    named = {reaction for reaction in reactions if " " not in reaction}
    assert len(named) == 7
    assert named <= {event.value for event in rules(SafetyParameters())}


def test_telemetry_names_its_rates_and_ages_from_the_table() -> None:
    known = {(service.rate_hz, service.timeout) for service in SERVICES}
    assert {(topic.rate_hz, topic.stale_after_s) for topic in TOPICS.values()} <= known | {(None, None)}


def test_innovations_are_gated_no_wider_than_px4_gates_its_own() -> None:
    """EKF2_RNG_GATE and EKF2_EVV_GATE of PX4 1.18, in standard deviations."""
    of_px4 = {"range to the ground": 5.0, "way flown by the images": 3.0}
    for begin, gate in of_px4.items():
        (check,) = [one for one in CHECKS if one.compared.startswith(begin)]
        assert (check.unit, check.limit <= gate) == ("SD", True)
