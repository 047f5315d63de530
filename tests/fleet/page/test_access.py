"""Who may open the fleet page, who may command from it, and what a stranger's page cannot do."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import WSMsgType, web
from aiohttp.test_utils import TestClient, TestServer

from flockd.core.errors import UnavailableError
from flockd.fleet.drone_rows import Known, Row
from flockd.fleet.live_fleet import Event, LiveFleet
from flockd.fleet.page.page_access import PageAccess, is_own_host, lasting_key
from flockd.fleet.page.page_server import PageServer
from flockd.onboard.telemetry.topics import AnswerMessage

HOLD = {"drones": ["f/one"], "command": "hold"}
Client = TestClient[web.Request, web.Application]


class Asked(LiveFleet):
    """A fleet of one drone that accepts everything, and notes it."""

    def __init__(self) -> None:
        self.commands: list[tuple[str, str, object]] = []
        self.operators: set[str] = set()

    def now_s(self) -> float:
        return 1.0

    def known(self) -> Mapping[str, Known]:
        return {}

    def rows(self, time_s: float) -> dict[str, Row]:
        return {"f/one": {"state": "normal"}}

    def events(self) -> list[Event]:
        return [(0.5, "f/one", "took off")]

    def history(self) -> Mapping[str, list[list[float | None]]]:
        return {}

    def notes(self) -> list[str]:
        return []

    def ask(self, drone: str, command: str, order: Mapping[str, object] | None, operator: str) -> AnswerMessage:
        self.operators.add(operator)
        self.commands.append((drone, command, order))
        return AnswerMessage(accepted=True, sentence="tried")

    def image(self, drone: str, camera: str) -> bytes | None:
        return b"jpeg" if (drone, camera) == ("f/one", "front") else None


@asynccontextmanager
async def served(fleet: LiveFleet | None = None, **more: Any) -> AsyncIterator[tuple[Client, PageAccess, Asked]]:
    """A server, of ``fleet`` or of one that notes what is asked, and a browser without a page."""
    access, noted = PageAccess(), Asked()
    page = PageServer(fleet or noted, access, **{"may_command": True, **more})
    async with TestClient(TestServer(page.application(), host="127.0.0.1")) as client:
        yield client, access, noted


async def opened(client: Client, access: PageAccess) -> dict[str, str]:
    """Opens the page; what it sends with a command."""
    reply = await client.get("/", params={"key": access.key})
    token = re.search('name="token" content="([^"]{20,})"', await reply.text())
    assert token is not None
    return {"Origin": f"http://127.0.0.1:{client.port}", "X-Flockd-Token": token[1]}


async def test_without_the_key_nothing_is_shown() -> None:
    async with served() as (client, access, fleet):
        shown = "/", "/fleet_page.js", "/plotly.js", "/history", "/image/f/one/front"
        for path in (*shown, "/live", "/?key=wrong", "/?key="):
            assert (await client.get(path)).status == 403, path
        assert (await client.post("/ask", json=HOLD)).status == 403
        await opened(client, access)
        for path in shown:
            assert (await client.get(path)).status == 200, path
        assert fleet.commands == []


async def test_the_key_moves_from_the_address_into_a_cookie_that_other_sites_cannot_send() -> None:
    async with served() as (client, access, _):
        reply = await client.get("/", params={"key": access.key}, allow_redirects=False)
        assert (reply.status, reply.headers["Location"]) == (303, "/")
        (cookie,) = reply.cookies.values()
        assert (cookie["samesite"], cookie["httponly"], cookie["path"]) == ("Strict", True, "/")
        assert access.key not in str(reply.cookies)


async def test_a_command_needs_the_sessions_token_and_the_pages_own_origin() -> None:
    async with served() as (client, access, fleet):
        own = await opened(client, access)
        other = await opened(client, access)  # a later session: the cookie is its own now
        refused: tuple[dict[str, str], ...] = (
            {},
            {"Origin": own["Origin"]},
            {"X-Flockd-Token": other["X-Flockd-Token"]},
            {**other, "Origin": "http://stranger.example"},
            {**other, "Origin": f"https://127.0.0.1:{client.port}"},
            {**other, "Origin": "null"},
            {**other, "Origin": "http://127.0.0.1:1"},
            {**other, "X-Flockd-Token": "guessed"},
            own,
        )
        for headers in refused:
            reply = await client.post("/ask", json=HOLD, headers=headers)
            assert reply.status == 403, headers
        assert fleet.commands == []
        reply = await client.post("/ask", json=HOLD, headers=other)
        assert await reply.json() == {"f/one": {"accepted": True, "sentence": "tried"}}
        assert fleet.commands == [("f/one", "hold", None)]
        await client.post("/ask", json=HOLD, headers=await opened(client, access))
        assert len(fleet.operators) == 2, "each page is an operator of its own"


async def test_a_name_that_was_made_to_lead_here_gets_nothing() -> None:
    """DNS rebinding: to the browser the stranger's page is then of the same origin as this server."""
    async with served() as (client, access, fleet):
        own = await opened(client, access)
        strange = {"Host": f"stranger.example:{client.port}", "Origin": f"http://stranger.example:{client.port}"}
        assert (await client.get("/", params={"key": access.key}, headers=strange)).status == 403
        assert (await client.get("/history", headers=strange)).status == 403
        assert (await client.post("/ask", json=HOLD, headers={**own, **strange})).status == 403
        assert fleet.commands == []


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("127.0.0.1:8470", True),
        ("192.168.1.7:8470", True),
        ("[::1]:8470", True),
        ("localhost", True),
        (f"{socket.gethostname()}:8470", True),
        ("localhost.stranger.example:8470", False),
        ("127.0.0.1.stranger.example", False),
        ("", False),
        ("[", False),
    ],
)
def test_the_host_of_a_request_is_an_address_or_this_computers_name(host: str, own: bool) -> None:
    assert is_own_host(host) == own


