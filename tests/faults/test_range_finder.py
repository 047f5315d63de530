"""A range finder that lies, while a whole drone flies: stuck, something in its beam, a jump."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from flockd.core.choices import HeightSource
from flockd.core.messages import FloatArray, RangeReading
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder, level_ground
from flockd.sim.autopilot.fake_vehicle import Demand
from flockd.sim.scenario import RangeFinderConfig
from tests.calm import clock
from tests.faults.stories import Reacted
from tests.make import changed
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL, Aboard, aboard

pytestmark = pytest.mark.slow
STUCK = "height: the range stays the same while the height changes"
LIE, WORKS = "height: the range contradicts the barometer", "height: the range finder works again"
NOTICED_M = 1.3
"""A contradiction of a metre and 8 % of the range is noticed."""


class _Lying(FakeRangeFinder):
    """Says what a story wants, with a full signal; the truth while that is None."""

    lie: Callable[[float], float] | None = None

    def __init__(self) -> None:
        super().__init__(RangeFinderConfig(dropouts_per_min=0.0), level_ground, (0,))

    def read(
        self, time_s: float, position: FloatArray, velocity: FloatArray, R_ned_body: FloatArray
    ) -> RangeReading | None:
        reading, lie = super().read(time_s, position, velocity, R_ned_body), self.lie
        return reading if reading is None or lie is None else replace(reading, range_m=lie(reading.range_m), quality=1)


@asynccontextmanager
async def _above_level_ground(sensor: _Lying, source: HeightSource, port: int, folder: Path) -> AsyncIterator[Aboard]:
    with FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, clock=clock, range_finder=sensor) as autopilot:
        change = partial(changed, safety__alone_s=None, perception__height=source)
        async with aboard(autopilot, port, folder, change=change) as ship:
            yield ship


def _climbing(autopilot: FakeAutopilot) -> Demand:
    """As it was commanded last, and higher."""
    return Demand(np.array(autopilot.setpoints[-1][1].velocity[:2]), -HOVER_M - 4.0, 0.0)


async def _flies_by_range(ship: Aboard) -> None:
    """In offboard, at whatever speed; steps were made with a range, and nothing is wrong with the newest."""
    await ship.is_ready_in_the_air()
    await until(lambda: len(ship.fake_autopilot.setpoints) > 5, SECONDS_TO_FAIL)
    ship.fake_autopilot.pilot_selects("OFFBOARD")
    await ship.until_state("normal", "degraded")
    await ship.steps_on()
    heights = [event for event in ship.events if event.startswith("height: ")]
    assert not heights or heights[-1] == WORKS, heights


@pytest.mark.fault("range-finder-lies", within_s=3.0)
@pytest.mark.parametrize(
    ("lie", "climbs", "why"),
    [
        (lambda range_m: HOVER_M, True, STUCK),
        (lambda range_m: 0.3, False, LIE),
        (lambda range_m: range_m + 3.0, False, LIE),
    ],
    ids=["stuck in a climb", "landing gear in the beam", "a jump"],
)
async def test_the_range_finder_lies(
    lie: Callable[[float], float], climbs: bool, why: str, port: int, tmp_path: Path, reacted: Reacted
) -> None:
    sensor = _Lying()
    async with _above_level_ground(sensor, "best", port, tmp_path) as ship:
        await _flies_by_range(ship)
        autopilot, told = ship.fake_autopilot, len(ship.events)
        sensor.lie = lie
        if climbs:
            autopilot._demand = lambda: _climbing(autopilot)  # type: ignore[method-assign]
            await until(lambda: -autopilot.state.position[2] > HOVER_M + NOTICED_M, SECONDS_TO_FAIL)
        fault_s = clock()
        await ship.until_event(f"{why}; the barometer's is used")
        reacted("range-finder-lies", clock() - fault_s)
        assert WORKS not in ship.events[told:]
        await ship.steps_on()
        assert autopilot.mode == "OFFBOARD", "it flies on by the barometer"
        assert ship.state() in {"normal", "degraded"}
        sensor.lie = None
        await until(lambda: WORKS in ship.events[told:], SECONDS_TO_FAIL)
        limit_m_s = ship.config.safety.gate.max_speed_m_s
        assert all(np.linalg.norm(sent.velocity[:2]) <= limit_m_s + 1e-6 for _, sent in list(autopilot.setpoints))


@pytest.mark.fault("range-finder-lies", within_s=3.0)
async def test_without_the_barometer_a_lie_is_no_scale_and_ends_in_hold(
    port: int, tmp_path: Path, reacted: Reacted
) -> None:
    sensor = _Lying()
    async with _above_level_ground(sensor, "range_finder", port, tmp_path) as ship:
        await _flies_by_range(ship)
        sensor.lie = lambda range_m: 0.3
        fault_s = clock()
        await ship.until_event(f"{LIE}; there is no scale")
        reacted("range-finder-lies", clock() - fault_s)
        await ship.until_mode()
        await ship.until_event("silent: ")
        async with ship.sends_nothing():
            sensor.lie = None
