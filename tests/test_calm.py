"""The clock of tests advances with real time, and not while the computer runs others."""

from __future__ import annotations

import asyncio
import time

import pytest

from tests.calm import MOST_S, CalmClock, clock, run


def test_a_pause_of_ten_seconds_is_one_step_and_all_else_is_real_time() -> None:
    real_s = [100.0]
    calm = CalmClock(lambda: real_s[0])
    times = [calm()]
    for passed_s in (0.02, 10.0, 0.02):
        real_s.append(real_s.pop() + passed_s)
        times.append(calm())
    assert times == pytest.approx([100.0, 100.02, 100.02 + MOST_S, 100.04 + MOST_S])


def test_sleeps_and_timeouts_are_by_that_clock() -> None:
    """A blocked event loop reads no clock, so that a second of real time is one step."""
    passed_s: list[float] = []

    async def story() -> None:
        begun_s = clock()
        time.sleep(1.0)
        passed_s.append(clock() - begun_s)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.2):
                await asyncio.sleep(3600.0)
        passed_s.append(clock() - begun_s)

    run(story)
    assert passed_s[0] == pytest.approx(MOST_S)
    assert passed_s[1] >= 0.2
