"""Who else is there: on the fleet, on this computer; how open its unit is, and which secrets others may read."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.drone import TelemetryParameters
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.ground.doctor import Finding, Level
from flockd.ground.doctor.setup_checks import check_fleet, check_instance, check_secrets
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage
from flockd.sim.sitl.ports import free_endpoint
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


OPEN, CLOSED = "rtspsrc location=rtsp://10.0.0.7/s", "rtspsrc location=rtsp://anna:hunter2@10.0.0.7/s"


def _with_pipeline(pipeline: str, settings: Path | None = None) -> DroneConfig:
    source = SourceParameters(kind="gstreamer", cameras=(CameraDeviceParameters(name="front", pipeline=pipeline),))
    return make.changed(make.drone(source=source), telemetry__zenoh_config=None if settings is None else str(settings))


def _levels(config: DroneConfig, file: Path) -> list[Level]:
    return [finding.level for finding in check_secrets(config, file)]


def test_a_configuration_with_a_password_is_for_the_service_alone(tmp_path: Path) -> None:
    file = tmp_path / "drone.yaml"
    file.touch()
    for mode, pipeline, level in (
        (0o644, OPEN, Level.PASS),
        (0o644, CLOSED, Level.FAILURE),  # every user may read it
        (0o640, CLOSED, Level.PASS),
        (0o666, OPEN, Level.FAILURE),  # others may change it
    ):
        file.chmod(mode)
        assert _levels(_with_pipeline(pipeline), file) == [level]
    assert _levels(_with_pipeline(OPEN), tmp_path / "none") == [Level.WARNING]


def test_the_private_keys_of_tls_are_for_the_service_alone(tmp_path: Path) -> None:
    file, settings, key = (tmp_path / name for name in ("drone.yaml", "tls.json5", "own.key"))
    for one in (file, key):
        one.touch()
        one.chmod(0o600)
    text = (data_path("config") / "zenoh_tls.json5").read_text(encoding="utf-8")
    settings.write_text(text.replace("/etc/flockd/tls", str(tmp_path)), encoding="utf-8")
    settings.chmod(0o644)
    assert _levels(_with_pipeline(OPEN, settings), file) == [Level.PASS] * 3, "listens and connects"
    key.chmod(0o644)
    assert _levels(_with_pipeline(OPEN, settings), file)[-1] is Level.FAILURE
    settings.write_text("{", encoding="utf-8")
    assert _levels(_with_pipeline(OPEN, settings), file)[-1] is Level.FAILURE
