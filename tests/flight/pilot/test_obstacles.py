"""A pilot among obstacles: what it sees goes into its map, its command and its recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from flockd.core.config import DroneConfig
from flockd.core.messages import SECTORS, FrameSet, ObstacleRanges, PilotOutput, VehicleState
from flockd.flight.obstacles import ObstacleRanging
from flockd.flight.perception import Observation
from flockd.flight.pilot import FlockPilot
from flockd.sim.world.obstacles import Box, Obstacles, true_ranges
from tests.make import changed, frames, scenario, vehicle

WALL = Obstacles([Box(3.0, 0.0, 0.2, 30.0, 0.0, -0.5, 8.0)])
"""Its surface is 2.8 m north."""


class Observer:
    """Has no images."""

    last = None

    def observe(self, frames: FrameSet, vehicle: VehicleState, *_: object) -> Observation:
        return Observation(frames.time_s, vehicle, {}, (), None)


def drone(*, enabled: bool) -> DroneConfig:
    return changed(
        scenario(name="square").drone, mission__kind="velocity", mission__velocity_m_s=(1.5, 0.0),
        mission__waypoints=(), obstacles__enabled=enabled, own_velocity="autopilot",
    )  # fmt: skip


def flown(config: DroneConfig, sees: Sequence[bool]) -> list[PilotOutput]:
    """A drone that is held at its place, each 0.5 s; `sees`: in which steps it sees the wall, and else nothing."""
    ranging = ObstacleRanging.ranges

    def ranges(self: ObstacleRanging, seen: Observation, *rest: Any) -> ObstacleRanges:
        there = true_ranges(WALL, seen.time_s, np.array([0.0, 0.0, -4.0]))
        return there if sees[round(seen.time_s / 0.5)] else ranging(self, seen, *rest)

    networks: Any = object()  # never asked for anything
    observer: Any = Observer()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ObstacleRanging, "ranges", ranges)
        pilot = FlockPilot(config, networks, observer=observer)
        return [pilot.step(frames(0.5 * step), vehicle(0.5 * step, 4.0)) for step in range(len(sees))]


def test_switched_off_the_wall_is_flown_at_and_nothing_is_kept() -> None:
    output = flown(drone(enabled=False), [True])[-1]
    assert output.obstacles is None
    assert output.command.velocity[0] > 0.5


def test_switched_on_it_flies_along_the_wall() -> None:
    output = flown(drone(enabled=True), [True, True])[-1]
    assert output.obstacles is not None
    assert output.obstacles.range_m[0] == pytest.approx(2.8)
    assert np.isinf(output.obstacles.range_m[SECTORS // 2])
    north, east = output.command.velocity
    assert abs(east) > 0.3
    assert north < 0.5


def test_where_it_sees_nothing_more_the_wall_stays_for_a_while_and_then_it_stands_still() -> None:
    outputs = flown(drone(enabled=True), [True] + [False] * 8)
    kept = [bool(np.isfinite(output.obstacles.range_m[0])) for output in outputs if output.obstacles is not None]
    assert kept == [True] * 7 + [False] * 2  # 3 s
    np.testing.assert_allclose(outputs[-1].command.velocity, 0.0, atol=1e-9)
