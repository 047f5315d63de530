"""A client of Foxglove's WebSocket protocol, for tests: written from the protocol, without the server's library."""

from __future__ import annotations

import asyncio
import json
import re
import struct
from collections.abc import Callable
from typing import Any, Self

import aiohttp

PATIENCE_S = 60.0
_MESSAGE_DATA = 1
_PLAYBACK_CONTROL, _PLAY, _PAUSE = 3, 0, 1


class FoxgloveClient:
    """Subscribes to every channel that is advertised, and keeps what comes."""

    def __init__(self, port: int, origin: str | None = None) -> None:
        self._port, self._origin = port, origin
        self.server: dict[str, Any] = {}
        self.statuses: list[dict[str, Any]] = []
        self.channels: dict[str, dict[str, Any]] = {}
        """By topic."""
        self.messages: dict[str, list[tuple[int, bytes]]] = {}
        """By topic: the time of each in nanoseconds, and its data."""
        self.other: list[bytes] = []
        """Binary messages of other kinds."""
        self._topics: dict[int, str] = {}

    async def __aenter__(self) -> Self:
        self._session = aiohttp.ClientSession()
        self.socket = await self._session.ws_connect(
            f"ws://127.0.0.1:{self._port}", protocols=["foxglove.sdk.v1"], origin=self._origin
        )
        assert self.socket.protocol == "foxglove.sdk.v1"
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.socket.close()
        await self._session.close()

    async def until(self, true: Callable[[Self], object]) -> None:
        """Takes what comes until it is true; fails where that does not happen."""
        async with asyncio.timeout(PATIENCE_S):
            while not true(self):
                message = await self.socket.receive()
                assert message.type in {aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY}, message
                if message.type == aiohttp.WSMsgType.TEXT:
                    await self._take(json.loads(message.data))
                elif message.data[0] == _MESSAGE_DATA:
                    subscription, time_ns = struct.unpack("<IQ", message.data[1:13])
                    self.messages.setdefault(self._topics[subscription], []).append((time_ns, message.data[13:]))
                else:
                    self.other.append(message.data)

    async def go_to(self, time_ns: int, *, play: bool, speed: float = 1.0) -> None:
        """Asks the playback to go to a time."""
        command, name = _PLAY if play else _PAUSE, b"request"
        asked = struct.pack("<BBf?QI", _PLAYBACK_CONTROL, command, speed, True, time_ns, len(name)) + name
        await self.socket.send_bytes(asked)

    def json(self, topic: str) -> dict[str, Any]:
        """The newest message of a topic."""
        message: dict[str, Any] = json.loads(self.messages[topic][-1][1])
        return message

    def decoded(self, topic: str, kind: Any) -> Any:
        """The newest message of a topic, by the schemas' own package."""
        message = kind()
        message.ParseFromString(self.messages[topic][-1][1])
        assert self.channels[topic]["schemaName"] == kind.DESCRIPTOR.full_name
        return message

    async def _take(self, message: dict[str, Any]) -> None:
        if message["op"] == "serverInfo":
            self.server = message
        elif message["op"] == "status":
            refused = re.fullmatch(r"Unknown channel ID: (\d+)", message["message"])
            if refused and int(refused[1]) in self._topics:  # advertised, but the server was not ready for it
                await asyncio.sleep(0.05)
                await self._subscribe(int(refused[1]))
            else:
                self.statuses.append(message)
        elif message["op"] == "advertise":
            for channel in message["channels"]:
                self.channels[channel["topic"]] = channel
                self._topics[channel["id"]] = channel["topic"]
                await self._subscribe(channel["id"])

    async def _subscribe(self, channel: int) -> None:
        await self.socket.send_json({"op": "subscribe", "subscriptions": [{"id": channel, "channelId": channel}]})
