"""The doctor says which files that hold secrets others may read or change."""

from __future__ import annotations

from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.data import data_path
from flockd.ground.doctor import Level
from flockd.ground.doctor.setup_checks import check_secrets
from tests.onboard.daemon.aboard import config_for

OPEN, CLOSED = "rtspsrc location=rtsp://10.0.0.7/s", "rtspsrc location=rtsp://anna:hunter2@10.0.0.7/s"


def _config(pipeline: str, settings: Path | None = None) -> DroneConfig:
    config = config_for(1, "tcp/127.0.0.1:1", "tcp/127.0.0.1:2")
    camera = CameraDeviceParameters(name="front", pipeline=pipeline)
    telemetry = config.telemetry.model_copy(update={"zenoh_config": None if settings is None else str(settings)})
    source = SourceParameters(kind="gstreamer", cameras=(camera,))
    return config.model_copy(update={"source": source, "telemetry": telemetry})


def _levels(config: DroneConfig, file: Path) -> list[tuple[Level, str]]:
    return [(finding.level, finding.measured) for finding in check_secrets(config, file)]


def test_a_configuration_with_a_password_is_for_the_service_alone(tmp_path: Path) -> None:
    file = tmp_path / "drone.yaml"
    file.touch()
    file.chmod(0o644)
    assert _levels(_config(OPEN), file) == [(Level.PASS, f"{file} holds no password, mode 644")]
    readable = f"{file} holds a password, and every user of this computer may read it"
    assert _levels(_config(CLOSED), file) == [(Level.FAILURE, readable)]
    file.chmod(0o640)
    assert _levels(_config(CLOSED), file) == [(Level.PASS, f"{file} holds a password, mode 640")]
    file.chmod(0o666)
    assert _levels(_config(OPEN), file) == [(Level.FAILURE, f"{file} may be changed by others than its owner")]
    assert _levels(_config(OPEN), tmp_path / "none")[0][0] is Level.WARNING


def test_the_private_keys_of_tls_are_for_the_service_alone(tmp_path: Path) -> None:
    file, settings, key = (tmp_path / name for name in ("drone.yaml", "tls.json5", "own.key"))
    for one in (file, key):
        one.touch()
        one.chmod(0o600)
    text = (data_path("config") / "zenoh_tls.json5").read_text(encoding="utf-8")
    settings.write_text(text.replace("/etc/flockd/tls", str(tmp_path)), encoding="utf-8")
    settings.chmod(0o644)
    assert [level for level, _ in _levels(_config(OPEN, settings), file)] == [Level.PASS] * 3, "listens and connects"
    key.chmod(0o644)
    (level, told) = _levels(_config(OPEN, settings), file)[-1]
    assert (level, told) == (Level.FAILURE, f"{key} is a private key, and every user of this computer may read it")
    settings.write_text("{", encoding="utf-8")
    assert _levels(_config(OPEN, settings), file)[-1][0] is Level.FAILURE
