"""Connections to the page's server: strangers' are few and short, so that they lock nobody out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection

from aiohttp import web

MAX_STRANGERS = 64
"""Connections over which no page with the key has asked for anything; one more closes the oldest."""
STRANGER_S = 10.0
"""For a whole request; a browser needs a fraction of a second."""
_TIDY_EVERY_S = 1.0


class PageConnections:
    """A protocol factory for the event loop, around aiohttp's own."""

    def __init__(self, server: web.Server, trusted: set[object], clock: Callable[[], float] = time.monotonic) -> None:
        """``trusted``: connections that have shown the key; those that have ended are taken out of it here."""
        self._server, self._trusted, self._clock = server, trusted, clock
        self._since_s: dict[web.RequestHandler, float] = {}

    def __call__(self) -> asyncio.Protocol:
        """For a new connection."""
        self._tidy(MAX_STRANGERS - 1)
        return self._server()

    async def run(self) -> None:
        """Closes those that ask for nothing, until cancelled."""
        while True:
            await asyncio.sleep(_TIDY_EVERY_S)
            self._tidy(MAX_STRANGERS)

    def _tidy(self, most: int) -> None:
        now_s, connections = self._clock(), self._server.connections
        self._trusted.intersection_update(connections)
        self._since_s = {one: self._since_s.get(one, now_s) for one in connections}
        strangers = [one for one in connections if one not in self._trusted]
        late = sum(now_s - self._since_s[one] > STRANGER_S for one in strangers)
        _close(strangers[: max(late, len(strangers) - most, 0)])


def _close(connections: Collection[web.RequestHandler]) -> None:
    """The oldest come first: aiohttp keeps them in order."""
    for connection in connections:
        if connection.transport is not None:
            connection.transport.abort()
