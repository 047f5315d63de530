"""Queries of a watcher to one drone over telemetry. Code that flies does not use them."""

from __future__ import annotations

import itertools
import json
import secrets
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import zenoh

from flockd.core.jpeg_header import jpeg_size
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.telemetry.topics import PREFIX, AboutMessage, AnswerMessage, AskMessage, TimeMessage

ANSWER_S = 3.0
PICTURE_S = 1.5
AGAIN_S = 0.1
MAX_REPLY_BYTES = 1 << 16
"""Largest reply: ten times a drone's configuration, twice a small picture."""
MAX_PICTURE_PX = 1024


class ClockReading(NamedTuple):
    """One exchange with a drone's clock."""

    delay_s: float
    """There and back."""
    ahead_s: float
    """The drone's wall clock minus this computer's, accurate to half of the delay."""


class DroneQueries:
    """Queries to drones by their keys `fleet/drone`. The result is None if no valid reply comes in time.

    Every call waits up to ``ANSWER_S`` for the reply: do not call it on an event loop.
    """

    def __init__(self, session: zenoh.Session, orders: zenoh.Session, prefix: str = PREFIX) -> None:
        """``orders``: the session for orders alone, which may be the same. The caller closes both.

        ``prefix``: of the keys; a simulator that replies like a drone has another one.
        """
        self._session, self._orders, self._prefix = session, orders, prefix
        self._name, self._numbers = secrets.token_hex(8), itertools.count(1)

    def ask(
        self, drone: str, identity: str, command: str, operator: str, order: Mapping[str, object] | None = None
    ) -> AnswerMessage | None:
        """The answer to an operator's command. ``identity``: of the drone's liveliness token.

        First it queries the drone's clock, repeatedly, because a new connection does not know the drone's keys yet. It
        sends the command once, with the time of this call on that clock: on a bad link a later command may overtake it.
        """
        given_s, session = time.monotonic(), self._orders
        while (now := self.message(f"{drone}/time", TimeMessage, session=session)) is None:
            if time.monotonic() >= given_s + ANSWER_S:
                return None
            session = self._session if session is self._orders else self._orders  # one may not be connected yet
            time.sleep(AGAIN_S)
        ask = AskMessage(
            identity=identity,
            operator=operator,
            session=self._name,
            sequence=next(self._numbers),
            time_s=now["time_s"] - (time.monotonic() - given_s),
            order=None if order is None else {**order},
        )
        payload = json.dumps(ask, allow_nan=False).encode()
        answer: AnswerMessage | None = self.message(f"{drone}/ask/{command}", AnswerMessage, payload, session=session)
        return answer

    def about(self, drone: str) -> AboutMessage | None:
        """The drone's configuration."""
        about: AboutMessage | None = self.message(f"{drone}/about", AboutMessage)
        return about

    def clock(self, drone: str) -> ClockReading | None:
        """Delay of the link, and difference of the clocks."""
        sent_s, began_s = time.time(), time.monotonic()
        reply = self.message(f"{drone}/time", TimeMessage)
        delay_s = time.monotonic() - began_s
        if reply is None or reply["wall_s"] is None:
            return None
        return ClockReading(delay_s, reply["wall_s"] - (sent_s + delay_s / 2))

    def image(self, drone: str, camera: str) -> bytes | None:
        """A small JPEG of a camera's image."""
        image = self._reply(f"{drone}/image/{camera}", timeout_s=PICTURE_S)
        size_px = None if image is None else jpeg_size(image)
        return image if size_px is not None and max(size_px) <= MAX_PICTURE_PX else None

    def message(self, key: str, kind: type, payload: bytes = b"", *, session: zenoh.Session | None = None) -> Any:
        """The reply to a query for `fleet/drone/...`; None: it is no message of this kind."""
        raw = self._reply(key, payload, session=session)
        if raw is None:
            return None
        try:
            return from_json(kind, parsed(raw))
        except ValueError:
            return None

    def _reply(
        self, key: str, payload: bytes = b"", *, timeout_s: float = ANSWER_S, session: zenoh.Session | None = None
    ) -> bytes | None:
        """The first reply that is not too long; None: no reply."""
        priority = zenoh.Priority.DATA_LOW if session is None else zenoh.Priority.REAL_TIME
        for reply in (session or self._session).get(
            f"{self._prefix}/{key}", payload=payload, timeout=timeout_s, priority=priority
        ):
            if reply.ok is not None and len(reply.ok.payload) <= MAX_REPLY_BYTES:
                data: bytes = reply.ok.payload.to_bytes()
                return data
        return None
