"""Strangers before Foxglove's server: other people's web pages, and peers that say what no text can."""

from __future__ import annotations

import asyncio
import json
import time

import aiohttp
import foxglove
import pytest
import zenoh

from flockd.fleet.foxglove.fleet_publisher import FleetPublisher
from flockd.fleet.foxglove.server import FoxgloveServer
from flockd.fleet.page.drone_rows import Row, drone_rows
from flockd.fleet.page.live_fleet import LiveFleet
from flockd.fleet.watcher import FleetWatcher, Heard, Watched
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.zenoh_session import close_session, open_session
from flockd.sim.free_ports import free_endpoint
from tests.fleet.foxglove_server.test_foxglove_server import ABOUT, COMPUTER, FLIGHT, MISSION, STATE, publishing
from tests.fleet.foxglove_server.websocket_client import FoxgloveClient
from tests.fleet.page.test_access import Asked


class _Nobody(Asked):
    """A fleet of one drone, whose name changes."""

    def __init__(self) -> None:
        super().__init__()
        self.invented = ""

    def drones(self, time_s: float) -> tuple[Watched, ...]:
        topics = {"flight": Heard(time_s, {**FLIGHT, "time_s": time_s})}
        return (Watched("f", self.invented, alive=True, topics=topics, seen=True),) if self.invented else ()

    def rows(self, time_s: float) -> dict[str, Row]:
        return drone_rows(self.drones(time_s), {}, time_s)


@pytest.mark.parametrize(
    ("origin", "enters"),
    [
        (None, True),  # a program
        ("https://app.foxglove.dev", True),
        ("http://localhost:8080", True),  # named with --allow-origin
        ("http://stranger.example", False),
        ("https://app.foxglove.dev.stranger.example", False),
        ("http://app.foxglove.dev", False),
        ("null", False),
    ],
)
def test_web_pages_of_strangers_are_not_served(origin: str | None, enters: bool) -> None:
    told: list[str] = []

    async def connects(port: int) -> bool:
        try:
            async with FoxgloveClient(port, origin) as client:
                await client.until(lambda got: got.server)
        except aiohttp.WSServerHandshakeError as error:
            assert error.status == 403
            return False
        return True

    with FoxgloveServer(_Nobody(), "127.0.0.1", 0, origins=["http://localhost:8080"], on_refusal=told.append) as server:
        assert [asyncio.run(connects(server.port)) for _ in range(2)] == [enters] * 2
    assert len(told) == (not enters), "once for each"
    assert enters or f"web pages of {origin} may not connect here" in told[0]


def test_half_a_request_and_what_is_no_websocket_get_nothing() -> None:
    async def story(port: int) -> bytes:
        half = await asyncio.open_connection("127.0.0.1", port)
        half[1].write(b"GET / HTTP/1.1\r\nHost: 127")
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        return await reader.readline()

    with FoxgloveServer(_Nobody(), "127.0.0.1", 0) as server:
        assert b"403" in asyncio.run(story(server.port))


HALF = "half \ud800"
"""Half a surrogate pair: JSON can say it, UTF-8 cannot."""


def test_texts_that_no_utf_8_can_say_end_nothing() -> None:
    """A peer puts them wherever texts go, and invents names; who watches sees the other drone, and no channel stays."""
    endpoint = free_endpoint()
    cameras = dict.fromkeys((HALF, "*", "a/b", "front"), COMPUTER["cameras"]["front"])
    hostile = {
        "flight": {**FLIGHT, "time_s": 1.0, "flight_mode": HALF, "reasons": [{"event": HALF, "sentence": HALF}]},
        "computer": {**COMPUTER, "time_s": 1.0, "cameras": cameras},
        "mission": {**MISSION, "time_s": 1.0, "sentence": HALF},
        "events": {"time_s": 1.0, "event": HALF},
        "state": {**STATE, "time_s": 1.0, "position_ne": [1.5e308, 1.5e308], "velocity_ned": [1.5e308] * 3},
    }

    async def watch(port: int) -> FoxgloveClient:
        async with FoxgloveClient(port) as client:
            await client.until(lambda got: "/drone1/state" in got.messages)
            seen = len(client.messages["/drone1/state"])
            await client.until(lambda got: len(got.messages["/drone1/state"]) > seen + 4)
            await client.until(lambda got: len(got.json("/fleet")["drones"]) == 2)
        return client

    with (
        FleetWatcher(None, listen=[endpoint], connect=[]) as watcher,
        LiveFleet(watcher) as source,
        ZenohTelemetry("meadow", listen=[], connect=[endpoint]) as drone,
        publishing(drone),
    ):
        session = open_session("a test", [], [endpoint])
        token = session.liveliness().declare_token("flockd/v1/f/hostile/alive/0")

        def about(query: zenoh.Query) -> None:
            message = {**ABOUT, "configuration": {"rig": {"cameras": [{"name": HALF}]}}}
            query.reply(query.key_expr, json.dumps(message))

        queryable = session.declare_queryable("flockd/v1/f/hostile/about", about)
        while "hostile" not in {one.drone for one in watcher.drones()} or watcher.malformed < 5:
            for topic, message in hostile.items():
                session.put(f"flockd/v1/f/hostile/{topic}", json.dumps(message).encode())
            time.sleep(0.05)
        with FoxgloveServer(source, "127.0.0.1", 0) as server:
            client = asyncio.run(watch(server.port))
            assert not server._publishing.done()
        del token, queryable
        close_session(session)
    assert {row["drone"] for row in client.json("/fleet")["drones"]} == {"drone1", "hostile"}
    assert not [topic for topic in client.channels if "\ud800" in topic or "*" in topic]


def test_names_that_are_forgotten_leave_no_channel() -> None:
    context = foxglove.Context()
    fleet = _Nobody()
    publisher = FleetPublisher(fleet, context)
    for number in range(50):
        fleet.invented = f"invented{number}"
        publisher.update(1.0 * number)
        assert [topic for topic in publisher._channels if "invented" in topic] == [f"/invented{number}/flight"]
    publisher.close()
