"""Faults in the flock and of the own command: neighbours and commands are set behind the tracker and the law."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FrameSet, Neighbour, PilotOutput, VehicleState
from flockd.flight.pilot import FlockPilot
from flockd.flight.tracking.tracker import Tracker
from flockd.sim.autopilot.fake_vehicle import Demand
from tests.calm import clock
from tests.faults.conftest import InTheAir, never_alone
from tests.faults.stories import Reacted
from tests.make import changed, neighbour
from tests.onboard.autopilot.conftest import HOVER_M
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL

pytestmark = pytest.mark.slow


@pytest.mark.fault("neighbour-too-near", within_s=1.5)
async def test_a_neighbour_comes_too_near(
    in_flight: InTheAir, reacted: Reacted, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the way that it wants to fly: whatever the law says, no velocity towards it is sent."""
    seen: list[Neighbour] = []
    monkeypatch.setattr(Tracker, "neighbours", lambda _: tuple(seen))

    async with in_flight() as ship:
        seen.append(neighbour([0.6, 0.0, 0.0]))
        fault_s = clock()
        await until(lambda: ship.fake_autopilot.setpoints[-1][1].velocity[0] <= 0.01, SECONDS_TO_FAIL)
        reacted("neighbour-too-near", clock() - fault_s)
        await ship.until_matters("neighbour_close")
        near_s = clock()
        await until(lambda: clock() > near_s + 1.0, SECONDS_TO_FAIL)
        sent = [setpoint.velocity[0] for at_s, setpoint in list(ship.fake_autopilot.setpoints) if at_s > near_s]
        assert sent
        assert max(sent) <= 0.01
        seen.clear()
        await until(lambda: ship.speed() > 0.5, SECONDS_TO_FAIL)
        assert ship.fake_autopilot.mode == "OFFBOARD"


@pytest.mark.fault("alone", within_s=6.0)
async def test_all_neighbours_are_lost(in_the_air: InTheAir, reacted: Reacted, monkeypatch: pytest.MonkeyPatch) -> None:
    """It flies on as desired, to the north, and not after the one that was last seen in the east; then Hold."""
    seen = [neighbour([0.0, 3.5, 0.0], [1.0, 0.0, 0.0])]
    monkeypatch.setattr(Tracker, "neighbours", lambda _: tuple(seen))
    change = partial(changed, safety__neighbours_timeout_s=1.0, safety__alone_s=3.0)
    async with in_the_air(change=change) as ship:
        await ship.until_state("idle")
        await until(lambda: ship.matters() == {"started", "not_offboard"}, SECONDS_TO_FAIL)
        assert (await ship.ask("ask/resume"))["accepted"] is True
        await ship.until_state("ready")
        await ship.flies()
        seen.clear()
        fault_s = clock()
        await ship.until_matters("neighbours_lost")
        assert ship.fake_autopilot.mode == "OFFBOARD"
        velocity = ship.fake_autopilot.setpoints[-1][1].velocity
        np.testing.assert_allclose(velocity, [1.0, 0.0], atol=0.2)
        await ship.until_mode()
        reacted("alone", clock() - fault_s)
        assert not ship.fake_autopilot.failsafe
        await ship.until_event("asking: no neighbour seen for ")


@pytest.mark.fault("command-not-finite", within_s=1.0)
@pytest.mark.parametrize("velocity", [(np.nan, 0.0), (np.inf, 0.0), (1e6, 0.0)], ids=["NaN", "infinite", "too large"])
async def test_a_command_that_cannot_be_flown(
    velocity: tuple[float, float],
    in_flight: InTheAir,
    reacted: Reacted,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wrong: list[bool] = []
    step = FlockPilot.step

    def spoiled(self: FlockPilot, frames: FrameSet, vehicle: VehicleState, *rest: Any) -> PilotOutput:
        output = step(self, frames, vehicle, *rest)
        if not wrong:
            return output
        return replace(output, command=replace(output.command, velocity=np.array(velocity)))

    monkeypatch.setattr(FlockPilot, "step", spoiled)

    async with in_flight() as ship:
        wrong.append(True)
        fault_s = clock()
        await until(
            lambda: float(np.linalg.norm(ship.fake_autopilot.setpoints[-1][1].velocity)) < 0.05, SECONDS_TO_FAIL
        )
        reacted("command-not-finite", clock() - fault_s)
        await ship.until_event("degraded: a command was not finite or far too large")
        assert ship.fake_autopilot.refused_setpoints == 0, "it never left"
        wrong.clear()
        await until(lambda: ship.speed() > 0.8, SECONDS_TO_FAIL)
        assert ship.fake_autopilot.mode == "OFFBOARD"


@pytest.mark.fault("fence-left", within_s=6.0)
async def test_the_fence_is_left(in_flight: InTheAir, reacted: Reacted) -> None:
    """It wants to go on to the north, stops before the fence 4 m from home, and is carried over it."""
    async with in_flight(partial(never_alone, gate__fence_radius_m=4.0)) as ship:
        autopilot = ship.fake_autopilot
        await until(lambda: float(autopilot.state.position[0]) > 2.5, SECONDS_TO_FAIL)
        obeys = autopilot._demand
        autopilot._demand = lambda: Demand(np.array([2.0, 0.0]), -HOVER_M, 0.0)  # type: ignore[method-assign]
        await until(lambda: float(autopilot.state.position[0]) > 4.6, SECONDS_TO_FAIL)
        autopilot._demand = obeys  # type: ignore[method-assign]
        fault_s = clock()
        await ship.until_mode()
        reacted("fence-left", clock() - fault_s)
        assert not autopilot.failsafe
        assert float(autopilot.state.position[0]) < 6.5
        late = [setpoint.velocity[0] for at_s, setpoint in list(autopilot.setpoints) if at_s > fault_s + 1.0]
        assert late
        assert max(late) < 0.05, "nothing outward"
        assert any("outside the fence" in event for event in ship.events)
