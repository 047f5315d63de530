"""Everything that runs in a flight, for those who look after it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from flockd.autopilot.mavsdk_link import AutopilotLink
from flockd.autopilot.streamer import SetpointStreamer
from flockd.daemon.chronicle import Chronicle
from flockd.daemon.computer import LoopLag, Thermometer, WallClock
from flockd.daemon.control import Control
from flockd.daemon.networks import WatchedNetworks
from flockd.daemon.requests import Requests, TakeOff
from flockd.daemon.sight import Sight
from flockd.sources import FrameSource
from flockd.telemetry.publisher import ZenohTelemetry


@dataclass(frozen=True, eq=False)
class Crew:
    """The parts, made and started by the daemon."""

    link: AutopilotLink
    streamer: SetpointStreamer
    source: FrameSource
    sight: Sight
    networks: WatchedNetworks
    control: Control
    requests: Requests
    take_off: TakeOff
    chronicle: Chronicle
    telemetry: ZenohTelemetry
    lag: LoopLag
    thermometer: Thermometer
    wall_clock: WallClock
    dead_tasks: dict[str, str]
    """Why each task that has ended did, by name."""
    over: asyncio.Event = field(default_factory=asyncio.Event)
    """The flight is over: the tasks may end."""
