"""A small flight as the daemon will make it: a link, a streamer, and a control task that offers setpoints and beats.

`python -m tests.onboard.autopilot.flight PORT SPEED_FACTOR` flies north at 1 m/s until it is killed, and says
`offboard` once it does.
"""

from __future__ import annotations

import asyncio
import functools
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import numpy as np

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.messages import Setpoint
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon import clock_at, event_loop_at
from tests import calm

CONTROL_S = 0.05


def north(speed_m_s: float = 1.0, height_m: float = 2.5, clock: Callable[[], float] = calm.clock) -> Setpoint:
    return Setpoint(clock(), np.array([speed_m_s, 0.0]), height_m, yaw_rad=0.0)


def let_pass(setpoint: Setpoint) -> Setpoint | None:
    return setpoint


async def until(condition: Callable[[], bool], timeout_s: float = 10.0) -> float:
    """Seconds of the event loop's clock until it holds; an assertion fails when it never does."""
    now = asyncio.get_running_loop().time
    begun = now()
    while not condition():
        assert now() - begun < timeout_s, "it never came"
        await asyncio.sleep(0.005)
    return now() - begun


@dataclass
class Flight:
    link: AutopilotLink
    streamer: SetpointStreamer
    control: asyncio.Task[None]

    async def enter_offboard(self) -> None:
        self.streamer.begin()
        await until(lambda: self.streamer.report().sent >= 3)
        await self.link.request_offboard()
        await until(lambda: self.streamer.report().offboard)


@asynccontextmanager
async def flying(
    port: int, setpoint: Callable[[], Setpoint] = north, clock: Callable[[], float] = calm.clock
) -> AsyncIterator[Flight]:
    parameters = AutopilotParameters(address=f"udpin://127.0.0.1:{port}")
    link = await AutopilotLink.connect(parameters, clock=clock)
    streamer = SetpointStreamer(link.send_setpoint, link.status, let_pass, parameters, clock=clock)
    streamer.start()

    async def control() -> None:
        while True:
            streamer.offer(setpoint())
            streamer.beat()
            await asyncio.sleep(CONTROL_S)

    task = asyncio.create_task(control())
    try:
        yield Flight(link, streamer, task)
    finally:
        task.cancel()
        streamer.close()
        await link.close()


async def main(port: int, speed_factor: float) -> None:
    clock = clock_at(speed_factor)
    async with flying(port, functools.partial(north, clock=clock), clock) as flight:
        await flight.enter_offboard()
        print("offboard", flush=True)  # noqa: T201
        await asyncio.sleep(3600)


if __name__ == "__main__":
    factor = float(sys.argv[2])
    with asyncio.Runner(loop_factory=functools.partial(event_loop_at, factor)) as runner:
        runner.run(main(int(sys.argv[1]), factor))
