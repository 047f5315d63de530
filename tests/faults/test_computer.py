"""Faults of the computer and of the daemon itself, while a drone flies; most with the daemon in this process."""

from __future__ import annotations

import asyncio
import functools
import re
import resource
import signal
import time
from pathlib import Path

import pytest

from flockd.onboard.daemon import DaemonError
from tests.calm import SPEED_FACTOR, clock
from tests.faults.conftest import InTheAir, never_alone
from tests.faults.process import flying
from tests.faults.stories import Reacted
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL

pytestmark = pytest.mark.slow


@pytest.mark.fault("network-not-finite", within_s=2.0)
async def test_a_networks_output_is_not_finite(in_flight: InTheAir, reacted: Reacted) -> None:
    async with in_flight() as ship:
        await ship.until_state("normal")
        ship.perceiver.not_finite = 2
        fault_s = clock()
        await ship.until_event("degraded: a network's output is not finite or not plausible")
        reacted("network-not-finite", clock() - fault_s)
        assert ship.fake_autopilot.mode == "OFFBOARD"
        await ship.until_state("normal")
        assert ship.heard()["computer"].message["steps_failed"] == 0, "one camera's flow was left out"


@pytest.mark.fault("step-exception", within_s=5.0)
async def test_a_step_ends_in_an_error_that_nobody_expects(in_flight: InTheAir, reacted: Reacted) -> None:
    """One such step is lost, and the flight goes on; three in a row end in Hold."""
    async with in_flight() as ship:
        await ship.until_state("normal")
        ship.perceiver.unexpected = 1
        await ship.until_event("a step failed: KeyError: 'for the test'")
        await until(lambda: ship.heard()["computer"].message["steps_failed"] == 1, SECONDS_TO_FAIL)
        await ship.until_state("normal")
        assert ship.fake_autopilot.mode == "OFFBOARD"

        ship.perceiver.unexpected = 3
        fault_s = clock()
        await ship.until_mode()
        reacted("step-exception", clock() - fault_s)
        assert not ship.fake_autopilot.failsafe
        with pytest.raises(DaemonError, match=r"StepsFailedError.*3 steps in a row failed"):
            await ship.ending


@pytest.mark.fault("network-stuck", within_s=2.0)
async def test_a_network_never_returns(in_flight: InTheAir, reacted: Reacted) -> None:
    """Not even when it is told to: hover and Hold first, then the watchdog of the service manager is not fed."""
    async with in_flight() as ship:
        ship.perceiver.ends_when_told = False
        ship.perceiver.hangs.set()
        fault_s = clock()
        await ship.until_event("a step failed: a network call took longer than 0.5 s")
        # A network's deadlines pass in real time, which the flight's clock outruns.
        reacted("network-stuck", (clock() - fault_s) / SPEED_FACTOR)
        await ship.until_mode()
        assert not ship.fake_autopilot.failsafe
        components = ship.daemon.components
        assert components is not None
        await until(lambda: components.networks.hopeless, SECONDS_TO_FAIL)
        before = ship.service.count("WATCHDOG=1")
        await asyncio.sleep(1.5)
        assert ship.service.count("WATCHDOG=1") == before, "only a new process can help"


@pytest.mark.fault("overrun", within_s=8.0)
async def test_steps_take_longer_than_they_may(in_flight: InTheAir, reacted: Reacted) -> None:
    """Frames are not queued: each step takes the newest; the drone hovers and asks for Hold."""
    async with in_flight(functools.partial(never_alone, degraded_load=1.05, max_load=1.1)) as ship:
        ship.perceiver.slow_s = 0.15
        fault_s = clock()
        await ship.until_mode()
        reacted("overrun", clock() - fault_s)
        assert not ship.fake_autopilot.failsafe
        (hover,) = [event for event in ship.events if event.startswith("hover: ")]
        assert "a step takes " in hover
        counts = ship.heard()["computer"].message["cameras"]["front"]["counts"]
        assert counts["superseded"] > 0, "the newest frame wins"


@pytest.mark.fault("overrun", within_s=8.0)
async def test_it_gets_too_hot(in_flight: InTheAir, reacted: Reacted, monkeypatch: pytest.MonkeyPatch) -> None:
    temperature_c = [50.0]
    monkeypatch.setattr("flockd.onboard.daemon.supervisor_inputs.thermal_zones", lambda: [("cpu", temperature_c[0])])

    async with in_flight() as ship:
        temperature_c[0] = 88.0
        await ship.until_event("degraded: the computer is at 88.0 °C")
        assert ship.fake_autopilot.mode == "OFFBOARD"
        temperature_c[0] = 97.0
        fault_s = clock()
        await ship.until_mode()
        reacted("overrun", clock() - fault_s)
        assert not ship.fake_autopilot.failsafe


@pytest.mark.fault("clock-jump")
async def test_the_wall_clock_is_set(in_flight: InTheAir, monkeypatch: pytest.MonkeyPatch) -> None:
    wall, ahead_s = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: wall() + ahead_s[0])

    async with in_flight() as ship:
        await ship.until_state("normal")
        ahead_s[0] = -86_400.0
        await ship.steps_on()
        assert ship.fake_autopilot.mode == "OFFBOARD"
        assert ship.state() == "normal"


@pytest.mark.fault("out-of-memory", within_s=6.0)
async def test_the_memory_is_used_up_in_flight(tmp_path: Path, reacted: Reacted) -> None:
    """No more can be had, so nothing is commanded; then Linux kills the process, and a new one is idle."""
    async with flying(tmp_path) as process:
        fault_s = time.monotonic()
        resource.prlimit(process.program.process.pid, resource.RLIMIT_AS, (1, 1))
        await process.until_mode()
        reacted("out-of-memory", time.monotonic() - fault_s)
        process.signal(signal.SIGKILL)
        assert await process.ended() == -signal.SIGKILL
        sent = len(process.fake_autopilot.setpoints)
        process.fake_autopilot.pilot_selects("LOITER")
        process.daemons.start()
        await until(lambda: "ready: models loaded" in process.log() or process.program.ended is not None, 60.0)
        assert process.program.ended is None, process.log()
        await process.until_state("idle")
        assert len(process.fake_autopilot.setpoints) == sent


@pytest.mark.fault("computer-stalls", within_s=0.5)
@pytest.mark.fault("event-loop-stuck")
async def test_the_computer_stalls(tmp_path: Path, reacted: Reacted) -> None:
    """For 0.2 s, setpoints keep PX4's 2 Hz; for 3 s, the failsafe acts, and it stays silent and says what happened."""
    async with flying(tmp_path) as process:
        process.signal(signal.SIGSTOP)
        await asyncio.sleep(0.2)
        process.signal(signal.SIGCONT)
        sent = len(process.fake_autopilot.setpoints)
        await until(lambda: len(process.fake_autopilot.setpoints) > sent + 20, SECONDS_TO_FAIL)
        assert process.fake_autopilot.mode == "OFFBOARD"
        stopped_s = process.signal(signal.SIGSTOP)
        await asyncio.sleep(3.0)
        process.signal(signal.SIGCONT)
        reacted("computer-stalls", max(0.0, process.last_setpoint_s() - stopped_s))
        assert process.fake_autopilot.failsafe
        await process.until_event("silent: ")
        async with process.sends_nothing():
            pass
        assert any(re.match(r"silent: .*the event loop is [23]\.\d+ s late", event) for event in process.events)
