"""The pace of a simulation that is flown live, and what people do to it; on a clock that only waiting moves."""

from __future__ import annotations

import itertools
import json
import threading
import time

import pytest

from flockd.sim.flock.live_flight import LiveControls
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.vehicles import UNDISTURBED, Disturbances, Vehicles
from tests import make

IDENTITY = "51m"


def scenario() -> ScenarioConfig:
    return make.scenario(drones=3)


class Bench:
    """Controls with a clock of their own, and an operator who gives each control its next number."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.numbers = itertools.count(1)
        self.while_waiting: list[tuple[str, object]] = []
        self.controls = LiveControls(
            scenario(), IDENTITY, by_sight=False, clock=lambda: self.now_s, wait=self.pass_time
        )
        self.controls.begin()

    def pass_time(self, changed: threading.Condition, seconds: float) -> None:
        self.now_s += seconds
        if self.while_waiting and self.controls.state()["paused"]:
            assert self.ask(*self.while_waiting.pop(0))[0]

    def ask(self, control: str, value: object = None, identity: str = IDENTITY) -> tuple[bool, str]:
        asked = {
            "operator": "anna", "session": "s", "sequence": next(self.numbers), "time_s": time.monotonic(),
            "identity": identity, "order": value,
        }  # fmt: skip
        answer = self.controls.ask(control, json.dumps(asked).encode())
        return answer["accepted"], answer["sentence"]

    def began_s(self, *times_s: float) -> list[float]:
        """When each step began, after the first instant."""
        began = []
        for time_s in times_s:
            assert self.controls.wait(time_s)
            began.append(self.now_s - 100.0)
        return began


def test_time_passes_as_fast_as_it_is_asked_to() -> None:
    bench = Bench()
    assert bench.began_s(0.0, 0.5, 1.0) == pytest.approx([0.0, 0.5, 1.0])
    assert bench.ask("speed", {"factor": 0.25})[0]
    assert bench.began_s(1.5, 2.0, 2.5) == pytest.approx([1.0, 3.0, 5.0]), "half a second takes two"
    state = bench.controls.state()
    assert (state["speed"], state["time_s"]) == (0.25, 2.5)
    assert state["speed_reached"] == pytest.approx(0.25)


def test_what_is_late_is_not_caught_up_with() -> None:
    bench = Bench()
    assert bench.began_s(0.0, 0.5) == pytest.approx([0.0, 0.5])
    bench.now_s += 3.0
    assert bench.began_s(1.0, 1.5, 2.0) == pytest.approx([3.5, 4.0, 4.5])


def test_no_step_begins_while_it_is_paused_and_none_is_caught_up_with() -> None:
    bench = Bench()
    bench.began_s(0.0, 0.5)
    assert bench.ask("pause")[0]
    assert bench.controls.state()["speed_reached"] is None
    bench.while_waiting = [("speed", {"factor": 1.0})] * 20 + [("go_on", None)]
    (again_s,) = bench.began_s(1.0)
    assert again_s >= 20 * 0.2, "all that time it stood still"
    assert bench.began_s(1.5) == pytest.approx([again_s + 0.5])


def test_a_restart_ends_the_flight_even_while_it_is_paused_and_takes_all_disturbances_away() -> None:
    bench = Bench()
    bench.began_s(0.0, 0.5)
    assert bench.ask("gusts", {"gust_m_s": 0.5})[0]
    assert bench.ask("remove", {"drone": "drone2"})[0]
    assert bench.ask("pause")[0]
    bench.while_waiting = [("restart", None)]
    assert not bench.controls.wait(1.0)
    assert bench.controls.disturbed == Disturbances(gust_m_s=0.5, removed=frozenset({1}))
    bench.controls.begin()
    assert bench.controls.disturbed == UNDISTURBED
    state = bench.controls.state()
    assert (state["flight"], state["paused"], state["time_s"], state["removed"]) == (2, False, 0.0, [])


def test_cameras_are_switched_off_and_on_and_drones_removed() -> None:
    bench = Bench()
    assert bench.ask("camera", {"drone": "drone1", "camera": "front", "works": False})[0]
    assert bench.ask("camera", {"drone": "drone3", "camera": "left", "works": False})[0]
    assert bench.controls.disturbed.cameras_off_of(0) == {"front"}
    assert bench.controls.state()["cameras_off"] == {"drone1": ["front"], "drone3": ["left"]}
    assert bench.ask("camera", {"drone": "drone1", "camera": "front", "works": True})[0]
    assert bench.controls.state()["cameras_off"] == {"drone3": ["left"]}
    assert bench.ask("remove", {"drone": "drone1"})[0]
    assert not bench.ask("camera", {"drone": "drone1", "camera": "front", "works": True})[0]


@pytest.mark.parametrize(
    ("control", "value", "told"),
    [
        ("explode", None, "the simulation's controls are pause, go_on"),
        ("speed", {"factor": 0}, "factor has to be a number from 0.05 to 20"),
        ("speed", {"factor": True}, "factor has to be a number"),
        ("gusts", {"gust_m_s": 3.5}, "gust_m_s has to be a number from 0 to 3"),
        ("gusts", None, "gust_m_s has to be a number from 0 to 3"),
        ("camera", {"drone": "drone1", "camera": "front"}, "camera needs `works`"),
        ("camera", {"drone": "drone1", "camera": "top", "works": True}, "drone1 has no camera 'top'; it has front"),
        ("remove", {"drone": "drone4"}, "there is no drone 'drone4'"),
        ("remove", {"drone": 4}, "drone has to be a name"),
    ],
)
def test_what_is_no_control_is_refused_in_one_sentence(control: str, value: object, told: str) -> None:
    accepted, sentence = Bench().ask(control, value)
    assert not accepted
    assert told in sentence


def test_a_control_for_another_simulator_or_a_second_time_is_refused() -> None:
    bench = Bench()
    assert "for another drone of this name" in bench.ask("pause", identity="other")[1]
    bench.numbers = itertools.count(1)
    assert "has come before" not in bench.ask("pause")[1]
    bench.numbers = itertools.count(1)
    assert "has come before" in bench.ask("go_on")[1]
    assert bench.controls.state()["paused"]
    assert not bench.controls.ask("pause", b"{}")["accepted"]


def test_gusts_begin_to_blow_and_a_removed_drone_is_out_of_everyones_sight() -> None:
    flown = scenario()
    calm, windy = (Vehicles(flown.vehicles, flown.vehicle, seed=1) for _ in range(2))
    windy.disturb(Disturbances(gust_m_s=1.0, removed=frozenset({1})))
    apart_m = ((windy.position - windy.position[1]) ** 2).sum(axis=1) ** 0.5
    assert (apart_m[[0, 2]] > 10_000.0).all()
    for vehicles in (calm, windy):
        vehicles.step(calm.velocity[:, :2], vehicles.velocity[:, 0] * 0.0, 2.0)
    assert (calm.velocity[:, 1] == 0.0).all()
    assert (abs(windy.velocity[[0, 2], 1]) > 0.0).all()
    windy.disturb(UNDISTURBED)
    windy.step(calm.velocity[:, :2], windy.velocity[:, 0] * 0.0, 20.0)
    assert abs(windy.velocity[0, 1]) < 1e-6, "the gusts have ceased"
