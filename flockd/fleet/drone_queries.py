"""What a watcher may ask one drone over telemetry: each question waits for the reply. Nothing that flies asks."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import zenoh

from flockd.onboard.telemetry.schema import fault
from flockd.onboard.telemetry.topics import PREFIX, AboutMessage, AnswerMessage, TimeMessage

ANSWER_S = 3.0


class ClockReading(NamedTuple):
    """One exchange with a drone's clock."""

    delay_s: float
    """There and back."""
    ahead_s: float
    """The drone's wall clock less this computer's, known to half of the delay."""


class DroneQueries:
    """Queries to drones, each by its key `fleet/drone`; None where no reply comes in time, or none that is one.

    Every call waits for the reply, up to ``ANSWER_S``: not for an event loop.
    """

    def __init__(self, session: zenoh.Session) -> None:
        """``session``: stays its owner's."""
        self._session = session

    def ask(self, drone: str, command: str, message: Mapping[str, object] | None = None) -> AnswerMessage | None:
        """The answer to an operator's command."""
        payload = b"" if message is None else json.dumps(message, allow_nan=False).encode()
        answer: AnswerMessage | None = self._message(f"{drone}/ask/{command}", AnswerMessage, payload)
        return answer

    def about(self, drone: str) -> AboutMessage | None:
        """What a drone flies with."""
        about: AboutMessage | None = self._message(f"{drone}/about", AboutMessage)
        return about

    def clock(self, drone: str) -> ClockReading | None:
        """How long the link takes, and how far the clocks are apart."""
        sent_s, began_s = time.time(), time.monotonic()
        reply = self._message(f"{drone}/time", TimeMessage)
        delay_s = time.monotonic() - began_s
        if reply is None or reply["wall_s"] is None:
            return None
        return ClockReading(delay_s, reply["wall_s"] - (sent_s + delay_s / 2))

    def image(self, drone: str, camera: str) -> bytes | None:
        """A small JPEG of what a camera sees."""
        return self._reply(f"{drone}/image/{camera}")

    def _message(self, key: str, kind: type, payload: bytes = b"") -> Any:
        """A reply that is a message of this kind."""
        raw = self._reply(key, payload)
        if raw is None:
            return None
        try:
            message = json.loads(raw)
        except (ValueError, RecursionError):
            return None
        return None if fault(message, kind) else message

    def _reply(self, key: str, payload: bytes = b"") -> bytes | None:
        for reply in self._session.get(f"{PREFIX}/{key}", payload=payload, timeout=ANSWER_S):
            if reply.ok is not None:
                data: bytes = reply.ok.payload.to_bytes()
                return data
        return None
