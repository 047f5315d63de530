"""`config/zenoh_tls.json5` holds what it says: who has no certificate hears nothing, who may watch may not command."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest
import zenoh

from flockd.core.data import data_path
from flockd.core.errors import ExitCode
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage
from flockd.onboard.telemetry.zenoh_session import SettingsError, close_session, open_session
from flockd.sim.sitl.processes import free_port

EXAMPLE = (data_path("config") / "zenoh_tls.json5").read_text(encoding="utf-8")
SECONDS_TO_FAIL = 60.0
ABOUT = AboutMessage(version="1.2.3", configuration={"name": "d"}, commands=["hold"])
KEY = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
DRONE, WATCHER, OPERATOR = "drone", "watcher", "operator"


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The example's settings for each of the three, with certificates made by openssl."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not here to make certificates")
    folder = tmp_path_factory.mktemp("tls")

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    openssl("req", "-x509", *KEY, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca")
    (folder / "names").write_text("subjectAltName=DNS:localhost\n", encoding="ascii")
    files = {}
    for who in (DRONE, WATCHER, OPERATOR):
        openssl("req", *KEY, "-keyout", f"{who}.key", "-out", f"{who}.csr", "-subj", f"/CN={who}")
        signed_by = ["-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "names"]
        openssl("x509", "-req", "-in", f"{who}.csr", *signed_by, "-out", f"{who}.pem")
        text = EXAMPLE.replace("/etc/flockd/tls/own", f"{folder}/{who}").replace("/etc/flockd/tls", str(folder))
        if who != DRONE:  # "For the drones; who only watches may leave it out."
            text = text[: text.index("  // For the drones")] + "}\n"
        files[who] = folder / f"{who}.json5"
        files[who].write_text(text, encoding="utf-8")
    return files


def _may(endpoint: str, drone: ZenohTelemetry, settings: Path | None) -> tuple[bool, list[object]]:
    """Whether somebody hears the drone, and what it answers to a question and a command."""
    with FleetWatcher("f", listen=[], connect=[endpoint], settings=settings) as watcher:
        until_s = time.monotonic() + (2.0 if settings is None else SECONDS_TO_FAIL)
        while time.monotonic() < until_s and not (watcher.drones() and watcher.drones()[0].topics):
            drone.publish("d", "events", {"time_s": 0.0, "event": "hello"})
            time.sleep(0.05)
        hears = [(watched.drone, watched.alive, set(watched.topics)) for watched in watcher.drones()]
    session = open_session("a test", [], [endpoint], settings=settings)
    while not (about := _answers(session, "about", 1.0)) and time.monotonic() < until_s:
        time.sleep(0.05)
    # Who may not command gets no answer, however long he waits.
    answers = about + _answers(session, "ask/hold", SECONDS_TO_FAIL if settings and settings.stem == OPERATOR else 1.0)
    close_session(session)
    return hears == [("d", True, {"events"})], answers


def _answers(session: zenoh.Session, what: str, timeout_s: float) -> list[object]:
    samples = [reply.ok for reply in session.get(f"flockd/v1/f/d/{what}", timeout=timeout_s)]
    return [json.loads(sample.payload.to_bytes()) for sample in samples if sample is not None]


def test_who_may_watch_hears_and_who_may_command_commands(settings: dict[str, Path]) -> None:
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    asked: list[str] = []

    def ask(command: str, payload: bytes) -> AnswerMessage:
        assert payload == b""
        asked.append(command)
        return AnswerMessage(accepted=True, sentence="tried")

    with ZenohTelemetry("f", listen=[endpoint], settings=settings[DRONE]) as drone:
        drone.announce("d", ABOUT, ask, lambda camera: None)
        assert _may(endpoint, drone, None) == (False, [])
        assert _may(endpoint, drone, settings[WATCHER]) == (True, [ABOUT])
        assert asked == []
        assert _may(endpoint, drone, settings[OPERATOR]) == (True, [ABOUT, {"accepted": True, "sentence": "tried"}])
        assert asked == ["hold"]


@pytest.mark.parametrize("text", [None, '{ mode: "peer"', "{ nosuchkey: 1 }"])
def test_settings_that_cannot_be_used_are_bad_configuration_in_a_line(text: str | None, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "one.json5").write_text(text)
    with pytest.raises(SettingsError) as refused:
        open_session("telemetry", [], [], settings=tmp_path / "one.json5")
    assert refused.value.exit_code is ExitCode.BAD_CONFIGURATION
    told = str(refused.value)
    assert told.startswith(f"{tmp_path}/one.json5: cannot be used as zenoh's settings (")
    assert told.endswith("; correct it")
    assert "\n" not in told and len(told) < len(str(tmp_path)) + 300
