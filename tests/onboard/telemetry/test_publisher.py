"""A watcher on the same machine reads what a drone publishes."""

from __future__ import annotations

import json
import math
import queue
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
import zenoh

from flockd.core.errors import UnavailableError, UsageError
from flockd.core.messages import SECTORS, MissionStatus, ObstacleRanges, PilotOutput, Reason, ReasonKind, VehicleState
from flockd.onboard.telemetry import TOPICS, publish_step
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.zenoh_session import open_session
from flockd.sim.sitl.processes import free_endpoint
from tests.make import neighbour, output, vehicle, wanted
from tests.onboard.daemon.aboard import client

Received = queue.Queue[tuple[str, dict[str, object]]]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def watched(endpoint: str) -> Iterator[tuple[ZenohTelemetry, Received]]:
    """A publishing peer and, in the queue, what a second peer of this process receives from it."""
    received: Received = queue.Queue()
    with ZenohTelemetry("meadow", listen=[endpoint]) as telemetry, zenoh.open(client(endpoint)) as watcher:
        watcher.declare_subscriber(
            "flockd/v1/meadow/**",
            lambda sample: received.put((str(sample.key_expr), json.loads(sample.payload.to_bytes()))),
        )
        _wait_until_heard(telemetry, received)
        yield telemetry, received


def _wait_until_heard(telemetry: ZenohTelemetry, received: Received) -> None:
    for _ in range(200):
        telemetry.publish("hello", "events", {"time_s": 0.0, "event": "hello"})
        try:
            received.get(timeout=0.05)
        except queue.Empty:
            continue
        time.sleep(0.1)
        while not received.empty():
            received.get_nowait()
        return
    pytest.fail("the watcher heard nothing")


def _yawed(yaw_deg: float) -> VehicleState:
    cosine, sine = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    attitude = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return vehicle(12.5, 4.5, R_ned_body=attitude, position=[3.0, -4.0])


def _output(velocity: np.ndarray | None) -> PilotOutput:
    seen = neighbour([1.0, -2.5, 0.5], velocity_sigma_m_s=math.inf)
    return output(
        12.5, velocity=velocity, neighbours=(seen,), command=wanted([0.9, 0.1], math.pi / 2),
        reasons=(Reason(ReasonKind.EGO_MOTION, "no ego-motion: 12 pairs are too few"),),
        counts={"ego": 1}, stages_ms={"flow": 14.0},
        mission=MissionStatus("waypoints", np.array([1.0, 0.0]), "9 m to the goal", goal=np.array([9.0, 2.0])),
        obstacles=ObstacleRanges(12.5, np.full(SECTORS, np.inf), np.zeros(SECTORS), np.full(SECTORS, 4.0)),
    )  # fmt: skip


def test_a_step_arrives_under_the_documented_keys_and_fields(watched: tuple[ZenohTelemetry, Received]) -> None:
    telemetry, received = watched
    publish_step(telemetry, "1", _yawed(-90.0), _output(np.array([1.0, 0.0, np.nan])))
    messages = dict(received.get(timeout=60) for _ in range(5))

    of_a_step = set(TOPICS) - {"events", "flight", "computer"}
    assert set(messages) == {f"flockd/v1/meadow/1/{topic}" for topic in of_a_step}
    for topic in of_a_step:
        assert set(messages[f"flockd/v1/meadow/1/{topic}"]) == set(TOPICS[topic].type.__annotations__)
    state = messages["flockd/v1/meadow/1/state"]
    assert state["yaw_deg"] == pytest.approx(-90.0)
    assert state["velocity_ned"] == [1.0, 0.0, None], "a number that is not finite is null"
    neighbours = messages["flockd/v1/meadow/1/neighbours"]["neighbours"]
    assert isinstance(neighbours, list)
    assert neighbours[0]["position_ned"] == [1.0, -2.5, 0.5]
    assert neighbours[0]["velocity_sigma_m_s"] is None
    assert messages["flockd/v1/meadow/1/command"]["yaw_deg"] == pytest.approx(90.0)
    assert (state["position_ne"], state["home_deg"]) == ([3.0, -4.0], None)
    obstacles = messages["flockd/v1/meadow/1/obstacles"]
    assert (obstacles["range_m"], obstacles["seen_m"]) == ([None] * 72, [4.0] * 72)


