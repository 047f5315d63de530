"""An operator's order counts once, while it is new, for the drone that it names; many orders fill no log."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from flockd.core.messages import MissionOrder
from flockd.flight.safety import State
from flockd.onboard.daemon.operator_orders import LATEST_S, MOST_SESSIONS, RECENT_S, OperatorCommands, OperatorRequests
from flockd.onboard.telemetry.topics import AnswerMessage

pytestmark = [pytest.mark.fault("order-replayed"), pytest.mark.fault("orders-without-end")]

ALLOWED = ("hold", "land", "resume", "goto")
GOAL = {"north_m": 3.0, "east_m": 1.0}


class Drone:
    """Takes every order that the checks let through; its clock is set by hand."""

    def __init__(self) -> None:
        self.now_s, self.state = 1000.0, State.NORMAL
        self.said: list[str] = []
        self.goals: list[MissionOrder] = []
        self.requests, self.loop = OperatorRequests(), asyncio.new_event_loop()
        self.commands = OperatorCommands(
            ALLOWED, self.requests, self.loop, self.said.append, order_fault=lambda order: None, fly=self.goals.append,
            state=lambda: self.state, identity="1f", clock=lambda: self.now_s,
        )  # fmt: skip

    def order(self, command: str, sequence: int, **more: Any) -> AnswerMessage:
        """An order of anna's, given now."""
        ask = {"identity": "1f", "operator": "anna", "session": "a", "sequence": sequence, "time_s": self.now_s}
        ask |= {"order": GOAL if command == "goto" else None, **more}
        answer = self.commands.handle(command, json.dumps(ask).encode())
        self.loop.call_soon(self.loop.stop)
        self.loop.run_forever()
        return answer


@pytest.fixture
def drone() -> Drone:
    return Drone()


def test_an_order_is_taken_once_and_says_who_gave_it(drone: Drone) -> None:
    assert drone.order("hold", 1)["accepted"]
    assert drone.requests.hold
    assert len(drone.said) == 1 and drone.said[0].endswith("hold: anna, order 1")
    drone.requests.hold = False
    answer = drone.order("hold", 1)
    assert not answer["accepted"] and answer["sentence"].startswith("order 1 ")
    assert not drone.requests.hold
    assert not drone.order("goto", 0)["accepted"], "an earlier one that came late"
    assert drone.order("goto", 2)["accepted"]
    assert [goal.place.tolist() for goal in drone.goals if goal.place is not None] == [[3.0, 1.0]]


@pytest.mark.parametrize("state", State)
def test_what_is_not_tried_is_not_said_to_be(drone: Drone, state: State) -> None:
    """A drone that the pilot or the autopilot flies is not landed by flockd. But it begins no flight any more."""
    drone.state = state
    flown = state.value in {"normal", "degraded", "hover", "asking"}
    for number, command in enumerate(("land", "hold")):
        answer = drone.order(command, number)
        assert answer["accepted"] and drone.requests.__dict__[command]
        assert ("is being tried" in answer["sentence"]) is flown
        assert (f"does not fly the drone now, as its state is {state}: " in answer["sentence"]) is not flown
    assert drone.order("goto", 2)["accepted"] is (flown and state.value != "asking")


@pytest.mark.parametrize(("age_s", "taken"), [(0.0, True), (4.9, True), (5.1, False), (-0.4, True), (-0.6, False)])
def test_an_order_counts_while_it_is_new(drone: Drone, age_s: float, taken: bool) -> None:
    answer = drone.order("land", 1, time_s=drone.now_s - age_s)
    assert (answer["accepted"], drone.requests.land) == (taken, taken)
    assert taken or f"an order counts for {LATEST_S:g} s; give it again" in answer["sentence"]


def test_an_order_for_another_drone_of_the_same_name_is_refused(drone: Drone) -> None:
    answer = drone.order("hold", 1, identity="2e")
    assert not answer["accepted"] and "'2e'" in answer["sentence"]
    assert not drone.requests.hold


def test_of_two_operators_the_later_one_wins_and_both_are_seen(drone: Drone) -> None:
    """Their orders overtake each other on the way; a hold is taken all the same."""
    given_s = drone.now_s
    drone.now_s += 1.0
    assert drone.order("resume", 7, operator="bert", session="b")["accepted"]
    drone.now_s += 1.0
    late = drone.order("goto", 1, time_s=given_s)
    assert not late["accepted"] and late["sentence"].startswith("bert gave a later order, resume")
    assert drone.goals == []
    assert drone.order("hold", 2, time_s=given_s)["accepted"]
    assert drone.commands.recent() == [
        {"operator": "anna", "command": "hold", "sequence": 2, "age_s": 0.0},
        {"operator": "bert", "command": "resume", "sequence": 7, "age_s": 1.0},
    ]
    drone.now_s += RECENT_S - 0.5
    assert [order["operator"] for order in drone.commands.recent()] == ["anna"]


@pytest.mark.parametrize(
    "payload",
    [
        b"", b"{}", b"[]", b"\xff", b"[" * 4000, b"9" * 5000, json.dumps({"north_m": 1, "east_m": 2}).encode(),
        b'{"identity":"1f","operator":"","session":"a","sequence":1,"time_s":1000.0,"order":null}',
        b'{"identity":"1f","operator":"a\\u001b","session":"a","sequence":1,"time_s":1000.0,"order":null}',
        b'{"identity":"1f","operator":"a","session":"a","sequence":1e3,"time_s":1000.0,"order":null}',
        b'{"identity":"1f","operator":"a","session":"a","sequence":1,"time_s":NaN,"order":null}',
        b'{"identity":"1f","operator":"a","session":"a","sequence":1,"time_s":1e308,"order":null}',
        b'{"identity":"\\ud800","operator":"a","session":"a","sequence":1,"time_s":1000.0,"order":null}',
    ],
)  # fmt: skip
def test_what_does_not_say_who_gives_it_is_no_order(drone: Drone, payload: bytes) -> None:
    answer = drone.commands.handle("hold", payload)
    assert answer["accepted"] is False
    assert answer["sentence"].startswith("an order")
    assert drone.commands.refused == 1


def test_sessions_without_end_do_not_fill_the_memory(drone: Drone) -> None:
    for number in range(3 * MOST_SESSIONS):
        assert drone.order("hold", 1, session=f"{number}", operator=f"{number}")["accepted"]
    assert len(drone.commands._checks._sequences) == MOST_SESSIONS
    assert len(drone.commands.recent()) == 8


@pytest.mark.parametrize(("per_second", "accepted"), [(400, False), (2, False), (400, True)])
def test_of_twenty_thousand_orders_a_few_hundred_fill_log_telemetry_and_recording(
    drone: Drone, per_second: int, accepted: bool
) -> None:
    ask = {"identity": "1f", "operator": "anna", "session": "a", "order": None}
    for number in range(20_000):
        drone.now_s += 1.0 / per_second
        payload = json.dumps({**ask, "sequence": number, "time_s": drone.now_s}).encode() if accepted else b"{"
        assert drone.commands.handle("hold", payload)["accepted"] == accepted
    assert 1 < len(drone.said) < 500
    counted = any("more before, which were not logged" in said for said in drone.said)
    assert counted == (accepted or per_second == 2), "a minute after a refusal that was not logged"
    assert drone.commands.refused == (0 if accepted else 20_000)
