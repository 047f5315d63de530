"""Serves the fleet page: its files, its live data by WebSocket, pictures, and commands."""

from __future__ import annotations

import asyncio
import gzip
import json
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from flockd.fleet.drone_rows import HISTORY_COLUMNS, Known, Row
from flockd.fleet.live_fleet import Event, LiveFleet
from flockd.fleet.page.page_access import HEADERS, PageAccess, is_own_host, is_own_origin
from flockd.fleet.simulation import SimulationLink, checked_control
from flockd.fleet.watcher import MAX_DRONES
from flockd.onboard.telemetry.order_messages import parse_order
from flockd.onboard.telemetry.topics import AnswerMessage

PUSH_EVERY_S = 0.25
MAX_REQUEST_BYTES = 1 << 14
COMMANDS = ("hold", "land", "resume", "goto", "velocity")
"""Commands of the page."""
_FOLDER = Path(__file__).parent
_TYPES = {".js": "text/javascript", ".css": "text/css"}
MAX_PAGES = 32
"""Largest number of open pages."""
HELLO_S = 5.0
"""Time for a page to send its token."""
_TOKEN = "@TOKEN@"
"""Placeholder in the page for the session's token."""


class PageServer:
    """Serves the page of one fleet; `application` is for aiohttp."""

    def __init__(
        self,
        source: LiveFleet,
        access: PageAccess,
        *,
        may_command: bool,
        operator: str = "page",
        simulation: SimulationLink | None = None,
    ) -> None:
        """For one event loop.

        Args:
            source: the fleet's state.
            access: the access rules.
            may_command: whether this page sends commands; each drone decides too.
            operator: the operator's name for the drones; number and address of the page are added.
            simulation: controls of a simulation; None: real drones.
        """
        self._source, self._access, self._may_command, self._operator = source, access, may_command, operator
        self._order_threads = ThreadPoolExecutor(MAX_DRONES, "orders of the fleet page")
        self._silent_threads = ThreadPoolExecutor(MAX_DRONES, "orders to silent drones")
        """For drones that did not answer last: an order waits for them for seconds, and no other drone's may."""
        self._pictures = PagePictures(source.image, EVERY_S if simulation is None else OF_SIMULATION_S)
        self._pages, self._simulation = 0, simulation
        self.trusted: set[object] = set()
        """Connections with a valid request."""
        self._plotly: bytes | None = None

    def application(self) -> web.Application:
        """The application, with the access rules around every route."""
        application = web.Application(middlewares=[self._guarded], client_max_size=MAX_REQUEST_BYTES)
        application.add_routes(
            [
                web.get("/", self._page),
                web.get("/plotly.js", self._plotting_library),
                web.get("/history", self._history),
                web.get("/image/{fleet}/{drone}/{camera}", self._image),
                web.get("/live", self._live),
                web.post("/ask", self._ask),
                web.post("/simulate", self._simulate),
                web.get("/{file:[a-z_]+\\.(?:js|css)}", self._file),
            ]
        )
        return application

    @web.middleware
    async def _guarded(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuses requests without access, and adds `HEADERS` to every reply."""
        try:
            response = await self._refusal(request) or await handler(request)
        except web.HTTPException as error:
            response = web.Response(status=error.status, text=error.reason)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def _refusal(self, request: web.Request) -> web.Response | None:
        """Why a request is refused; None: it has a session of this server, or may open one."""
        if not is_own_host(request.headers.get("Host", "")):
            return _text(403, "the page is served under this computer's address or name only")
        if request.path == "/" and "key" in request.query:
            return self._entered(request.query["key"])
        if self._access.token_of(request.cookies.get(self._access.cookie)) is None:
            return _text(403, "open the page with the whole address that `flockd fleet` printed, with its key")
        self.trusted.add(request.protocol)
        return None

    def _entered(self, key: str) -> web.Response:
        """Moves the key out of the address bar, into a cookie that no other site can send."""
        session = self._access.open_session(key)
        if session is None:
            return _text(403, "the key in the address is not this server's; use the address that it printed")
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(self._access.cookie, session, httponly=True, samesite="Strict")
        return response

    async def _page(self, request: web.Request) -> web.Response:
        token = self._access.token_of(request.cookies.get(self._access.cookie)) or ""
        page = (_FOLDER / "fleet.html").read_text(encoding="utf-8").replace(_TOKEN, token)
        return web.Response(text=page, content_type="text/html")

    async def _file(self, request: web.Request) -> web.Response:
        path = _FOLDER / request.match_info["file"]
        if not path.is_file():
            return _text(404, "there is no such file")
        return web.Response(text=path.read_text(encoding="utf-8"), content_type=_TYPES[path.suffix])

    async def _plotting_library(self, request: web.Request) -> web.Response:
        """The library from its Python package, compressed once."""
        if self._plotly is None:
            path = files("plotly") / "package_data" / "plotly.min.js"
            self._plotly = await asyncio.to_thread(lambda: gzip.compress(path.read_bytes(), 4))
        headers = {"Content-Encoding": "gzip"}
        return web.Response(body=self._plotly, content_type="text/javascript", headers=headers)

    async def _history(self, request: web.Request) -> web.Response:
        return web.json_response({"columns": HISTORY_COLUMNS, "drones": self._source.history()}, dumps=_json)

    async def _image(self, request: web.Request) -> web.Response:
        drone, camera = f"{request.match_info['fleet']}/{request.match_info['drone']}", request.match_info["camera"]
        image = await self._pictures.newest(drone, camera)
        if image is None:
            return web.Response(status=204)
        return web.Response(body=image, content_type="image/jpeg")

    async def _ask(self, request: web.Request) -> web.Response:
        """Sends a command to drones; one answer for each. Only for this server's own page."""
        if (refusal := self._refusal_to_command(request)) is not None:
            return refusal
        try:
            drones, command, order = _asked(_object(await request.read()))
        except ValueError as error:
            return _text(400, str(error))
        operator = self._operator_of(request)
        loop, known = asyncio.get_running_loop(), self._source.known()
        silent = {drone for drone in drones if known.get(drone, Known()).delay_s is None}
        pools = [self._silent_threads if drone in silent else self._order_threads for drone in drones]
        ask = self._source.ask
        answers = await asyncio.gather(
            *(
                loop.run_in_executor(pool, ask, drone, command, order, operator)
                for pool, drone in zip(pools, drones, strict=True)
            )
        )
        told: dict[str, AnswerMessage] = dict(zip(drones, answers, strict=True))
        return web.json_response(told, dumps=_json)

    async def _simulate(self, request: web.Request) -> web.Response:
        """Sends a control to the simulation. Only for this server's own page."""
        if (refusal := self._refusal_to_command(request)) is not None:
            return refusal
        if self._simulation is None:
            return _text(403, "these drones are not simulated here: there is nothing to control beside them")
        try:
            body = _object(await request.read())
            control, value = str(body.get("control")), checked_control(body.get("control"), body.get("value"))
        except ValueError as error:
            return _text(400, str(error))
        answer = await asyncio.get_running_loop().run_in_executor(
            self._order_threads, self._simulation.ask, control, value, self._operator_of(request)
        )
        return web.json_response(answer, dumps=_json)

    def _refusal_to_command(self, request: web.Request) -> web.Response | None:
        """Why a command is refused; None: it comes from this server's own page, which may command."""
        session = request.cookies.get(self._access.cookie)
        if not is_own_origin(request.headers) or not self._access.is_token(
            session, request.headers.get("X-Flockd-Token")
        ):
            return _text(403, "commands are taken from this server's own page only; load it again")
        if not self._may_command:
            return _text(403, "this page shows, and commands nothing: `flockd fleet` was started so")
        return None

    async def _live(self, request: web.Request) -> web.StreamResponse:
        """Sends changes of rows. The page's first message has to contain its session's token."""
        if not is_own_origin(request.headers):
            return _text(403, "live data goes to this server's own page only")
        if self._pages >= MAX_PAGES:
            return _text(503, f"{MAX_PAGES} pages are open; close some")
        socket = web.WebSocketResponse(heartbeat=10.0, max_msg_size=MAX_REQUEST_BYTES)
        await socket.prepare(request)
        self._pages += 1
        try:
            with suppress(ConnectionError):  # the page was closed while something was sent to it
                await self._feed(request, socket)
        finally:
            self._pages -= 1
        return socket

    async def _feed(self, request: web.Request, socket: web.WebSocketResponse) -> None:
        """Runs until the page is closed."""
        try:
            first = await socket.receive(timeout=HELLO_S)
            hello = _object(first.data) if first.type == WSMsgType.TEXT else {}
        except TimeoutError:
            hello = {}
        if not self._access.is_token(request.cookies.get(self._access.cookie), hello.get("token")):
            await socket.close(code=4403, message=b"load the page again")
            return
        await socket.send_str(_json({"kind": "hello", "may_command": self._may_command}))
        await _Feed(self._source, socket, self._simulation).push()

    def _operator_of(self, request: web.Request) -> str:
        """The operator's name with the page's number and its computer."""
        session = request.cookies.get(self._access.cookie)
        elsewhere = request.remote not in {None, "127.0.0.1", "::1"}
        return f"{self._operator}, page {(session or '')[:4]}{f' at {request.remote}' if elsewhere else ''}"


class _Feed:
    """Sends one page the changes since its last message."""

    def __init__(self, source: LiveFleet, socket: web.WebSocketResponse, simulation: SimulationLink | None) -> None:
        self._source, self._socket, self._simulation = source, socket, simulation
        self._sent: dict[str, Row] = {}
        self._event: Event | None = None
        """State of the last message."""

    async def push(self) -> None:
        """Sends changes until the page is closed."""
        reading = asyncio.create_task(self._wait_for_end())
        try:
            while not reading.done():
                began_s = time.monotonic()
                await self._snapshot()
                rest_s = max(0.05, PUSH_EVERY_S - (time.monotonic() - began_s))
                await asyncio.wait({reading}, timeout=rest_s)
        finally:
            reading.cancel()

    async def _wait_for_end(self) -> None:
        async for _ in self._socket:
            pass

    async def _snapshot(self) -> None:
        time_s = self._source.now_s()
        rows = self._source.rows(time_s)
        changed = {key: row for key, row in rows.items() if self._sent.get(key) != row}
        self._sent = rows
        events = self._source.events()
        # Those that came later than the last; all where that is no longer remembered.
        seen = len(events) - events[::-1].index(self._event) if self._event in events else 0
        new = events[seen:]
        self._event = events[-1] if events else self._event
        message = {
            "kind": "rows",
            "time_s": time_s,
            "order": list(rows),
            "rows": changed,
            "events": new,
            "notes": self._source.notes(),
            "simulation": None if self._simulation is None else self._simulation.state(),
        }
        await self._socket.send_str(_json(message))


def _asked(body: Mapping[str, Any]) -> tuple[list[str], str, dict[str, object] | None]:
    """Drones, command and order of a request. Raises ValueError if it is invalid."""
    if not body:
        raise ValueError("a command is a JSON object")
    drones, command, order = body.get("drones"), body.get("command"), body.get("order")
    if not isinstance(drones, list) or not drones or not all(isinstance(drone, str) for drone in drones):
        raise ValueError("a command names its drones")
    if len(drones) > MAX_DRONES:
        raise ValueError(f"a command goes to {MAX_DRONES} drones at most")
    if command not in COMMANDS:
        raise ValueError(f"the page's commands are {', '.join(COMMANDS)}")
    if command not in {"goto", "velocity"}:
        return list(dict.fromkeys(drones)), command, None
    parse_order(command, order)
    return list(dict.fromkeys(drones)), command, order


def _object(text: str | bytes) -> dict[str, Any]:
    """The JSON object in a text; empty if there is none."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _text(status: int, sentence: str) -> web.Response:
    return web.Response(status=status, text=sentence)


def _json(value: object) -> str:
    """JSON with null for numbers that are not finite, so that one drone's faulty message does not hide the others."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), separators=(",", ":"), allow_nan=False)


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


EVERY_S, OF_SIMULATION_S = 1.0, 0.4
"""Shortest time between two pictures of a camera: over a radio link, and for a simulation on this computer."""
SHOWN_S = 5.0
"""Largest age of a picture that is shown while the next one is fetched."""
WAIT_S = 0.25
"""Time for which a request waits for a picture; a later picture is kept for the next request."""
SILENT_S = 5.0
"""Time after which a camera that gave no picture is queried again."""
_THREADS, _THREADS_A_DRONE = 16, 4
_MOST_KEPT = 500

Key = tuple[str, str]
"""A drone and a camera."""


class PagePictures:
    """Pictures for all pages: each camera is queried seldom, and no request waits for a drone for long.

    Call it on the event loop; queries wait on threads, a few for each drone.
    """

    def __init__(
        self,
        fetch: Callable[[str, str], bytes | None],
        every_s: float = EVERY_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``fetch``: gets a camera's picture from a drone, and waits. ``every_s``: shortest time between two of one
        camera."""
        self._fetch, self._every_s, self._clock = fetch, every_s, clock
        self._threads = ThreadPoolExecutor(_THREADS, "pictures for the fleet page")
        self._asking: dict[Key, asyncio.Task[None]] = {}
        self._made: dict[Key, tuple[float, bytes | None]] = {}

    async def newest(self, drone: str, camera: str) -> bytes | None:
        """The newest picture; None: there is no current one."""
        key, now_s = (drone, camera), self._clock()
        made_s, picture = self._made.get(key, (-SILENT_S, None))
        asking = self._asking.get(key)
        if asking is None and now_s - made_s >= (self._every_s if picture is not None else SILENT_S):
            of_drone = sum(one == drone for one, _ in self._asking)
            if len(self._asking) < _THREADS and of_drone < _THREADS_A_DRONE:
                asking = self._asking[key] = asyncio.create_task(self._ask(key))
        if asking is not None:
            await asyncio.wait({asking}, timeout=WAIT_S)
            made_s, picture = self._made.get(key, (-SILENT_S, None))
        return picture if self._clock() - made_s < SHOWN_S else None

    async def _ask(self, key: Key) -> None:
        try:
            picture = await asyncio.get_running_loop().run_in_executor(self._threads, self._fetch, *key)
            self._made.pop(key, None)
            self._made[key] = self._clock(), picture
            while len(self._made) > _MOST_KEPT:
                self._made.pop(next(iter(self._made)))
        finally:
            del self._asking[key]
