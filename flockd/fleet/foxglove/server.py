"""Serves a fleet to Foxglove's app, until it is closed. Nothing can be sent to drones through it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import foxglove
from foxglove.websocket import Capability, PlaybackStatus, WebSocketServer

from flockd.core.errors import UnavailableError
from flockd.fleet.foxglove.fleet_publisher import FleetPublisher
from flockd.fleet.foxglove.origin_guard import APP, OriginGuard, hidden_address
from flockd.fleet.foxglove.playback import Playback
from flockd.fleet.page.fleet_source import FleetSource

UPDATE_EVERY_S = 0.25


class FoxgloveServer:
    """Publishes between ``__enter__`` and ``__exit__``, on a thread of its own."""

    def __init__(
        self,
        source: FleetSource,
        address: str,
        port: int,
        *,
        origins: Collection[str] = (),
        on_refusal: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """Raises UnavailableError where it cannot listen.

        Args:
            source: of the fleet; stays its owner's.
            address: where it listens.
            port: the same; 0 for any.
            origins: of web pages that may connect, beside Foxglove's own.
            on_refusal: called with one sentence when another one tries to.
        """
        context = foxglove.Context()
        self._playback = None if source.span_s is None else Playback(source)
        hidden = hidden_address()
        self._server = _listening(context, hidden, 0, self._playback)
        try:
            self._guard = OriginGuard(address, port, (hidden, self._server.port), {APP, *origins}, on_refusal)
        except UnavailableError:
            self._server.stop()
            raise
        self.port = self._guard.port
        self._source, self._publisher = source, FleetPublisher(source, context)
        self._over = threading.Event()
        self._thread = ThreadPoolExecutor(1, "Foxglove server")

    def __enter__(self) -> Self:
        self._guard.__enter__()
        self._publishing = self._thread.submit(self._publish)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.shutdown()
        self._guard.__exit__()
        self._server.stop()
        self._publisher.close()

    def wait(self) -> None:
        """Until it is closed. Raises what ended it before."""
        self._publishing.result()

    def _publish(self) -> None:
        status = PlaybackStatus.Paused
        while not self._over.wait(UPDATE_EVERY_S):
            if self._playback is None:
                self._publisher.update(self._source.now_s())
            else:
                time_s, jumped = self._playback.moved()
                self._publisher.update(time_s, jumped=jumped)
                state = self._playback.state()
                self._server.broadcast_time(state.current_time)
                if state.status != status:
                    status = state.status
                    self._server.broadcast_playback_state(state)


def _listening(context: foxglove.Context, address: str, port: int, playback: Playback | None) -> WebSocketServer:
    """Without any capability through which a client could send something, but for where a replay is."""
    try:
        if playback is None:
            return foxglove.start_server(name="flockd", host=address, port=port, context=context)
        return foxglove.start_server(
            name="flockd recordings", host=address, port=port, context=context, server_listener=playback,
            capabilities=[Capability.Time, Capability.PlaybackControl], playback_time_range=playback.range_ns,
        )  # fmt: skip
    except RuntimeError as error:  # of which FoxgloveError is a kind
        reason = str(error).rpartition(": ")[2]
        raise UnavailableError(f"the server cannot use {address} port {port} ({reason}); name others") from error
