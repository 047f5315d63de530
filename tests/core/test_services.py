"""The table of messages and their time-outs, and those who go by it."""

from __future__ import annotations

from functools import reduce
from types import SimpleNamespace
from typing import Any

import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.safety import SafetyParameters
from flockd.core.config.source import SourceParameters
from flockd.core.services import CONTROL, HEARTBEAT, PERMISSION, SERVICES, Service
from flockd.flight.safety.policy import rules
from flockd.onboard.telemetry.topics import TOPICS

SECTIONS: Any = SimpleNamespace(
    safety=SafetyParameters(),
    autopilot=AutopilotParameters(),
    perception=PerceptionConfig(),
    source=SourceParameters(kind="shared_memory"),
)


@pytest.mark.parametrize("service", SERVICES, ids=lambda service: f"{service.message}, {service.timeout:g}")
def test_a_time_out_forgives_a_message_that_is_late_and_its_keys_begin_with_it(service: Service) -> None:
    periods = service.timeout if service.unit == "periods" else service.timeout * service.rate_hz
    assert periods >= 1.8, "a step and its duration, at the least"
    for key in service.keys:
        assert reduce(getattr, key.split("."), SECTIONS) == service.timeout


def test_every_key_that_is_an_age_or_a_time_out_of_a_message_is_in_the_table() -> None:
    """Beside them only: how long an autopilot that was asked has to answer."""
    keys = {f"autopilot.{name}" for name in AutopilotParameters.model_fields if name.endswith("_age_s")}
    for section, model in (("safety", SafetyParameters), ("safety.gate", type(SafetyParameters().gate))):
        keys |= {f"{section}.{name}" for name in model.model_fields if "timeout" in name}
    assert keys - {"safety.ask_timeout_s"} <= {key for service in SERVICES for key in service.keys}


def test_reactions_that_are_events_are_in_the_supervisors_table() -> None:
    named = {service.reaction for service in SERVICES if " " not in service.reaction}
    assert named == {"camera_lost", "estimate_stale", "neighbours_lost", "link_lost", "motion_unknown"}
    assert named <= {event.value for event in rules(SafetyParameters())}
    assert HEARTBEAT.timeout >= 3.4 * HEARTBEAT.period_s, "two may be lost and the next be late"
    # R3 of the safety case; a setpoint may be on its way for another period.
    assert max(PERMISSION.timeout, CONTROL.timeout) + 2 * CONTROL.period_s <= 0.5


def test_telemetry_names_its_rates_and_ages_from_the_table() -> None:
    known = {(service.rate_hz, service.timeout) for service in SERVICES}
    assert {(topic.rate_hz, topic.stale_after_s) for topic in TOPICS.values()} <= known | {(None, None)}
