"""A simulated drone's daemon lives in simulated time, and steps with each frame of a camera as slow as its steps."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pytest

from flockd.core.messages import Frame, FrameSet, VehicleState
from flockd.onboard.daemon.pilot_loop import PilotLoop
from flockd.onboard.daemon.watched_networks import WatchedNetworks
from flockd.onboard.simulated_time import clock_at, event_loop_at
from flockd.onboard.sources import CameraStatus
from tests.calm import clock, run
from tests.onboard.daemon.aboard import STEP_S, TinyPerceiver, config_for


def test_sleeps_and_timeouts_count_in_simulated_seconds() -> None:
    """At four times the speed, two seconds' sleep takes half a real one, and a second's patience a quarter."""

    async def story() -> tuple[float, float]:
        begun = loop.time()
        await asyncio.sleep(2.0)
        slept = loop.time() - begun
        begun = loop.time()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0):
                await asyncio.Event().wait()
        return slept, loop.time() - begun

    loop, four_times = event_loop_at(4.0), clock_at(4.0)
    try:
        real_s, simulated_s = [time.monotonic()], [four_times()]
        real_s.append(time.monotonic())
        slept, waited = loop.run_until_complete(story())
        real_s.append(time.monotonic())
        simulated_s.append(four_times())
        real_s.append(time.monotonic())
    finally:
        loop.close()
    passed_s = simulated_s[1] - simulated_s[0]
    assert 4.0 * (real_s[2] - real_s[1]) <= passed_s <= 4.0 * (real_s[3] - real_s[0])
    assert slept >= 2.0
    assert waited >= 1.0
    assert slept + waited <= passed_s


def test_the_clock_of_a_real_drone_is_the_computers() -> None:
    assert clock_at(1.0) is time.monotonic


class SlowCamera:
    """Has a frame set each step, on time, whoever looks; the newest that was not handed out."""

    def __init__(self) -> None:
        self._begun_s = clock()
        self._handed_out = 0
        self.waited_s: list[float] = []
        """How long each set that was taken had been there."""

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
        until_s = clock() + timeout_s
        while (number := int((clock() - self._begun_s) / STEP_S)) <= self._handed_out:
            if clock() > until_s:
                return None
            time.sleep(0.005)
        self._handed_out = number
        taken_s = self._begun_s + number * STEP_S
        self.waited_s.append(clock() - taken_s)
        image = np.random.default_rng(number).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        return FrameSet(taken_s, {name: Frame(name, image, taken_s, number) for name in ("front", "back")})

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def status(self) -> Mapping[str, CameraStatus]:
        return {}


def test_a_late_step_does_not_make_all_later_ones_late() -> None:
    """Frames come as often as steps are due: whoever missed his moment once must not look at old frames for ever."""
    config = config_for(1, "tcp/127.0.0.1:1", "tcp/127.0.0.1:2")
    assert config.source is not None
    slow = config.source.shared_memory.model_copy(update={"rate_hz": 1.0 / STEP_S})
    config = config.model_copy(update={"source": config.source.model_copy(update={"shared_memory": slow})})
    camera, times = SlowCamera(), []
    hiccup = [1.5 * STEP_S]

    def on_step(frames: FrameSet, *_: object) -> None:
        times.append(frames.time_s)
        if len(times) == 2:
            time.sleep(hiccup.pop())

    level = VehicleState(0.0, np.eye(3), 2.0, np.zeros(3))
    networks = WatchedNetworks(TinyPerceiver(), 1.0)
    pilot_loop = PilotLoop(config, camera, networks, lambda _: level, on_step, lambda _: None, clock)

    async def story() -> None:
        running = asyncio.create_task(pilot_loop.run())
        while len(times) < 9:
            await asyncio.sleep(0.01)
        running.cancel()

    run(story)
    pilot_loop.leave()
    assert np.median(camera.waited_s[4:9]) < 0.3 * STEP_S
    spans = [round((b - a) / STEP_S) for a, b in pairwise(times[3:])]
    assert np.median(spans) == 1
