"""The page's view of drones that publish over zenoh: who they are, their clocks, their events, their answers."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from flockd.fleet.drone_queries import MAX_PICTURE_PX, MAX_REPLY_BYTES
from flockd.fleet.live_fleet import LiveFleet
from flockd.fleet.watcher import FleetWatcher, _heard
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage
from flockd.sim.sitl.processes import free_endpoint
from tests.calm import until

PICTURE = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
WIDE = cv2.imencode(".jpg", np.zeros((2, MAX_PICTURE_PX + 1, 3), np.uint8))[1].tobytes()
ABOUT = AboutMessage(version="1.2.3", configuration={"safety": {"gate": {"fence_radius_m": 40.0}}}, commands=["hold"])


def test_a_drone_is_shown_with_what_queries_tell_and_answers_for_itself() -> None:
    endpoint = free_endpoint()

    def ask(command: str, payload: bytes) -> AnswerMessage:
        message = json.loads(payload)
        return AnswerMessage(accepted=command == "hold", sentence=f"{command} {message['order']}")

    with (
        FleetWatcher(None, listen=[endpoint], connect=[]) as watcher,
        LiveFleet(watcher) as fleet,
        ZenohTelemetry("f", listen=[], connect=[endpoint]) as drone,
    ):
        drone.announce("d", ABOUT, ask, lambda camera: PICTURE if camera == "front" else None)
        until(lambda: "f/d" in fleet.rows(fleet.now_s()) and fleet.rows(fleet.now_s())["f/d"]["delay_ms"] is not None)
        row = fleet.rows(fleet.now_s())["f/d"]
        assert (row["version"], row["commands"], row["fence"]["radius_m"]) == ("1.2.3", ["hold"], 40.0)
        assert row["state"] == "quiet", "it is there, and has published nothing"
        assert abs(row["clock_s"]) <= row["delay_ms"] / 1000 / 2 + 0.001, "both ends read the same clock"
        assert fleet.ask("f/d", "hold", None, "anna") == {"accepted": True, "sentence": "hold None"}
        assert fleet.ask("f/d", "goto", {"north_m": 1}, "anna")["sentence"] == "goto {'north_m': 1}"
        unheard = {"accepted": False, "sentence": "no drone of this name was heard"}
        assert fleet.ask("f/other", "hold", None, "anna") == unheard
        assert (fleet.image("f/d", "front"), fleet.image("f/d", "back")) == (PICTURE, None)
        for number in range(3):
            drone.publish("d", "events", {"time_s": float(number), "event": f"event {number}"})
        until(lambda: len(fleet.events()) == 3)
        assert [event[1:] for event in fleet.events()] == [("f/d", f"event {number}") for number in range(3)]
        until(lambda: len(fleet.history().get("f/d", ())) >= 2)


def test_replies_without_end_and_pictures_that_are_none_are_not_taken() -> None:
    endpoint = free_endpoint()
    endless = AboutMessage(version="1", configuration={"x": "y" * MAX_REPLY_BYTES}, commands=["hold"])
    pictures = {"none": b"<script>", "huge": PICTURE + bytes(MAX_REPLY_BYTES), "wide": WIDE, "good": PICTURE}
    with (
        FleetWatcher(None, listen=[endpoint], connect=[]) as watcher,
        ZenohTelemetry("f", listen=[], connect=[endpoint]) as drone,
    ):
        drone.announce("d", endless, lambda command, payload: AnswerMessage(accepted=False, sentence=""), pictures.get)
        until(lambda: watcher.queries.clock("f/d") is not None)
        assert watcher.queries.about("f/d") is None
        assert [camera for camera in pictures if watcher.queries.image("f/d", camera) is not None] == ["good"]


def test_the_period_of_a_topic_is_of_its_new_messages() -> None:
    """Messages every half second, each sent once more in between."""
    heard = None
    for number in range(20):
        heard = _heard(heard, 100.0 + 0.5 * number, {"time_s": 0.5 * number})
        heard = _heard(heard, 100.2 + 0.5 * number, {"time_s": 0.5 * number})
    assert heard is not None
    assert heard.period_s == pytest.approx(0.5)
