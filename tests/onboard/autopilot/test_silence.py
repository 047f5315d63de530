"""Whatever stops in flockd, the setpoints stop within half a second, and the autopilot's own failsafe takes over."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from flockd.core.messages import Setpoint
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.calm import clock
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import Flight, flying, until

STOPS_WITHIN_S = 0.5
FAILSAFE_WITHIN_S = 2.5
"""COM_OF_LOSS_T is 1 s; the rest is the silence before it, and some."""
SECONDS_TO_FAIL = 60.0
SPEED_FACTOR = 0.25
"""For stories with a process of their own: a computer that is busy for a second has not stopped its setpoints."""


@contextmanager
def _child_in_offboard(port: int) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tests.onboard.autopilot.flight", str(port), str(SPEED_FACTOR)]
    root = Path(__file__).parents[3]
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "offboard\n"
        try:
            yield child
        finally:
            child.kill()


def _becomes_silent_and_fails_safe(
    fake_autopilot: FakeAutopilot, child: subprocess.Popen[str], how: signal.Signals
) -> None:
    assert fake_autopilot.mode == "OFFBOARD"
    _wait_for_a_setpoint(fake_autopilot)
    stopped_s = SPEED_FACTOR * time.monotonic()
    os.kill(child.pid, how)
    asyncio.run(until(lambda: fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL))
    assert fake_autopilot.failsafe
    assert fake_autopilot.setpoints[-1][0] - stopped_s < STOPS_WITHIN_S


def _wait_for_a_setpoint(fake_autopilot: FakeAutopilot) -> None:
    """So that the process is stopped between two of them: one that is just being sent cannot be taken back."""
    sent = len(fake_autopilot.setpoints)
    asyncio.run(until(lambda: len(fake_autopilot.setpoints) > sent, SECONDS_TO_FAIL))
    time.sleep(0.01)


@pytest.fixture
def slow_autopilot(port: int) -> Iterator[FakeAutopilot]:
    with FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, speed_factor=SPEED_FACTOR) as fake_autopilot:
        yield fake_autopilot


def test_a_killed_process_is_silence_and_failsafe(port: int, slow_autopilot: FakeAutopilot) -> None:
    with _child_in_offboard(port) as child:
        _becomes_silent_and_fails_safe(slow_autopilot, child, signal.SIGKILL)


def test_a_stopped_process_is_so_too_and_does_not_take_the_drone_back_when_it_goes_on(
    port: int, slow_autopilot: FakeAutopilot
) -> None:
    """PX4 and the stand-in return to offboard with the first setpoint that comes: so none may come."""
    with _child_in_offboard(port) as child:
        _becomes_silent_and_fails_safe(slow_autopilot, child, signal.SIGSTOP)
        before = len(slow_autopilot.setpoints)
        os.kill(child.pid, signal.SIGCONT)
        time.sleep(1.0)
        assert child.poll() is None
        assert len(slow_autopilot.setpoints) == before
        assert slow_autopilot.mode == "LOITER"


async def test_the_stand_in_itself_would_return_to_offboard(port: int, fake_autopilot: FakeAutopilot) -> None:
    """Or the story above would tell nothing."""
    async with flying(f"udpin://127.0.0.1:{port}") as flight:
        await flight.enter_offboard()
        flight.streamer.end("for the test")
        await until(lambda: fake_autopilot.failsafe)
        flight.link.send_setpoint(Setpoint(0.0, np.array([1.0, 0.0]), 2.5, 0.0))
        await until(lambda: fake_autopilot.mode == "OFFBOARD", 1.0)


def _busy(duration_s: float) -> None:
    """Keeps the interpreter busy, unlike a sleep."""
    until_s = time.monotonic() + duration_s
    while time.monotonic() < until_s:
        sum(range(1000))


@pytest.mark.parametrize("block", [time.sleep, _busy])
async def test_a_blocked_event_loop_is_silence_and_failsafe(
    port: int, fake_autopilot: FakeAutopilot, block: Callable[[float], None]
) -> None:
    async with flying(f"udpin://127.0.0.1:{port}") as flight:
        await flight.enter_offboard()
        blocked_s = clock()
        block(1.8)
        assert fake_autopilot.setpoints[-1][0] - blocked_s < STOPS_WITHIN_S
        assert fake_autopilot.mode == "LOITER"
        assert fake_autopilot.failsafe
        await asyncio.sleep(0.3)
        assert fake_autopilot.setpoints[-1][0] - blocked_s < STOPS_WITHIN_S
        assert not flight.streamer.report().streaming


async def test_a_dead_control_task_is_silence_and_failsafe(port: int, fake_autopilot: FakeAutopilot) -> None:
    fake_autopilot.parameters["COM_OBL_RC_ACT"] = 4
    async with flying(f"udpin://127.0.0.1:{port}") as flight:
        await flight.enter_offboard()
        died_s = clock()
        flight.control.cancel()
        await until(lambda: fake_autopilot.mode == "LAND", FAILSAFE_WITHIN_S)
        assert fake_autopilot.setpoints[-1][0] - died_s < STOPS_WITHIN_S
        assert flight.link.status().flight_mode in {"offboard", "land"}


async def test_when_the_pilot_switches_it_is_silent_at_once_and_stays_so(
    port: int, fake_autopilot: FakeAutopilot
) -> None:
    async with flying(f"udpin://127.0.0.1:{port}") as flight:
        await flight.enter_offboard()
        await asyncio.sleep(0.3)
        fake_autopilot.pilot_selects("POSCTL")
        seen_s = clock() + await until(lambda: flight.link.status().flight_mode == "position")
        await asyncio.sleep(0.6)
        assert fake_autopilot.setpoints[-1][0] - seen_s < 0.2
        assert flight.streamer.report().silence == "the autopilot left offboard for position"
        assert fake_autopilot.mode == "POSCTL"
        await _begins_anew(flight, fake_autopilot)


async def _begins_anew(flight: Flight, fake_autopilot: FakeAutopilot) -> None:
    before = len(fake_autopilot.setpoints)
    flight.streamer.begin()
    await until(lambda: len(fake_autopilot.setpoints) > before + 5)
    fake_autopilot.pilot_selects("OFFBOARD")
    await until(lambda: flight.streamer.report().offboard)


@pytest.mark.fault("link-lost")
async def test_a_lost_link_is_silence_though_the_autopilot_comes_back(port: int, fake_autopilot: FakeAutopilot) -> None:
    async with flying(f"udpin://127.0.0.1:{port}") as flight:
        await flight.enter_offboard()
        fake_autopilot.silent = True
        await until(lambda: not flight.streamer.report().streaming, 4.0)
        fake_autopilot.silent = False
        before = len(fake_autopilot.setpoints)
        await asyncio.sleep(2 * HEARTBEAT_S)
        assert len(fake_autopilot.setpoints) == before
        silence = flight.streamer.report().silence
        assert silence is not None
        assert re.fullmatch(r"no message from the autopilot for 2\.\d s", silence)
