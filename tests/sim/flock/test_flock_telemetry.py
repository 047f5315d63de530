"""A flock on exact states that watchers see as a real one: states, pictures on request, and orders that it flies."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

import numpy as np
import pytest

from flockd.sim.flock.flock_telemetry import Repeater
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig
from tests import make
from tests.sim.flock.watching import Watching

SECONDS_TO_FAIL = 120.0


def scenario(duration_s: float) -> ScenarioConfig:
    overrides = {"duration_s": duration_s, "ideal": True, "drone.safety.gate.fence_radius_m": 30.0}
    return make.scenario(overrides, drones=2)


def test_a_flock_on_exact_states_is_seen_and_goes_where_it_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.sim.flock.swarm.time.sleep", lambda seconds: None)
    watching = Watching()
    flown = scenario(45.0)
    shown = watching.shown(flown)
    assert not watching.goto("drone1", 1.0, 2.0)[0], "not before it knows where it is"

    def order_when_due(done: int, total: int) -> None:
        if done == 20:
            assert watching.goto("drone1", -10.0, -12.0)[0]
            assert watching.goto("drone2", -10.0, -12.0)[0]
            accepted, why = watching.goto("drone1", 100.0, 0.0)
            assert not accepted
            assert "fence" in why

    log = fly(flown, perception="truth", shown=shown, progress=order_when_due).log
    assert set(watching.about) == set(watching.states) == {"drone1", "drone2"}
    assert watching.about["drone1"]["commands"] == ["goto", "hold", "resume", "velocity"]
    assert [state["position_ne"] for state in watching.states["drone2"]] == log.position[:, 1, :2].tolist()
    assert np.linalg.norm(log.position[-1, :, :2].mean(axis=0) - [-10.0, -12.0]) < 1.0
    assert not watching.command("drone1", "land")[0]
    assert watching.flights["drone1"][-1]["orders_refused"] == 2, "before it knew where it was, and out of the fence"
    began_s = time.monotonic()
    while (picture := watching.image["drone1"]("front")) is None:
        assert time.monotonic() - began_s < SECONDS_TO_FAIL, "the world is built when a picture is asked for"
        threading.Event().wait(0.1)  # nothing sleeps here
    assert picture[:2] == b"\xff\xd8", "a JPEG"


def test_a_drone_is_held_where_it_would_stop_and_flies_on_when_it_is_resumed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.sim.flock.swarm.time.sleep", lambda seconds: None)
    watching, flown = Watching(), scenario(30.0)

    def ask_when_due(done: int, total: int) -> None:
        if done in {20, 40}:
            assert watching.command("drone1", "hold" if done == 20 else "resume")[0]

    log = fly(flown, perception="truth", shown=watching.shown(flown), progress=ask_when_due).log
    told = [(one["state"], one["flight_mode"]) for one in watching.flights["drone1"]]
    assert told == [("normal", "simulated")] * 20 + [("asking", "hold")] * 20 + [("normal", "simulated")] * 20
    (why,) = watching.flights["drone1"][30]["reasons"]
    assert why["sentence"].endswith("asked for Hold")
    ordered, asking, resumed, normal = watching.events
    assert (ordered, resumed) == (("drone1", "anna ordered hold"), ("drone1", "anna ordered resume"))
    assert (asking, normal) == (("drone1", f"asking: {why['sentence']}"), ("drone1", "normal"))
    speed_m_s = np.linalg.norm(log.velocity[:, 0, :2], axis=1)
    assert speed_m_s[20] > 0.8
    assert speed_m_s[30:40].max() < 0.05
    assert np.linalg.norm(log.position[40, 0] - log.position[20, 0]) < 1.0, "at 1 m/s, braking with 3 m/s^2 or less"
    assert speed_m_s[-1] > 0.8
    assert {one["state"] for one in watching.flights["drone2"]} == {"normal"}


def test_newest_messages_are_sent_again_while_the_simulation_computes() -> None:
    sent: list[tuple[str, str, object]] = []
    again = threading.Event()

    class Sink:
        def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
            sent.append((drone, topic, message["time_s"]))
            if sent.count(("drone1", "state", 2)) == 3:
                again.set()

    with Repeater(Sink(), every_s=0.01) as repeater:
        repeater.publish("drone1", "state", {"time_s": 1})
        repeater.publish("drone1", "state", {"time_s": 2})
        repeater.publish("drone1", "events", {"time_s": 3})
        assert again.wait(30.0)
    assert sent[0] == ("drone1", "state", 1)
    assert sent.count(("drone1", "events", 3)) == 1, "it happened once"
    assert sent[1:].count(("drone1", "state", 1)) <= len(sent) - 4
