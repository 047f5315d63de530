"""What a watcher may ask one drone over telemetry: each question waits for the reply. Nothing that flies asks."""

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
"""Ten times a drone's configuration, and twice a small picture."""
MAX_PICTURE_PX = 1024


class ClockReading(NamedTuple):
    """One exchange with a drone's clock."""

    delay_s: float
    """There and back."""
    ahead_s: float
    """The drone's wall clock less this computer's, known to half of the delay."""


class DroneQueries:
    """Queries to drones, each by its key `fleet/drone`; None where no valid reply comes in time.

    Every call waits for the reply, up to ``ANSWER_S``: not for an event loop.
    """

    def __init__(self, session: zenoh.Session, orders: zenoh.Session, prefix: str = PREFIX) -> None:
        """``orders``: another connection, or the same; nothing else goes over it. Both stay their owner's.

        ``prefix``: of the keys; another than drones' for what replies as they do.
        """
        self._session, self._orders, self._prefix = session, orders, prefix
        self._name, self._numbers = secrets.token_hex(8), itertools.count(1)

    def ask(
        self, drone: str, identity: str, command: str, operator: str, order: Mapping[str, object] | None = None
    ) -> AnswerMessage | None:
        """The answer to an operator's command. ``identity``: that of its liveliness token.

        The drone's clock is asked first, again and again: a connection that has just been made does not know yet what
        the drone replies to. The command itself is sent once.
        """
        until_s, session = time.monotonic() + ANSWER_S, self._orders
        while (now := self.message(f"{drone}/time", TimeMessage, session=session)) is None:
            if time.monotonic() >= until_s:
                return None
            session = self._session if session is self._orders else self._orders  # one may not be connected yet
            time.sleep(AGAIN_S)
        ask = AskMessage(
            identity=identity,
            operator=operator,
            session=self._name,
            sequence=next(self._numbers),
            time_s=now["time_s"],
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
        """How long the link takes, and how far the clocks are apart."""
        sent_s, began_s = time.time(), time.monotonic()
        reply = self.message(f"{drone}/time", TimeMessage)
        delay_s = time.monotonic() - began_s
        if reply is None or reply["wall_s"] is None:
            return None
        return ClockReading(delay_s, reply["wall_s"] - (sent_s + delay_s / 2))

    def image(self, drone: str, camera: str) -> bytes | None:
        """A small JPEG of what a camera sees."""
        image = self._reply(f"{drone}/image/{camera}", timeout_s=PICTURE_S)
        size_px = None if image is None else jpeg_size(image)
        return image if size_px is not None and max(size_px) <= MAX_PICTURE_PX else None

    def message(self, key: str, kind: type, payload: bytes = b"", *, session: zenoh.Session | None = None) -> Any:
        """The reply to a query for `fleet/drone/...`, where it is a message of this kind."""
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
        """The first reply that is not too long. What is asked over the connection for orders goes first."""
        priority = zenoh.Priority.DATA_LOW if session is None else zenoh.Priority.REAL_TIME
        for reply in (session or self._session).get(
            f"{self._prefix}/{key}", payload=payload, timeout=timeout_s, priority=priority
        ):
            if reply.ok is not None and len(reply.ok.payload) <= MAX_REPLY_BYTES:
                data: bytes = reply.ok.payload.to_bytes()
                return data
        return None
