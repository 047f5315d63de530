"""Who watches a simulated flock, and commands it, without zenoh."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any, cast

from flockd.onboard.telemetry import TelemetrySink
from flockd.onboard.telemetry.publisher import Ask, NewestImage, ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage
from flockd.sim.flock.flock_telemetry import FlockTelemetry, Repeater
from flockd.sim.scenario import ScenarioConfig


class Watching:
    """Announcements and messages, as zenoh would pass them on."""

    identity = "f10c"

    def __init__(self) -> None:
        self.about: dict[str, AboutMessage] = {}
        self.ask: dict[str, Ask] = {}
        self.image: dict[str, NewestImage] = {}
        self.states: dict[str, list[Mapping[str, object]]] = {}
        self.flights: dict[str, list[Mapping[str, Any]]] = {}
        self.commands: list[tuple[str, Mapping[str, object]]] = []
        self.events: list[tuple[str, object]] = []
        self.asked = 0

    def announce(self, drone: str, about: AboutMessage, ask: Ask, newest_image: NewestImage) -> None:
        self.about[drone], self.ask[drone], self.image[drone] = about, ask, newest_image

    def withdraw(self, drone: str) -> None:
        del self.about[drone], self.ask[drone], self.image[drone]

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        if topic == "state":
            self.states.setdefault(drone, []).append(message)
        if topic == "flight":
            self.flights.setdefault(drone, []).append(message)
        if topic == "events":
            self.events.append((drone, message["event"]))
        if topic == "command":
            self.commands.append((drone, message))

    def goto(self, drone: str, north_m: float, east_m: float) -> tuple[bool, str]:
        return self.command(drone, "goto", {"north_m": north_m, "east_m": east_m})

    def command(self, drone: str, command: str, order: dict[str, float] | None = None) -> tuple[bool, str]:
        self.asked += 1
        asked = {
            "operator": "anna", "session": "s", "sequence": self.asked, "time_s": time.monotonic(),
            "identity": self.identity, "order": order,
        }  # fmt: skip
        answer = self.ask[drone](command, json.dumps(asked).encode())
        return answer["accepted"], answer["sentence"]

    def shown(self, scenario: ScenarioConfig, telemetry: TelemetrySink | None = None) -> FlockTelemetry:
        """A flock that is announced here, and published here too or elsewhere."""
        return FlockTelemetry(scenario, cast("ZenohTelemetry", self), Repeater(telemetry or self))
