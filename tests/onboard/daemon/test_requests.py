"""Requests to the autopilot to take over, with one that never answers."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from flockd.onboard.daemon.autopilot_tasks import AutopilotRequests
from tests.calm import run_stepped

SILENT = "has not responded yet"


class _Dead:
    """An autopilot that takes no request any more."""

    def __init__(self) -> None:
        self.asked = 0

    async def hold(self) -> None:
        self.asked += 1
        await asyncio.Event().wait()

    return_home = land = hold


def test_a_dead_autopilot_is_asked_again_and_again_but_reported_once() -> None:
    """Once in 1.3 s: a second for its answer, and 0.3 s until the next request."""
    events: list[str] = []
    dead = _Dead()
    requests = AutopilotRequests(cast("Any", dead), events.append)

    async def story() -> None:
        task = asyncio.create_task(requests.run())
        requests.takeover = "hold"
        await asyncio.sleep(8.0)
        assert dead.asked == 7
        assert len(events) == 1 and events[0].endswith(f"asked for hold and {SILENT}")
        requests.takeover = "land"
        await asyncio.sleep(8.0)
        assert len(events) == 2 and events[1].endswith(f"asked for land and {SILENT}")
        await asyncio.sleep(30.0)
        assert events[2:] == events[1:2], "now and then the same is said again"
        task.cancel()

    run_stepped(story)
