"""Publishes telemetry over zenoh, as one peer for all drones of a process, and replies to queries."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import zenoh

from flockd.onboard.message_json import to_telemetry
from flockd.onboard.telemetry.topics import PREFIX, TOPICS, AboutMessage, AnswerMessage, TimeMessage, checked_name
from flockd.onboard.telemetry.zenoh_session import SessionOwner, open_session

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_RECEIVED_BYTES = 1 << 16
"""Longer messages are dropped before they are completely in memory; an order has less than 1 KiB."""
MAX_PEERS = 32
"""Largest number of peers. A fleet command is two; each may leave 8 unfinished messages, one for each priority."""

Ask = Callable[[str, bytes], AnswerMessage]
"""Takes an operator's command by name, with its query's payload, on a thread of zenoh's; returns at once."""
Declared = zenoh.LivelinessToken | zenoh.Queryable[None]
NewestImage = Callable[[str], bytes | None]
"""A camera's newest image as JPEG, on a thread of zenoh's; None without one."""


class ZenohTelemetry(SessionOwner):
    """A telemetry sink that publishes each message under `flockd/v1/<fleet>/<drone>/<topic>`.

    It listens on and connects to the given endpoints only; discovery by multicast and gossip is disabled. Publishing
    never waits: a message without a subscriber is discarded, and a congested link drops it. Raises UnavailableError if
    an endpoint or the file of settings cannot be used, and ValueError if a fleet's name does not fit into a key.
    """

    def __init__(
        self,
        fleet: str,
        *,
        listen: Sequence[str] = (DEFAULT_ENDPOINT,),
        connect: Sequence[str] = (),
        settings: Path | None = None,
        awaits_addresses: bool = False,
    ) -> None:
        self._prefix = f"{PREFIX}/{checked_name(fleet)}"
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        self._kept: dict[str, list[Declared]] = {}
        """The declarations of each drone."""
        self.lost = 0
        """Messages that zenoh refused; congestion on the way is not counted."""
        self.identity = secrets.token_hex(4)
        """Distinguishes this process's drones from others of the same name."""
        # Memory shared by another process counts as the drone's, without a limit.
        self._session = open_session(
            "telemetry",
            listen,
            connect,
            settings=settings,
            shared_memory=False,
            max_message_bytes=MAX_RECEIVED_BYTES,
            max_peers=MAX_PEERS,
            awaits_addresses=awaits_addresses,
        )

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """Publishes one message; a number that is not finite becomes null.

        Raises ValueError if the topic is not in `TOPICS` or the drone's name does not fit into a key.
        """
        payload = json.dumps(to_telemetry(message), allow_nan=False).encode()
        try:
            self._publisher(drone, topic).put(payload)
        except zenoh.ZError:  # telemetry never ends a flight
            self.lost += 1

    def show_alive(self, drone: str) -> None:
        """Publishes that a drone is alive while this session exists, and replies to queries for its clocks."""
        key = f"{self._prefix}/{checked_name(drone)}"
        self._keep(
            drone,
            self._session.liveliness().declare_token(f"{key}/alive/{self.identity}"),
            self._queryable(f"{key}/time", self._tell_time),
        )

    def announce(self, drone: str, about: AboutMessage, ask: Ask, newest_image: NewestImage) -> None:
        """Publishes that a drone is alive while this session exists, and replies to queries.

        Queries ask for its configuration, its clocks, operators' commands, and a camera's newest image.
        """
        self.show_alive(drone)
        key = f"{self._prefix}/{drone}"
        self._keep(
            drone,
            self._queryable(f"{key}/about", lambda query: _reply(query, about)),
            self._queryable(
                f"{key}/ask/*",
                lambda query: _reply(query, ask(str(query.key_expr).rpartition("/")[2], _payload(query))),
            ),
            self._queryable(f"{key}/image/*", lambda query: _send_image(query, newest_image)),
        )

    def withdraw(self, drone: str) -> None:
        """A drone is not alive any more, and does not reply."""
        for declared in self._kept.pop(drone, []):
            declared.undeclare()  # type: ignore[no-untyped-call]

    def reply_to(self, keys: str, reply: Callable[[str, bytes], Mapping[str, object]]) -> None:
        """Replies to queries for keys that belong to no drone, by the last part of the key and the payload.

        On threads of zenoh's. Raises ValueError for keys of drones.
        """
        if keys.startswith(f"{PREFIX}/"):
            raise ValueError(f"{keys!r} is a drone's")
        self._keep(
            keys,
            self._queryable(
                keys, lambda query: _reply(query, reply(str(query.key_expr).rpartition("/")[2], _payload(query)))
            ),
        )

    def _queryable(self, keys: str, answer: Callable[[zenoh.Query], None]) -> Declared:
        """Replies on the receiving thread: a sender that asks too fast waits, and no queue grows."""
        return self._session.declare_queryable(keys, zenoh.handlers.Callback(answer, indirect=False))

    def _keep(self, what: str, *declared: Declared) -> None:
        self._kept.setdefault(what, []).extend(declared)

    def _tell_time(self, query: zenoh.Query) -> None:
        _reply(query, TimeMessage(time_s=time.monotonic(), wall_s=time.time(), identity=self.identity))

    def _publisher(self, drone: str, topic: str) -> zenoh.Publisher:
        publisher = self._publishers.get((drone, topic))
        if publisher is None:
            if topic not in TOPICS:
                raise ValueError(f"{topic!r} is not a topic; the topics are {', '.join(TOPICS)}")
            publisher = self._session.declare_publisher(
                f"{self._prefix}/{checked_name(drone)}/{topic}",
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            self._publishers[drone, topic] = publisher
        return publisher


def _payload(query: zenoh.Query) -> bytes:
    """The payload of the query; empty if it has none."""
    return b"" if query.payload is None else query.payload.to_bytes()


def _reply(query: zenoh.Query, message: Mapping[str, object]) -> None:
    """Replies under the key of the query; a query for several keys, as with `*`, gets one reply."""
    query.reply(
        query.key_expr, json.dumps(to_telemetry(message), allow_nan=False), encoding=zenoh.Encoding.APPLICATION_JSON
    )


def _send_image(query: zenoh.Query, newest_image: NewestImage) -> None:
    camera = str(query.key_expr).rpartition("/")[2]
    image = newest_image(camera)
    if image is None:
        query.reply_err(f"camera {camera!r} has no image", encoding=zenoh.Encoding.TEXT_PLAIN)
    else:
        query.reply(query.key_expr, image, encoding=zenoh.Encoding.IMAGE_JPEG)
