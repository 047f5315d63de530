"""Playback of recordings, on a fake clock."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from foxglove.websocket import PlaybackCommand, PlaybackStatus

from flockd.fleet.foxglove.playback import Playback

WALL_S = 1_700_000_000


class Recorded:
    """Ten seconds, of a clock that began long before."""

    span_s = (100.0, 110.0)

    def wall_s(self, time_s: float) -> float:
        return WALL_S + time_s


def request(*, play: bool, seek_s: int | None = None, speed: float = 1.0) -> Any:
    return SimpleNamespace(
        playback_command=PlaybackCommand.Play if play else PlaybackCommand.Pause,
        playback_speed=speed,
        seek_time=None if seek_s is None else (WALL_S + seek_s) * 10**9,
        request_id="r",
    )


def test_it_plays_pauses_seeks_and_begins_anew() -> None:
    now_s = [0.0]
    line = Playback(Recorded(), lambda: now_s[0])  # type: ignore[arg-type]
    now_s[0] = 5.0
    assert line.moved()[0] == 100.0, "nobody watches yet"
    line.on_subscribe(None, None)  # type: ignore[arg-type]
    now_s[0] = 8.0
    assert line.moved()[0] == 103.0
    state = line.on_playback_control_request(request(play=True, speed=2.0))
    assert (state.status, state.did_seek, state.request_id) == (PlaybackStatus.Playing, False, "r")
    now_s[0] = 9.0
    assert line.moved() == (105.0, False)
    state = line.on_playback_control_request(request(play=False, seek_s=101))
    assert (state.status, state.did_seek, state.current_time) == (PlaybackStatus.Paused, True, (WALL_S + 101) * 10**9)
    assert line.moved() == (101.0, True)
    now_s[0] = 50.0
    assert line.moved() == (101.0, False), "it jumped once"
    line.on_playback_control_request(request(play=True))
    now_s[0] = 90.0
    assert line.moved()[0] == 110.0
    assert line.state().status == PlaybackStatus.Ended
    state = line.on_playback_control_request(request(play=True))
    assert (state.status, state.did_seek) == (PlaybackStatus.Playing, True)
    now_s[0] = 91.0
    assert line.moved()[0] == 101.0, "from the begin"
    assert line.on_playback_control_request(request(play=True, seek_s=500)).current_time == (WALL_S + 110) * 10**9