async def test_every_reply_forbids_what_is_not_from_here_and_lets_no_other_site_read_it() -> None:
    async with served() as (client, access, _):
        own = await opened(client, access)
        replies = [await client.get(path) for path in ("/", "/fleet_map.js", "/image/f/one/front", "/nothing.js", "/x")]
        replies += [await client.post("/ask", json=HOLD), await client.post("/ask", json=HOLD, headers=own)]
        replies += [await client.options("/ask", headers={"Origin": "http://stranger.example"})]
        for reply in replies:
            policy = reply.headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "http" not in policy
            assert "unsafe-inline" not in policy.split("script-src")[1].split(";")[0]
            assert not [name for name in reply.headers if name.startswith("Access-Control")]
            assert reply.headers["Cross-Origin-Resource-Policy"] == "same-origin"


async def test_live_data_go_to_the_sessions_own_page_only() -> None:
    async with served() as (client, access, _):
        own = await opened(client, access)
        assert (await client.get("/live", headers={"Origin": "http://stranger.example"})).status == 403
        async with client.ws_connect("/live", headers={"Origin": own["Origin"]}) as wrong:
            await wrong.send_json({"token": "guessed"})
            assert (await wrong.receive()).type == WSMsgType.CLOSE
            assert wrong.close_code == 4403
        async with client.ws_connect("/live", headers={"Origin": own["Origin"]}) as page:
            await page.send_json({"token": own["X-Flockd-Token"]})
            assert await page.receive_json() == {"kind": "hello", "may_command": True}
            shown = await page.receive_json()
            assert shown["rows"] == {"f/one": {"state": "normal"}}
            assert shown["events"] == [[0.5, "f/one", "took off"]]
            again = await page.receive_json()
            assert (again["order"], again["rows"], again["events"]) == (["f/one"], {}, []), "only what has changed"


