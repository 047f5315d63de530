"""What ground stations are told of the daemon's state: each once, not too often, the grave at once."""

from __future__ import annotations

from flockd.flight.safety import Action, Decision, Event, State
from flockd.flight.safety.supervisor import Reason
from flockd.onboard.autopilot.mavlink_messages import text_chunks
from flockd.onboard.autopilot.mavsdk_link import Severity
from flockd.onboard.daemon.autopilot_tasks import SEVERITIES, StateTexts

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
