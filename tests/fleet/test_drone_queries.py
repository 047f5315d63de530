"""Queries to a drone over connections that have just been made."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import pytest

from flockd.fleet import drone_queries
from flockd.fleet.drone_queries import DroneQueries


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


def test_a_drone_that_never_replies_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drone_queries, "ANSWER_S", 0.3)
    silent = Session(1000)
    assert DroneQueries(silent, silent).ask("fleet/drone1", "a", "hold", "operator") is None  # type: ignore[arg-type]
    assert set(silent.asked) == {"time"}
