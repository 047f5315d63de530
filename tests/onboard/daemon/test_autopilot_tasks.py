"""What the daemon asks of the autopilot, one that never answers too, and the texts that it sends."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from flockd.flight.safety import Action, Decision, Event, State
from flockd.flight.safety.supervisor import Reason
from flockd.onboard.autopilot.autopilot_status import AutopilotError, AutopilotStatus, FlightMode
from flockd.onboard.autopilot.mavlink_messages import text_chunks
from flockd.onboard.autopilot.mavsdk_link import Severity
from flockd.onboard.daemon.autopilot_tasks import SEVERITIES, AutopilotRequests, StateTexts, Takeover
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


ALONE = Reason(Event.NEIGHBOURS_LOST, "no neighbour was seen for 3 s")
BLIND = Reason(Event.SIGHT_LOST, "no camera works")


def decided(state: State, *reasons: Reason) -> Decision:
    return Decision(state, Action.SILENCE, reasons)


class Told:
    """Texts by the time at which they were sent."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.sent: list[tuple[float, str, Severity]] = []
        self.texts = StateTexts(lambda text, severity: self.sent.append((self.now_s, text, severity)), self.clock)

    def clock(self) -> float:
        return self.now_s

    def fly(self, state: State, until_s: float, *reasons: Reason) -> None:
        while self.now_s < until_s:
            self.texts.update(decided(state, *reasons))
            self.now_s = round(self.now_s + 0.05, 2)


def test_each_state_is_told_once_with_its_reasons() -> None:
    told = Told()
    told.fly(State.READY, 5.0)
    told.fly(State.NORMAL, 10.0, ALONE)
    told.fly(State.HOVER, 15.0, BLIND, ALONE)
    assert told.sent == [
        (0.0, "flockd ready", Severity.INFO),
        (5.0, "flockd normal: no neighbour was seen for 3 s", Severity.INFO),
        (10.0, "flockd hover: no camera works; no neighbour was seen for 3 s", Severity.WARNING),
    ]


def test_one_that_comes_and_goes_is_told_every_two_seconds_at_most_and_the_last_one_always() -> None:
    told = Told()
    told.fly(State.HOVER, 5.0)
    while told.now_s < 15.0:
        told.fly(State.NORMAL, told.now_s + 0.3)
        told.fly(State.DEGRADED, told.now_s + 0.3)
    told.fly(State.NORMAL, 20.0)
    times_s = [time_s for time_s, _, _ in told.sent]
    lighter = [b - a for a, b, (_, _, severity) in zip(times_s, times_s[1:], told.sent[1:], strict=False)
               if severity == Severity.INFO]  # fmt: skip
    assert min(lighter) >= 2.0
    assert len(told.sent) <= 2 + 2 * 15 / 2
    assert told.sent[-1][1] == "flockd normal"


def test_a_graver_one_does_not_wait() -> None:
    told = Told()
    told.fly(State.NORMAL, 0.1)
    told.fly(State.HOVER, 0.2, BLIND)
    told.fly(State.ASKING, 0.3, BLIND)
    told.fly(State.SILENT, 3.0, BLIND)
    assert [(time_s, text.split(":")[0]) for time_s, text, _ in told.sent] == [
        (0.0, "flockd normal"),
        (0.1, "flockd hover"),
        (0.2, "flockd asking"),
        (2.2, "flockd silent"),
    ]
    assert SEVERITIES.keys() == set(State)


def test_chunks_are_mavlinks() -> None:
    """STATUSTEXT: 50 bytes; an id above 0 for several chunks; the last one ends within its bytes."""
    assert list(text_chunks("ready", 7)) == [{"id": 0, "chunk_seq": 0, "text": "ready"}]
    assert list(text_chunks(50 * "x", 7)) == [
        {"id": 7, "chunk_seq": 0, "text": 50 * "x"},
        {"id": 7, "chunk_seq": 1, "text": ""},
    ]
    chunks = list(text_chunks(300 * "x", 7))
    assert [len(chunk["text"]) for chunk in chunks] == [50, 50, 25]
    assert chunks[-1]["text"].endswith("x...")
