"""The page among drones that never answer, connections that never ask, and a drone whose numbers are absurd."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping

import pytest
from aiohttp import web

from flockd.fleet.drone_rows import Known, Row
from flockd.fleet.page.page_access import MAX_STRANGERS, STRANGER_S, PageAccess, PageConnections
from flockd.fleet.page.page_server import EVERY_S, OF_SIMULATION_S, SILENT_S, PagePictures, PageServer
from flockd.onboard.telemetry.topics import AnswerMessage
from tests.fleet.page.test_access import Asked, opened, served

pytestmark = pytest.mark.fault("stuck-pictures")


class Stuck(Asked):
    """Cameras never give a picture, and only "f/one" answers orders; what happened is noted in order."""

    def __init__(self) -> None:
        super().__init__()
        self.happened: list[str] = []
        self.answers = threading.Event()

    def known(self) -> Mapping[str, Known]:
        return {"f/one": Known(delay_s=0.01)}

    def image(self, drone: str, camera: str) -> bytes | None:
        self.happened.append("asked for a picture")
        self.answers.wait(60.0)
        self.happened.append("a picture came")
        return None

    def ask(self, drone: str, command: str, order: Mapping[str, object] | None, operator: str) -> AnswerMessage:
        if drone != "f/one":
            self.answers.wait(60.0)
        self.happened.append(f"{drone} answered")
        return AnswerMessage(accepted=True, sentence="tried")


async def test_an_order_passes_pictures_and_orders_that_nobody_answers() -> None:
    """Twenty-four pictures for each of four pages, and 250 orders that hang: the other drone's answer comes first."""
    fleet = Stuck()
    async with served(fleet=fleet) as (client, access, _):
        own = await opened(client, access)
        pictures = [
            asyncio.create_task(client.get(f"/image/f/{drone}/camera{number}"))
            for _ in range(4)
            for drone in ("silent", "other")
            for number in range(12)
        ]
        hanging = {"drones": [f"f/silent{number}" for number in range(50)], "command": "hold"}
        stuck = [asyncio.create_task(client.post("/ask", json=hanging, headers=own)) for _ in range(5)]
        while "asked for a picture" not in fleet.happened:
            await asyncio.sleep(0.01)
        reply = await client.post("/ask", json={"drones": ["f/one"], "command": "hold"}, headers=own)
        assert (await reply.json())["f/one"]["accepted"]
        assert {(await picture).status for picture in pictures} == {204}, "none waits for its drone"
        assert "a picture came" not in fleet.happened
        assert not any(one.done() for one in stuck)
        assert fleet.happened.count("asked for a picture") == 8, "four of each drone, whoever looks"
        fleet.answers.set()
        await asyncio.gather(*stuck)
    assert fleet.happened.index("f/one answered") < fleet.happened.index("a picture came")


@pytest.mark.parametrize("every_s", [EVERY_S, OF_SIMULATION_S])
async def test_each_camera_is_asked_once_in_a_while_and_a_silent_one_seldom(every_s: float) -> None:
    asked: list[str] = []
    now_s = 100.0

    def fetch(drone: str, camera: str) -> bytes | None:
        asked.append(camera)
        return None if camera == "silent" else b"picture %d" % len(asked)

    pictures = PagePictures(fetch, every_s, lambda: now_s)
    assert [await pictures.newest("d", "good") for _ in range(3)] == [b"picture 1"] * 3
    assert await pictures.newest("d", "silent") is None
    now_s += 0.9 * every_s
    assert await pictures.newest("d", "good") == b"picture 1"
    now_s += 0.1 * every_s
    assert await pictures.newest("d", "good") == b"picture 3"
    assert await pictures.newest("d", "silent") is None
    assert asked == ["good", "silent", "good"]
    now_s += SILENT_S
    assert await pictures.newest("d", "silent") is None
    assert asked[3:] == ["silent"]


async def test_connections_that_ask_for_nothing_lock_nobody_out() -> None:
    """A thousand of half a request; the page that is open goes on, and a new one opens."""
    access, fleet, now_s = PageAccess(), Asked(), 0.0
    page = PageServer(fleet, access, may_command=True)
    runner = web.AppRunner(page.application())
    await runner.setup()
    assert runner.server is not None
    connections = PageConnections(runner.server, page.trusted, lambda: now_s)
    server = await asyncio.get_running_loop().create_server(connections, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    entered = access.open_session(access.key)

    async def connect() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", port)

    async def asks(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bytes:
        writer.write(
            f"GET /history HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nCookie: {access.cookie}={entered}\r\n\r\n".encode()
        )
        return (await reader.readline()).split()[1]

    own = await connect()
    assert await asks(*own) == b"200"
    half = []
    for _ in range(1000):
        half.append(await connect())
        half[-1][1].write(b"GET / HTTP/1.1\r\nHost: 127")
        assert len(runner.server.connections) <= MAX_STRANGERS + 5
    await own[0].readuntil(b'"drones":{}}')
    assert await asks(*own) == b"200"
    assert await asks(*await connect()) == b"200"
    now_s += STRANGER_S + 1.0
    connections._tidy(MAX_STRANGERS)
    while len(runner.server.connections) > 2:
        await asyncio.sleep(0.01)
    for _, writer in half:
        writer.close()
    server.close()
    await runner.cleanup()


@pytest.mark.fault("hostile-peers")
async def test_a_drone_with_absurd_numbers_closes_no_page() -> None:
    """What the watcher would have refused: even so, the others are shown."""

    class Absurd(Asked):
        def rows(self, time_s: float) -> dict[str, Row]:
            return {"f/one": {"state": "normal"}, "f/absurd": {"state": "normal", "speed_m_s": float("inf")}}

        def history(self) -> Mapping[str, list[list[float | None]]]:
            return {"f/absurd": [[1.0, float("-inf"), float("nan")]]}

    async with served(fleet=Absurd()) as (client, access, _):
        own = await opened(client, access)
        history = await (await client.get("/history")).json()
        assert history["drones"] == {"f/absurd": [[1.0, None, None]]}
        async with client.ws_connect("/live", headers={"Origin": own["Origin"]}) as page:
            await page.send_json({"token": own["X-Flockd-Token"]})
            await page.receive_json()
            rows = (await page.receive_json())["rows"]
    assert rows == {"f/one": {"state": "normal"}, "f/absurd": {"state": "normal", "speed_m_s": None}}