def test_attitude_angles_are_those_of_scipy() -> None:
    from scipy.spatial.transform import Rotation

    angles = (25.0, -50.0, 170.0)
    attitude = Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_matrix()
    seen: dict[str, Mapping[str, object]] = {}

    class Sink:
        def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
            seen[topic] = message

    publish_step(Sink(), "1", vehicle(R_ned_body=attitude), _output(None))
    state = seen["state"]
    assert [state[f"{name}_deg"] for name in ("roll", "pitch", "yaw")] == pytest.approx(angles)
    assert state["velocity_ned"] is None


@pytest.mark.fault("telemetry-router-gone")
def test_nobody_listening_costs_nothing_and_a_closed_session_counts_its_losses(endpoint: str) -> None:
    telemetry = ZenohTelemetry("meadow", listen=[endpoint])
    telemetry.publish("1", "events", {"time_s": 0.0, "event": "take-off"})
    assert telemetry.lost == 0
    telemetry.close()
    telemetry.publish("1", "events", {"time_s": 1.0, "event": "landed"})
    assert telemetry.lost == 1


def test_names_that_would_break_a_key_are_refused(endpoint: str) -> None:
    for fleet in ("", "a/b", "*", "a b", "#"):
        with pytest.raises(ValueError, match="does not fit into a key"):
            ZenohTelemetry(fleet, listen=[endpoint])
    with ZenohTelemetry("meadow", listen=[endpoint]) as telemetry, pytest.raises(ValueError, match="is not a topic"):
        telemetry.publish("1", "stat", {})


def test_a_taken_port_is_reported_in_one_sentence() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(UnavailableError) as caught:
            ZenohTelemetry("meadow", listen=[endpoint])
    reason = f"Can not create a new TCP listener bound to {endpoint}"
    assert f"{endpoint} ({reason}); " in str(caught.value)


@pytest.mark.parametrize("endpoint", ["drone1:7447", "tcp/10.0.0.11", "tcp/127.0.0.1:70000", "http://drone1:7447"])
def test_what_is_no_endpoint_is_refused_with_what_to_write(endpoint: str) -> None:
    with pytest.raises(UsageError, match=f"a page: {endpoint} is not a zenoh endpoint; write protocol, address"):
        open_session("a page", [], [endpoint])


def test_an_address_that_no_interface_has_yet_is_listened_on_once_one_has_it(caplog: pytest.LogCaptureFixture) -> None:
    """Wi-Fi's at the start. 192.0.2.0/24 is for documentation (RFC 5737)."""
    telemetry, free = "tcp/192.0.2.7:7447", free_endpoint()
    drone = ZenohTelemetry("meadow", listen=[telemetry, free], awaits_addresses=True)
    assert f"no interface has the address of {telemetry}, {free} yet" in caplog.text
    with zenoh.open(client(free)):  # what is there works meanwhile
        drone.publish("drone1", "events", {"time_s": 0.0, "event": "x"})
    threading.Thread(target=drone.close, daemon=True).start()  # zenoh takes ten seconds to give it up
    with pytest.raises(UnavailableError, match=f"a page cannot use {telemetry}"):
        open_session("a page", [telemetry], [])


def test_what_is_not_used_of_a_file_of_zenohs_settings_is_told(
    endpoint: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = tmp_path / "own.json5"
    settings.write_text('{mode: "client", connect: {endpoints: ["tcp/10.0.0.11:7447"]}, timestamping: {enabled: true}}')
    with ZenohTelemetry("meadow", listen=[endpoint], settings=settings):
        pass
    mode, connect = caplog.messages
    assert mode == f"telemetry: mode of {settings} is client, and flockd needs peer; leave it out"
    assert f"connect/endpoints of {settings} is ['tcp/10.0.0.11:7447'], and flockd needs []; name endpoints" in connect
