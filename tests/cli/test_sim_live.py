"""`flockd sim --live` without a browser: the command, the address that it prints, what the page is sent and sends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.processes import free_endpoint

ROOT = Path(__file__).parents[2]
RUN = "from flockd.cli import program; program()"
SECONDS_TO_FAIL = 240.0
GOAL_NE = (-4.0, -3.0)


class Page:
    """What a page knows, and what it sends."""

    def __init__(self, session: aiohttp.ClientSession, base: str, headers: dict[str, str]) -> None:
        self._session, self._base, self._headers = session, base, headers
        self.rows: dict[str, dict[str, Any]] = {}
        self.simulation: dict[str, Any] | None = None
        self.states: dict[str, set[str]] = {}
        """Of each drone, all that were shown since they were last forgotten."""
        self.events: list[Any] = []
        self._socket: aiohttp.ClientWebSocketResponse | None = None

    async def connect(self) -> None:
        """As the page does after loading."""
        self._socket = await self._session.ws_connect(f"{self._base}/live", headers=self._headers)
        await self._socket.send_json({"token": self._headers["X-Flockd-Token"]})
        assert (await self._socket.receive_json())["kind"] == "hello"

    async def until(self, true: Callable[[], bool]) -> None:
        """Takes what comes until it is so."""
        assert self._socket is not None
        async with asyncio.timeout(SECONDS_TO_FAIL):
            while True:
                message = await self._socket.receive_json()
                known = self.rows | message["rows"]
                self.rows = {
                    key.split("/")[1]: known.get(key, known.get(key.split("/")[1])) for key in message["order"]
                }
                self.simulation = message["simulation"]
                self.events += message["events"]
                for drone, row in self.rows.items():
                    self.states.setdefault(drone, set()).add(row["state"])
                if self.simulation is not None and len(self.rows) == 3 and true():
                    return

    async def control(self, control: str, **value: object) -> None:
        """Of the simulation, which takes it."""
        body = {"control": control, "value": value or None}
        async with self._session.post(f"{self._base}/simulate", json=body, headers=self._headers) as reply:
            answer = await reply.json()
        assert answer["accepted"], answer

    async def ask(self, command: str, order: object = None, drones: tuple[str, ...] = ("drone1", "drone2")) -> None:
        """Of drones, which take it."""
        body = {"drones": [f"paper_flight/{drone}" for drone in drones], "command": command, "order": order}
        async with self._session.post(f"{self._base}/ask", json=body, headers=self._headers) as reply:
            answers = await reply.json()
        assert all(answer["accepted"] for answer in answers.values()), answers

    async def picture(self, drone: str, camera: str) -> int:
        """The status of a request for one."""
        async with self._session.get(f"{self._base}/image/paper_flight/{drone}/{camera}") as reply:
            return reply.status

    @property
    def now(self) -> dict[str, Any]:
        """Of the simulation."""
        assert self.simulation is not None
        return self.simulation

    def place(self, drone: str) -> np.ndarray:
        """(2,) m"""
        return np.array(self.rows[drone]["position_ne"])


@contextlib.asynccontextmanager
async def live(*options: str) -> AsyncIterator[Page]:
    """The command as a process, and its page; ended by Ctrl-C."""
    command = ["sim", "--live", "--port", "0", "--drones", "3", "--telemetry-at", free_endpoint()]
    flight = await asyncio.create_subprocess_exec(
        sys.executable, "-c", RUN, *command, *options, cwd=ROOT, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        assert flight.stdout is not None
        line = (await flight.stdout.readline()).decode()
        address = re.search(r"http://\S+/\?key=\S+", line)
        assert address is not None, line
        base = address[0].split("/?")[0]
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
            reply = await session.get(address[0])
            token = re.search('name="token" content="([^"]+)"', await reply.text())
            assert token is not None
            page = Page(session, base, {"Origin": base, "X-Flockd-Token": token[1]})
            await page.connect()
            yield page
        flight.send_signal(signal.SIGINT)
        assert await asyncio.wait_for(flight.wait(), SECONDS_TO_FAIL) == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            flight.kill()
        await flight.wait()


async def test_a_flock_flies_where_the_page_sends_it_and_stands_still_when_it_is_paused() -> None:
    async with live("--perception", "truth") as page:
        await page.until(lambda: page.now["time_s"] >= 1.5 and all(row["speed_m_s"] for row in page.rows.values()))
        assert page.now["flight"] == 1
        began = {drone: page.place(drone) for drone in page.rows}
        await page.control("speed", factor=10.0)
        await page.until(lambda: page.now["time_s"] >= 8.0)
        assert all(np.linalg.norm(page.place(drone) - began[drone]) > 2.0 for drone in began), "they move"

        north, east = GOAL_NE
        order = {"north_m": north, "east_m": east, "speed_m_s": 1.5}
        await page.ask("goto", order, ("drone1", "drone2", "drone3"))
        await page.until(lambda: all("at" in (row["mission"] or "") for row in page.rows.values()))
        middle = np.mean([page.place(drone) for drone in page.rows], axis=0)
        assert np.linalg.norm(middle - GOAL_NE) < 1.5 + 0.6, "`reached_m`, and what their estimates are off"

        await page.control("speed", factor=2.0)
        await page.ask("velocity", {"velocity_ne": [1.0, 0.0]})
        await page.until(lambda: page.rows["drone1"]["mission"] == "flies an operator's velocity")
        await page.ask("hold", drones=("drone3",))
        await page.until(lambda: page.rows["drone3"]["state"] == "asking")
        assert page.rows["drone3"]["flight_mode"] == "hold"
        assert "an operator asked for Hold" in page.rows["drone3"]["why"]
        await page.ask("resume", drones=("drone3",))
        await page.until(lambda: page.rows["drone3"]["state"] == "normal")

        await page.control("pause")
        await page.until(lambda: page.now["paused"])
        await page.until(lambda: page.rows["drone1"]["rate_hz"] is None)  # nothing new has come for a while
        stood_s, places = page.now["time_s"], {drone: page.place(drone) for drone in page.rows}
        page.states, page.events = {}, []
        for _ in range(10):  # of the page's messages, longer than a message of a drone counts as new
            await page.until(lambda: True)
        assert page.now["time_s"] == stood_s, "no step"
        assert all((page.place(drone) == places[drone]).all() for drone in places)
        assert set().union(*page.states.values()) == {"normal"}, "standing still is no fault of theirs"
        assert page.events == [], "nor in what they log"
        await page.control("go_on")
        await page.until(lambda: page.now["time_s"] > stood_s)
        assert page.now["time_s"] - stood_s <= 2.0, "nothing was caught up with"


async def test_a_flock_is_disturbed_and_begun_again_from_the_page_and_filmed(tmp_path: Path) -> None:
    async with live("--perception", "truth", "--video", str(tmp_path / "flock.mp4")) as page:
        await page.until(lambda: True)
        await page.control("speed", factor=5.0)
        await page.control("camera", drone="drone2", camera="front", works=False)
        await page.until(lambda: "a camera is lost: front unplugged" in page.rows["drone2"]["why"])
        assert page.rows["drone2"]["state"] == "degraded"
        assert page.now["cameras_off"] == {"drone2": ["front"]}

        await page.control("remove", drone="drone3")
        await page.until(lambda: page.rows["drone3"]["state"] == "gone")
        await page.until(lambda: page.rows["drone1"]["neighbours"] == 1)

        await page.control("gusts", gust_m_s=1.0)
        await page.until(
            lambda: any("differs from its setpoints" in why for row in page.rows.values() for why in row["why"])
        )
        assert page.now["gust_m_s"] == 1.0

        first_s = page.now["time_s"]
        await page.control("restart")
        await page.until(lambda: page.now["flight"] == 2 and page.rows["drone3"]["state"] == "normal")
        await page.until(lambda: all(row["neighbours"] == 2 for row in page.rows.values()))
        assert page.now["time_s"] < first_s
        assert (page.now["cameras_off"], page.now["removed"], page.now["gust_m_s"]) == ({}, [], 0.0)
        await page.until(lambda: all(row["mission"] == "on the circle" for row in page.rows.values()))
    film = cv2.VideoCapture(str(tmp_path / "flock.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) > first_s / 0.5, "a frame a step, those after the restart too"
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(2.0)
    assert [path.name for path in tmp_path.iterdir()] == ["flock.mp4"], "no draft is left"


@pytest.mark.parametrize(("processors", "drones"), [(1, 2), (2, 3), (3, 5), (4, 5), (64, 5)])
def test_by_sight_so_many_drones_fly_live_as_the_processors_carry(
    processors: int, drones: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the paper's five; on exact states, with a scenario of one's own and without a page as many as there are."""
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    paper_flight = str(ROOT / "config/paper_flight.yaml")
    of: dict[tuple[str, ...], int] = {
        ("--live",): drones,
        ("--live", "--drones", "4"): 4,
        ("--live", "--perception", "truth"): 5,
        ("--live", paper_flight): 5,
        (): 5,
    }
    flown: list[int] = []

    def fly(args: object, scenario: ScenarioConfig, *_: object) -> int:
        flown.append(len(scenario.vehicles))
        return 0

    monkeypatch.setattr("flockd.cli.sim._fly_live", fly)
    monkeypatch.setattr("flockd.cli.sim._fly_into", lambda directory, scenario, args: fly(args, scenario))
    monkeypatch.setattr("flockd.cli.sim._folder", lambda scenario, args: ROOT)
    for options in of:
        assert main(["sim", *options]) == 0
    assert flown == list(of.values())
