"""Publishes telemetry over zenoh, as one peer for all drones of a process."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

import numpy as np
import zenoh

from flockd.errors import UnavailableError
from flockd.telemetry.topics import PREFIX, TOPICS

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_NAME = re.compile(r"[A-Za-z0-9_.-]+")


class ZenohTelemetry:
    """A telemetry sink that puts each message under `flockd/v1/<fleet>/<drone>/<topic>`.

    It listens on and connects to the given endpoints only: it neither shouts nor hearkens on the network, as multicast
    scouting is off. A put never waits: without a subscriber it goes nowhere, and a congested link drops it. Raises
    UnavailableError when an endpoint cannot be used, and ValueError for a fleet's name that does not fit into a key.
    """

    def __init__(self, fleet: str, *, listen: Sequence[str] = (DEFAULT_ENDPOINT,), connect: Sequence[str] = ()) -> None:
        self._prefix = f"{PREFIX}/{_checked(fleet)}"
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        self._lost = 0
        try:
            self._session = zenoh.open(_peer_config(listen, connect))
        except zenoh.ZError as error:
            reason = str(error).split(" at ")[0].split(": [")[0]
            endpoints = ", ".join([*listen, *connect])
            raise UnavailableError(f"telemetry cannot use {endpoints} ({reason}); name another endpoint") from error

    @property
    def lost(self) -> int:
        """Messages that zenoh refused to take; congestion on the way is not known here."""
        return self._lost

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """Publishes one message; a number that is not finite becomes null.

        Raises ValueError for a topic that is not in `TOPICS` or a drone's name that does not fit into a key.
        """
        payload = json.dumps(_finite(message), allow_nan=False).encode()
        try:
            self._publisher(drone, topic).put(payload)
        except zenoh.ZError:  # telemetry never ends a flight
            self._lost += 1

    def close(self) -> None:
        """Ends the session; later messages are lost, and counted."""
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _publisher(self, drone: str, topic: str) -> zenoh.Publisher:
        publisher = self._publishers.get((drone, topic))
        if publisher is None:
            if topic not in TOPICS:
                raise ValueError(f"{topic!r} is not a topic; the topics are {', '.join(TOPICS)}")
            publisher = self._session.declare_publisher(
                f"{self._prefix}/{_checked(drone)}/{topic}",
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            self._publishers[drone, topic] = publisher
        return publisher


def _peer_config(listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
    """A peer opens without a router, unlike a client."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    return config


def _checked(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} does not fit into a key; use letters, digits, '_', '.' and '-'")
    return name


def _finite(value: object) -> object:
    """The same value in plain types, with null for every number that JSON cannot say."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
