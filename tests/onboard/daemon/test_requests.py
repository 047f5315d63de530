"""Requests to the autopilot to take over, with one that never answers."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from flockd.onboard.autopilot.autopilot_status import AutopilotError, AutopilotStatus, FlightMode
from flockd.onboard.daemon.autopilot_tasks import AutopilotRequests, Takeover
from tests.calm import run_stepped
from tests.make import autopilot_status

SILENT = "has not responded yet"


class _Dead:
    """An autopilot that takes no request any more."""

    def __init__(self) -> None:
        self.asked = 0
        self.mode: FlightMode = "offboard"

    def status(self) -> AutopilotStatus:
        return autopilot_status(flight_mode=self.mode)

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


class _Reluctant(_Dead):
    """It holds at once, as it is asked to before each landing, and refuses the rest a few times."""

    requests: AutopilotRequests
    refusals: int

    async def hold(self) -> None:
        self.asked += 1
        self.mode = "hold"
        self.requests.takeover = None
        if self.asked <= self.refusals:
            raise AutopilotError("refused")

    return_home = land = hold


@pytest.mark.parametrize(
    ("takeover", "pilot", "refusals", "asked"),
    [
        ("land", None, 2, 3),
        ("return", None, 2, 3),
        ("land", "position", 2, 1),
        ("hold", None, 2, 1),
        ("land", None, 1000, 18),
    ],
    ids=["land", "return", "the pilot takes over", "hold", "refused for good"],
)
def test_a_landing_is_asked_for_from_the_hold_before_it_until_it_is_granted(
    takeover: Takeover, pilot: FlightMode | None, refusals: int, asked: int
) -> None:
    """Hold ends the flight, so that the control loop's own request ends too. 18: one, and 17 that begin
    0.3 s apart within 5 s."""
    reluctant = _Reluctant()
    reluctant.refusals = refusals
    requests = AutopilotRequests(cast("Any", reluctant), lambda event: None)
    reluctant.requests = requests

    async def story() -> None:
        task = asyncio.create_task(requests.run())
        requests.takeover = takeover
        await asyncio.sleep(0.1)
        assert requests.asking is (takeover != "hold")
        reluctant.mode = pilot or reluctant.mode
        await asyncio.sleep(8.0)
        assert (reluctant.asked, requests.asking) == (asked, False)
        task.cancel()

    run_stepped(story)