async def test_a_page_that_only_watches_commands_nothing() -> None:
    async with served(may_command=False) as (client, access, fleet):
        reply = await client.post("/ask", json=HOLD, headers=await opened(client, access))
        assert reply.status == 403
        assert "commands nothing" in await reply.text()
        assert fleet.commands == []


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (b"{", ""),
        (b"[]", "JSON object"),
        (b"[" * 10_000, "JSON object"),
        (b"\xff\xfe{", "JSON object"),
        (json.dumps({**HOLD, "drones": ["f/one"] * 1000}).encode(), "to 200 drones at most"),
        (json.dumps({**HOLD, "drones": []}).encode(), "names its drones"),
        (json.dumps({**HOLD, "drones": [1]}).encode(), "names its drones"),
        (json.dumps({**HOLD, "command": "about"}).encode(), "hold, land, resume, goto"),
        (json.dumps({**HOLD, "command": "goto", "order": {"north_m": 1}}).encode(), "`east_m`"),
        (b'{"drones":["f/one"],"command":"goto","order":{"north_m":1,"east_m":NaN}}', "east_m is no finite number"),
    ],
)
async def test_what_is_no_command_is_refused_in_one_sentence(body: bytes, told: str) -> None:
    async with served() as (client, access, fleet):
        reply = await client.post("/ask", data=body, headers=await opened(client, access))
        assert reply.status == 400
        assert told in await reply.text()
        assert fleet.commands == []


async def test_a_command_in_an_unknown_charset_is_read_as_what_it_is() -> None:
    async with served() as (client, access, fleet):
        headers = {**await opened(client, access), "Content-Type": "application/json; charset=nonsense"}
        assert (await client.post("/ask", data=json.dumps(HOLD).encode(), headers=headers)).status == 200
        assert fleet.commands == [("f/one", "hold", None)]


async def test_an_order_reaches_every_drone_once() -> None:
    async with served() as (client, access, fleet):
        order = {"north_m": 3, "east_m": -2.5}
        body = {"drones": ["f/one", "f/two", "f/one"], "command": "goto", "order": order}
        await client.post("/ask", json=body, headers=await opened(client, access))
        assert sorted(fleet.commands) == [("f/one", "goto", order), ("f/two", "goto", order)]


async def test_with_a_key_that_lasts_an_open_page_goes_on_after_a_new_start(tmp_path: Path) -> None:
    """Its cookie and its token are good for the new server; with another key they are not, and the page is told so."""
    first = PageAccess(lasting_key(tmp_path / "key"))
    session = first.open_session(first.key)
    token = first.token_of(session)
    second = PageAccess(lasting_key(tmp_path / "key"))
    assert (second.key, second.cookie) == (first.key, first.cookie)
    assert second.is_token(session, token)
    other = PageAccess()
    assert other.cookie != first.cookie
    assert other.token_of(session) is None
    assert second.token_of(f"{session}0") is None
    assert second.token_of("\udcff.\udcff") is None


def test_a_key_is_for_its_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "key"
    key = lasting_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert lasting_key(path) == key
    path.chmod(0o640)
    with pytest.raises(UnavailableError, match="may be read or written by others; `chmod 600"):
        lasting_key(path)
    path.chmod(0o600)
    for content in ("", "short", "x" * 5000, "with spaces in it, as no key has"):
        path.write_text(content, encoding="ascii")
        with pytest.raises(UnavailableError, match="holds no key"):
            lasting_key(path)
    with pytest.raises(UnavailableError, match="cannot be made"):
        lasting_key(tmp_path / "none" / "key")
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(UnavailableError, match="holds no key"):
        lasting_key(tmp_path / "pipe")


def test_the_page_names_no_place_outside_the_computer() -> None:
    folder = Path(__file__).parents[3] / "flockd" / "fleet" / "page"
    for path in (path for path in folder.iterdir() if path.suffix in {".html", ".js", ".css"}):
        assert re.findall(r"(?:https?:)?//[a-z0-9]", path.read_text(encoding="utf-8")) == [], path
