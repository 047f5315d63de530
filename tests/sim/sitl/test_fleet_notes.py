"""What the simulator notes of its fleet, with autopilots and daemons whose every state the test decides."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from flockd.sim.sitl import fleet as fleet_module
from flockd.sim.sitl.fleet import _Fleet
from flockd.sim.sitl.fleet_log import FleetRun
from flockd.sim.sitl.ground_station import _update, _Vehicle
from tests import make


@dataclass
class _Program:
    name: str
    ended: int | None = None

    def last_output(self) -> str:
        return f"last line of {self.name}"


@dataclass
class _World:
    """A fleet of two at 3 m above the ground, and its clock."""

    now_s: float = 0.0
    modes: list[str] = field(default_factory=lambda: ["OFFBOARD", "OFFBOARD"])
    armed: list[bool] = field(default_factory=lambda: [True, True])
    climb_m_s: float = 0.0
    up: float = 1.0
    """The share of their heights at which they are."""
    statuses: list[str] = field(default_factory=lambda: ["normal", "normal"])
    daemons: list[_Program] = field(default_factory=lambda: [_Program("drone1"), _Program("drone2")])
    px4s: list[_Program] = field(default_factory=lambda: [_Program("PX4 instance 0"), _Program("PX4 instance 1")])
    selected: list[tuple[int, str]] = field(default_factory=list)

    def select(self, i: int, mode: str) -> None:
        self.selected.append((i, mode))
        if mode == "LAND" and self.px4s[i].ended is None:
            self.armed[i] = False

    def fleet(self) -> _Fleet:
        scenario = make.scenario(drones=2)
        height_m = np.array([-vehicle.position_m[2] for vehicle in scenario.vehicles])
        station = SimpleNamespace(
            mode_is=lambda i, mode: self.modes[i] == mode,
            mode=lambda i: self.modes[i],
            is_armed=lambda i: self.armed[i],
            last_text=lambda i: "",
            select=self.select,
            arm=lambda i: self.armed.__setitem__(i, True),
            poses=lambda: SimpleNamespace(
                position=np.column_stack([np.zeros((2, 2)), -self.up * height_m]),
                velocity=np.full((2, 3), -self.climb_m_s),
            ),
        )
        daemons = SimpleNamespace(
            programs=lambda: self.daemons, status=lambda i: self.statuses[i], end=lambda: {"drone1": 0, "drone2": 0}
        )
        autopilots = SimpleNamespace(programs=lambda: self.px4s, name="PX4 SITL")
        server = SimpleNamespace(notes=tuple, frames=tuple)
        parts = cast("Any", (autopilots, station, server, daemons))
        return _Fleet(scenario, 1.0, lambda: self.now_s, *parts)


def test_the_reason_is_read_after_a_drone_has_left_offboard_and_not_before() -> None:
    world = _World()
    fleet, run = world.fleet(), FleetRun(0.0)
    fleet._note_handovers(run, 7.0)
    world.modes[0], world.now_s = "LOITER", 7.05
    fleet._note_handovers(run, 7.05)
    assert run.handed_over == {}, "the daemon's status line is still the one from before"
    world.statuses[0], world.now_s = "idle: too few cameras deliver images: front, back", 7.6
    fleet._note_handovers(run, 7.6)
    why = "after 7.0 s it left offboard (flockd: idle: too few cameras deliver images: front, back)"
    assert run.handed_over == {"drone1": why}
    world.statuses[0] = "ready"
    fleet._note_handovers(run, 20.0)
    assert run.handed_over == {"drone1": why}


def test_a_drone_that_leaves_at_the_very_end_is_noted_too() -> None:
    world = _World(now_s=19.9)
    fleet, run = world.fleet(), FleetRun(0.0)
    world.daemons[1].ended = 70
    fleet._note_handovers(run, 19.9)
    assert run.handed_over == {}
    fleet._note_handovers(run, np.inf)
    assert run.handed_over.keys() == {"drone2"}
    assert re.search(r"19\.9 s .* exit code 70 \(last line of drone2\)", run.handed_over["drone2"])


def test_each_change_of_a_flight_mode_is_noted_once() -> None:
    world = _World()
    fleet, run = world.fleet(), FleetRun(0.0)
    for mode in ("OFFBOARD", "LOITER", "LOITER", "OFFBOARD"):
        world.modes[1] = mode
        fleet._note_modes(run)
    assert run.modes == {"drone1": ["OFFBOARD"], "drone2": ["OFFBOARD", "LOITER", "OFFBOARD"]}


def test_drones_land_though_another_ones_autopilot_is_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "POLL_S", 0.0)
    world = _World(modes=["LOITER", "LOITER"])
    world.px4s[0].ended = -9
    run = FleetRun(0.0)
    world.fleet().land(run)
    assert world.armed == [True, False]
    assert (1, "LAND") in world.selected
    assert len(run.notes) == 1 and "PX4 instance 0" in run.notes[0]


def test_a_drone_that_still_climbs_is_not_at_its_height() -> None:
    """PX4 says Hold 0.4 m below the height, and climbs on."""
    world = _World(modes=["LOITER", "LOITER"], climb_m_s=0.4)
    fleet = world.fleet()
    assert not fleet._is_up(0)
    world.climb_m_s, world.now_s = 0.02, 0.5
    assert not fleet._is_up(0), "level for half a second"
    world.now_s = 1.5
    assert fleet._is_up(0)


def test_a_drone_is_armed_and_then_asked_to_climb_until_it_has_left_the_ground() -> None:
    world = _World(armed=[False, False], up=0.0)
    fleet = world.fleet()
    for armed, selected in ((False, []), (True, []), (True, [(0, "TAKEOFF")])):
        assert (world.armed[0], world.selected) == (armed, selected)
        fleet._request_climb(0)
    world.up, world.selected[:] = 0.5, []
    fleet._request_climb(0)
    assert world.selected == []


def test_a_long_text_of_the_autopilot_is_joined_from_its_chunks() -> None:
    text = "Preflight Fail: ekf2 missing data, and then what makes this longer than fifty characters"
    vehicle = _Vehicle(0, cast("Any", None))
    for number, begin in enumerate(range(0, len(text), 50)):
        chunk = text[begin : begin + 50].encode()
        _update(vehicle, mavlink.MAVLink_statustext_message(2, chunk, id=9, chunk_seq=number), 0.0)
    assert vehicle.texts == [text]
