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
from flockd.core.messages import Setpoint, Wanted
from flockd.flight.safety import Action, Permission, Request, Surroundings, Verdict
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon import clock_at, event_loop_at
from tests import calm

CONTROL_S = 0.05


NOWHERE = Surroundings(np.zeros(2), np.zeros(2), 0.0, np.empty((0, 3)), np.empty((0, 2)), 2.5)
NORTH = Wanted(np.array([1.0, 0.0]), np.zeros(2), 0.0, height_m=2.5)


def request_of(wanted: Wanted, now_s: float) -> Request:
    return Request(Permission(Action.FLY, now_s), wanted, now_s, 0.0, NOWHERE)


def let_pass(now_s: float, request: Request) -> Verdict:
    """A gate that allows all."""
    wanted = request.wanted
    return Verdict(Setpoint(now_s, wanted.velocity, wanted.height_m or 0.0, wanted.yaw_rad or 0.0), ())


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
async def flying(port: int, wanted: Wanted = NORTH, clock: Callable[[], float] = calm.clock) -> AsyncIterator[Flight]:
    parameters = AutopilotParameters(address=f"udpin://127.0.0.1:{port}")
    link = await AutopilotLink.connect(parameters, clock=clock)
    streamer = SetpointStreamer(link.send_setpoint, link.status, let_pass, parameters, clock=clock)
    streamer.start()

    async def control() -> None:
        while True:
            streamer.offer(request_of(wanted, clock()))
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
    async with flying(port, clock=clock) as flight:
        await flight.enter_offboard()
        print("offboard", flush=True)  # noqa: T201
        await asyncio.sleep(3600)


if __name__ == "__main__":
    factor = float(sys.argv[2])
    with asyncio.Runner(loop_factory=functools.partial(event_loop_at, factor)) as runner:
        runner.run(main(int(sys.argv[1]), factor))
