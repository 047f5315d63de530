"""Who else is there: on the fleet, on this computer."""

from __future__ import annotations

import pytest

from flockd.core.config import load_drone
from flockd.core.config.drone import TelemetryParameters
from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.ground.doctor import Finding, Level
from flockd.ground.doctor.setup_checks import check_fleet, check_instance
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage
from flockd.sim.sitl.processes import free_endpoint
from tests import make

QUADROTOR = load_drone(data_path("config") / "quadrotor.yaml")


def _fleet(listen_s: float, **endpoints: str) -> Finding:
    """Of a drone that listens and connects there."""
    listen, connect = ((endpoints[key],) if key in endpoints else () for key in ("listen", "connect"))
    telemetry = TelemetryParameters(fleet="meadow", listen=listen, connect=connect)
    (finding,) = check_fleet(make.changed(QUADROTOR, telemetry=telemetry), listen_s)
    return finding


def _appears(telemetry: ZenohTelemetry, drone: str) -> None:
    about = AboutMessage(version="1", configuration={}, commands=[])
    telemetry.announce(
        drone, about, lambda what, payload: AnswerMessage(accepted=False, sentence=""), lambda camera: None
    )


def test_another_drone_is_seen_and_one_of_the_same_name_is_a_failure() -> None:
    endpoint = free_endpoint()
    with ZenohTelemetry("meadow", listen=[endpoint]) as others:
        _appears(others, "drone2")
        finding = _fleet(1.5, connect=endpoint)
        assert (finding.level, finding.about) == (Level.PASS, "zenoh")
        assert finding.measured.endswith(f"meadow at {endpoint}: sees drone2")
        _appears(others, "drone1")
        assert _fleet(1.5, connect=endpoint).level is Level.FAILURE
        with pytest.raises(UnavailableError, match="telemetry cannot use"):
            _fleet(0.1, listen=endpoint)


def test_alone_is_well_and_nobody_where_somebody_should_be_is_not() -> None:
    assert _fleet(0.2, listen=free_endpoint()).level is Level.PASS
    assert _fleet(0.2, connect=free_endpoint()).level is Level.WARNING


def test_a_second_instance() -> None:
    assert next(iter(check_instance(None))).level is Level.PASS
    (finding,) = check_instance(UnavailableError("autopilot.address: taken; stop it"))
    assert (finding.level, finding.measured) == (Level.FAILURE, "autopilot.address: taken")
