"""A whole drone for a fault's story: `flockd run` as a process of its own, a fake autopilot, cameras, a watcher."""

from __future__ import annotations

import functools
import os
import signal
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flockd.core.messages import UInt8Array
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.daemons import Daemons
from flockd.sim.sitl.processes import Program, free_endpoint, free_port
from tests.make import changed
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import CAMERAS, HEIGHT, WIDTH, Cameras, Watched, config_for, watched

SECONDS_TO_START = 60.0
"""To load three networks on a computer that is busy with other things."""


def view(camera: str, number: int) -> UInt8Array:
    """(HEIGHT, WIDTH, 3): the simulator's meadow from 2.5 m, standing still, with a camera's noise in each image."""
    noise = np.random.default_rng([7, number]).normal(0.0, 2.0, (HEIGHT, WIDTH, 3))
    return np.clip(_meadow()[camera] + noise, 0, 255).astype(np.uint8)


@functools.cache
def _meadow() -> dict[str, UInt8Array]:
    """By camera; rendered once with seed 0 (`CameraSimulator`), front left and back right."""
    image = cv2.imread(str(Path(__file__).with_name("view.png")), cv2.IMREAD_COLOR_RGB)
    assert image is not None
    return {name: np.asarray(image[:, i * WIDTH : (i + 1) * WIDTH], np.uint8) for i, name in enumerate(CAMERAS)}


@dataclass
class Process(Watched):
    """What a story can touch of a daemon that is a process of its own."""

    daemons: Daemons
    folder: Path

    @property
    def program(self) -> Program:
        return self.daemons.programs()[-1]

    def log(self) -> str:
        """All that it has printed."""
        return self.program.log.read_text(encoding="utf-8")

    def signal(self, number: signal.Signals) -> float:
        """Sends a signal; when, on the monotonic clock."""
        self.program.process.send_signal(number)
        return time.monotonic()

    async def ended(self, timeout_s: float = SECONDS_TO_START) -> int:
        """Its exit code, once it has ended."""
        await until(lambda: self.program.ended is not None, timeout_s)
        assert self.program.ended is not None
        return self.program.ended


@asynccontextmanager
async def flying(folder: Path) -> AsyncIterator[Process]:
    """A daemon with the shipped networks in offboard flight at cruise speed; its recordings go to ``folder``.

    Flying alone is no fault to it. The folder exists, and its path is short enough for a socket.
    """
    port, frames, telemetry = free_port(), free_endpoint(), free_endpoint()
    config = changed(config_for(port, frames, telemetry), safety__alone_s=None)
    cameras = Cameras(frames, view)
    try:
        with (
            FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S) as autopilot,
            Daemons([config], folder=folder, recordings=folder, environment=os.environ) as daemons,
            watched(telemetry) as (watcher, session, events),
        ):
            daemons.start()
            process = Process(config, autopilot, cameras, watcher, session, events, daemons, folder)
            await until(lambda: daemons.is_ready(0) or process.program.ended is not None, SECONDS_TO_START)
            assert process.program.ended is None, process.program.last_output()
            await process.is_ready_in_the_air()
            await process.flies()
            yield process
    finally:
        cameras.close()
