"""Where the playback of recordings is, as the app's controls move it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import foxglove.websocket as fw

from flockd.fleet.page.fleet_source import FleetSource


class Playback(fw.ServerListener):
    """The time line of recordings: it starts when somebody first subscribes."""

    def __init__(self, source: FleetSource, clock: Callable[[], float] = time.monotonic) -> None:
        """``source``: of recordings, whose ``span_s`` is not None."""
        assert source.span_s is not None
        self._begin_s, self._end_s = source.span_s
        self._wall_s = source.wall_s
        self._clock = clock
        self._lock = threading.Lock()
        self._at_s, self._read_s = self._begin_s, clock()
        self._speed = 1.0
        self._playing = self._started = self._jumped = False

    @property
    def range_ns(self) -> tuple[int, int]:
        """Begin and end, in nanoseconds since 1970."""
        return self._wall_ns(self._begin_s), self._wall_ns(self._end_s)

    def moved(self) -> tuple[float, bool]:
        """The time to show, and whether it jumped since the last call: somebody chose it, or it began anew."""
        with self._lock:
            jumped, self._jumped = self._jumped, False
            return self._advanced(), jumped

    def state(self) -> fw.PlaybackState:
        """For the app's controls."""
        with self._lock:
            return self._state()

    def on_subscribe(self, client: fw.Client, channel: fw.ChannelView) -> None:
        """Called by the server, on a thread of its own; so what follows."""
        with self._lock:
            if not self._started:
                self._started = self._playing = True
                self._read_s = self._clock()

    def on_playback_control_request(self, playback_control_request: fw.PlaybackControlRequest) -> fw.PlaybackState:
        """Plays, pauses, changes the speed, goes elsewhere; after the end, playing begins anew."""
        request = playback_control_request
        with self._lock:
            self._advanced()
            self._started = True
            if request.playback_speed > 0:
                self._speed = request.playback_speed
            self._playing = request.playback_command == fw.PlaybackCommand.Play
            wanted_s = self._at_s
            if request.seek_time is not None:
                wanted_s = self._begin_s + 1e-9 * (request.seek_time - self._wall_ns(self._begin_s))
            elif self._playing and self._at_s >= self._end_s:
                wanted_s = self._begin_s
            seeks = wanted_s != self._at_s
            self._at_s = min(max(wanted_s, self._begin_s), self._end_s)
            self._jumped |= seeks
            return self._state(did_seek=seeks, request_id=request.request_id)

    def _advanced(self) -> float:
        now_s = self._clock()
        if self._playing:
            self._at_s = min(self._at_s + self._speed * (now_s - self._read_s), self._end_s)
            self._playing = self._at_s < self._end_s
        self._read_s = now_s
        return self._at_s

    def _state(self, *, did_seek: bool = False, request_id: str | None = None) -> fw.PlaybackState:
        ended = self._at_s >= self._end_s
        status = (
            fw.PlaybackStatus.Playing
            if self._playing
            else fw.PlaybackStatus.Ended
            if ended
            else fw.PlaybackStatus.Paused
        )
        return fw.PlaybackState(status, self._wall_ns(self._at_s), self._speed, did_seek, request_id)

    def _wall_ns(self, time_s: float) -> int:
        return round(1e9 * self._wall_s(time_s))
