"""Requests to the autopilot to take over, with one that never answers."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from flockd.onboard.daemon import autopilot_requests
from flockd.onboard.daemon.autopilot_requests import AutopilotRequests


class _Dead:
    """An autopilot that takes no request any more."""

    def __init__(self) -> None:
        self.asked = 0

    async def hold(self) -> None:
        self.asked += 1
        await asyncio.Event().wait()

    return_home = land = hold


def test_a_dead_autopilot_is_asked_again_and_again_but_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(autopilot_requests, "REPLY_S", 0.01)
    monkeypatch.setattr(autopilot_requests, "RETRY_S", 0.01)
    events: list[str] = []
    dead = _Dead()
    requests = AutopilotRequests(cast("Any", dead), events.append)

    async def ask(times: int) -> None:
        task = asyncio.create_task(requests.run())
        until = dead.asked + times
        while dead.asked < until:
            await asyncio.sleep(0.005)
        task.cancel()

    requests.takeover = "hold"
    asyncio.run(ask(5))
    assert events == ["the autopilot was asked for hold and has not responded yet"]
    requests.takeover = "land"
    asyncio.run(ask(3))
    assert events[1:] == ["the autopilot was asked for land and has not responded yet"]
    monkeypatch.setattr(autopilot_requests, "SAME_AGAIN_S", 0.0)
    asyncio.run(ask(3))
    assert len(events) >= 4, "now and then the same is said again"
