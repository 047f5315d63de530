"""Queries to a drone over connections that have just been made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast
from unittest.mock import Mock

import pytest

from flockd.fleet import drone_queries
from flockd.fleet.drone_queries import DroneQueries
from flockd.onboard.daemon.operator_orders import OrderChecks
from flockd.onboard.telemetry.order_messages import parse_ask


class Session:
    """A connection that knows after so many queries what the drone replies to: before, a query ends at once."""

    def __init__(self, knows_after: int) -> None:
        self.knows_after, self.asked = knows_after, list[str]()

    def get(self, key: str, **_: Any) -> list[Any]:
        self.asked.append(key.rpartition("drone1/")[2])
        if len(self.asked) <= self.knows_after:
            return []
        texts = {"time": b'{"time_s": 1.0, "wall_s": null, "identity": "a"}'}
        text = texts.get(self.asked[-1], b'{"accepted": true, "sentence": "tried"}')
        payload = Mock(to_bytes=lambda: text, __len__=lambda _: len(text))
        return [Mock(ok=Mock(payload=payload))]


@pytest.mark.parametrize(("orders", "others"), [(0, 9), (2, 9), (9, 1)])
def test_a_command_waits_until_a_connection_knows_the_drone_and_is_sent_once(orders: int, others: int) -> None:
    over, beside = Session(orders), Session(others)
    answer = DroneQueries(beside, over).ask("fleet/drone1", "a", "hold", "operator")  # type: ignore[arg-type]
    assert answer == {"accepted": True, "sentence": "tried"}
    assert (over.asked + beside.asked).count("ask/hold") == 1


def test_an_order_overtaken_on_a_bad_link_is_not_carried_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """It waits two seconds for the drone's clock, and a later one does not. A Hold is carried out all the same."""
    now_s, carried_out = 100.0, list[str]()
    checks = OrderChecks("a", lambda: 900.0 + now_s)
    monkeypatch.setattr(drone_queries, "time", Mock(monotonic=lambda: now_s))

    class Link:
        """To the drone; ``meanwhile`` happens while the first query waits."""

        def __init__(self, meanwhile: Callable[[], object] = lambda: None) -> None:
            self.meanwhile = meanwhile

        def get(self, key: str, *, payload: bytes, **_: Any) -> list[Any]:
            nonlocal now_s
            command, said = key.rpartition("/")[2], b'{"accepted": true, "sentence": "tried"}'
            if command == "time":
                self.meanwhile()
                said = b'{"time_s": %f, "wall_s": null, "identity": "a"}' % (900.0 + now_s)
            elif checks.fault(command, ask := parse_ask(payload)) is None:
                checks.take(command, ask)
                carried_out.append(command)
            return [Mock(ok=Mock(payload=Mock(to_bytes=lambda: said, __len__=lambda _: len(said))))]

    def overtaken(first: str, second: str) -> list[str]:
        def meanwhile() -> None:
            nonlocal now_s
            now_s += 1.0
            queries.ask("fleet/drone1", "a", second, "anna")
            now_s += 1.0

        carried_out.clear()
        good, bad = cast("Any", Link()), cast("Any", Link(meanwhile))
        queries = DroneQueries(good, good)
        DroneQueries(bad, bad).ask("fleet/drone1", "a", first, "bert")
        return carried_out.copy()

    assert overtaken("resume", "hold") == ["hold"]
    assert overtaken("hold", "resume") == ["resume", "hold"]


def test_a_drone_that_never_replies_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone_queries, "ANSWER_S", 0.3)
    silent = Session(1000)
    assert DroneQueries(silent, silent).ask("fleet/drone1", "a", "hold", "operator") is None  # type: ignore[arg-type]
    assert set(silent.asked) == {"time"}
