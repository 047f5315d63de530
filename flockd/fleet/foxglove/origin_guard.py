"""Lets programs and Foxglove's own web app reach the server, and no stranger's web page that a browser here has open.

A browser lets any page connect to any address, and says whose page it is: `Origin`. The SDK's server does not look at
it. So that one listens at an address of this computer's own that nobody can guess, and this one passes on to it.
"""

from __future__ import annotations

import asyncio
import os
import re
import secrets
import threading
from collections.abc import Callable, Collection
from concurrent.futures import Future
from contextlib import closing, suppress
from typing import Self

from flockd.core.errors import UnavailableError
from flockd.core.printable import printable

APP = "https://app.foxglove.dev"
"""Foxglove's web app."""
MAX_CONNECTIONS = 64
HEAD_S = 5.0
"""For a client to say what it wants."""
_MAX_HEAD_BYTES = 1 << 14
_CHUNK_BYTES = 1 << 16
_UPGRADE = re.compile(rb"^upgrade:[ \t]*websocket[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_ORIGIN = re.compile(rb"^origin:[ \t]*([^\r\n]*?)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)


def hidden_address() -> str:
    """One of the 16 million of this computer's loopback network."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


class OriginGuard:
    """Passes connections on between ``__enter__`` and ``__exit__``, on a thread of its own."""

    def __init__(
        self,
        address: str,
        port: int,
        behind: tuple[str, int],
        origins: Collection[str],
        on_refusal: Callable[[str], None],
    ) -> None:
        """Listens.

        Args:
            address: where clients come to.
            port: the same; 0 for any.
            behind: address and port of the server that they are passed on to.
            origins: of web pages that may connect; programs that are no browser say none, and may.
            on_refusal: called once for each other origin, with one sentence.

        Raises UnavailableError where it cannot listen.
        """
        self._behind, self._origins, self._on_refusal = behind, frozenset(origins), on_refusal
        self._refused: set[str] = set()
        self._open: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._take, address, port))
        except OSError as error:
            self._loop.close()
            reason = os.strerror(error.errno) if error.errno else str(error)
            raise UnavailableError(f"the server cannot use {address} port {port} ({reason}); name others") from error
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="Foxglove connections", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        ended: Future[None] = asyncio.run_coroutine_threadsafe(self._end(), self._loop)
        ended.result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        for task in self._open:
            task.cancel()
        if self._open:
            await asyncio.wait(self._open)

    async def _take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client, until either side ends."""
        task = asyncio.current_task()
        assert task is not None
        self._open.add(task)
        try:
            with (
                closing(writer),
                suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError),
            ):
                if len(self._open) <= MAX_CONNECTIONS:
                    await self._serve(reader, writer)
        finally:
            self._open.discard(task)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(HEAD_S):
            head = await reader.readuntil(b"\r\n\r\n")
        origins = [origin.decode("ascii", "replace") for origin in _ORIGIN.findall(head)]
        stranger = next((origin for origin in origins if origin not in self._origins), None)
        sentence = None
        if stranger is not None:
            sentence = f"web pages of {printable(stranger, lines=False):.100} may not connect here"
            self._tell(stranger, sentence)
        elif _UPGRADE.search(head) is None or len(head) > _MAX_HEAD_BYTES:
            sentence = "this is a WebSocket server for Foxglove's app"
        if sentence is not None:
            body = f"{sentence}\n".encode()
            writer.write(
                b"HTTP/1.1 403 Forbidden\r\nContent-Length: %d\r\nConnection: close\r\n\r\n" % len(body) + body
            )
            await writer.drain()
            return
        inner_reader, inner_writer = await asyncio.open_connection(*self._behind)
        with closing(inner_writer):
            inner_writer.write(head)
            directions = [
                asyncio.create_task(_pass_on(reader, inner_writer)),
                asyncio.create_task(_pass_on(inner_reader, writer)),
            ]
            try:
                await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for direction in directions:
                    direction.cancel()

    def _tell(self, origin: str, sentence: str) -> None:
        if origin not in self._refused and len(self._refused) < MAX_CONNECTIONS:
            self._refused.add(origin)
            self._on_refusal(f"{sentence}; if they are yours, start it with --allow-origin ORIGIN")


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_CHUNK_BYTES):
            writer.write(data)
            await writer.drain()
