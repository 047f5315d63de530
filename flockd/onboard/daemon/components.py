"""The components of a running daemon."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from flockd.flight.safety import Gate
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon.autopilot_requests import AutopilotRequests
from flockd.onboard.daemon.control import Control
from flockd.onboard.daemon.host_monitors import LoopLag, Thermometer, WallClock
from flockd.onboard.daemon.message_sinks import MessageSinks
from flockd.onboard.daemon.obstacle_distances import ObstacleDistances
from flockd.onboard.daemon.operator_commands import OperatorCommands
from flockd.onboard.daemon.pilot_loop import PilotLoop
from flockd.onboard.daemon.refusal_watch import RefusalWatch
from flockd.onboard.daemon.state_texts import StateTexts
from flockd.onboard.daemon.watched_networks import WatchedNetworks
from flockd.onboard.sources import FrameSource
from flockd.onboard.telemetry.publisher import ZenohTelemetry


@dataclass(frozen=True, eq=False)
class Components:
    """Created and connected by `startup.open_components`."""

    link: AutopilotLink
    gate: Gate
    streamer: SetpointStreamer
    source: FrameSource
    pilot_loop: PilotLoop
    networks: WatchedNetworks
    control: Control
    requests: AutopilotRequests
    refusals: RefusalWatch
    distances: ObstacleDistances
    texts: StateTexts
    sinks: MessageSinks
    telemetry: ZenohTelemetry
    commands: OperatorCommands
    lag: LoopLag
    thermometer: Thermometer
    wall_clock: WallClock
    dead_tasks: dict[str, str]
    """Why each task that has ended did, by name."""
    over: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the flight is over and the tasks may end."""
