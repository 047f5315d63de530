"""A small flight as the daemon will make it: a link, a streamer, and a control task that offers setpoints and beats."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Self

import numpy as np
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.safety import SafetyParameters
from flockd.core.messages import Setpoint, Wanted
from flockd.flight.safety import Action, Permission, Request, Verdict
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests import calm
from tests.make import around
from tests.onboard.autopilot.pilots_link import PilotsLink

CONTROL_S = 0.05


NOWHERE = around(yaw_rad=0.0, height_m=2.5)
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
    link: PilotsLink
    streamer: SetpointStreamer

    async def enter_offboard(self) -> None:
        self.streamer.begin()
        await until(lambda: self.streamer.report().sent >= 3)
        await self.link.request_offboard()
        await until(lambda: self.streamer.report().offboard)


@asynccontextmanager
async def attended(
    address: str, clock: Callable[[], float] = calm.clock, system_id: int | None = 1
) -> AsyncIterator[PilotsLink]:
    """A link that keeps all coming, as the daemon's does."""
    link = await PilotsLink.connect(AutopilotParameters(address=address, system_id=system_id), clock=clock)
    attending = asyncio.create_task(link.attend())
    try:
        yield link
    finally:
        attending.cancel()
        await asyncio.wait({attending})
        await link.close()


class Foreigner:
    """Another program that sends the same setpoint 20 times a second to a fake autopilot, until it is left."""

    def __init__(self, autopilot: FakeAutopilot, *, north_m_s: float, east_m_s: float) -> None:
        self._autopilot, self._velocity = autopilot, (north_m_s, east_m_s)
        self.sent = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        north, east = self._velocity
        sender = mavlink.MAVLink(self, srcSystem=255, srcComponent=190)
        while not self._closing.wait(0.05 / calm.SPEED_FACTOR):
            sender.set_position_target_local_ned_send(0, 1, 1, 1, 2503, 0, 0, 0, north, east, 0, 0, 0, 0, 0, 0)
            self.sent += 1

    def write(self, data: bytes) -> None:
        """Takes what pymavlink has packed."""
        self._autopilot.send_from_elsewhere(data)


class Wire:
    """In a file's place, for pymavlink: sends to a port of this computer."""

    def __init__(self, port: int) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.sendto(data, ("127.0.0.1", self._port))


@asynccontextmanager
async def flying(address: str, wanted: Wanted = NORTH) -> AsyncIterator[Flight]:
    async with attended(address) as link:
        parameters = AutopilotParameters(), SafetyParameters()
        streamer = SetpointStreamer(link.send_setpoint, link.status, let_pass, *parameters, clock=calm.clock)
        streamer.start()

        async def control() -> None:
            while True:
                streamer.offer(request_of(wanted, calm.clock()))
                streamer.beat()
                await asyncio.sleep(CONTROL_S)

        task = asyncio.create_task(control())
        try:
            yield Flight(link, streamer)
        finally:
            task.cancel()
            streamer.close()
