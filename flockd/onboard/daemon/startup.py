"""Opens everything a flight needs, in order, and registers how each part is closed."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flockd import __version__
from flockd.core.config import DroneConfig
from flockd.core.secrets import masked
from flockd.flight.geometry import build_rig
from flockd.flight.safety import Decision, Gate
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon.autopilot_tasks import AutopilotRequests, ObstacleDistances, RefusalWatch, StateTexts
from flockd.onboard.daemon.control import Control
from flockd.onboard.daemon.message_sinks import MessageSinks
from flockd.onboard.daemon.operator_orders import MissionOrders, OperatorCommands, OperatorRequests
from flockd.onboard.daemon.pilot_loop import PilotLoop, VehicleHistory
from flockd.onboard.daemon.supervisor_inputs import InputCollector, LoopLag, Thermometer
from flockd.onboard.daemon.watched_networks import InterruptibleNetworks, WatchedNetworks, cameras_at_once
from flockd.onboard.sources import FrameSource
from flockd.onboard.telemetry.preview import Previews
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage
from flockd.onboard.worker import BusyError, LateError, Worker

LOAD_S = 60.0
"""To load the networks from a slow card."""
OPEN_S = 10.0
CLOSE_S = 3.0


@dataclass(frozen=True, eq=False)
class Components:
    """Of a running daemon, created and connected by `open_components`."""

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
    dead_tasks: dict[str, str]
    """Why each task that has ended did, by name."""
    over: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the flight is over and the tasks may end."""


Connect = Callable[..., Coroutine[Any, Any, AutopilotLink]]
"""Connects to an autopilot, as `AutopilotLink.connect` does."""


async def open_components(
    stack: AsyncExitStack,
    config: DroneConfig,
    *,
    source: FrameSource,
    load_networks: Callable[[], InterruptibleNetworks],
    models: Mapping[str, str],
    recordings: Path | None,
    operator: OperatorRequests,
    on_tick: Callable[[Decision, Decision], None],
    clock: Callable[[], float],
    connect: Connect,
) -> Components:
    """Opens and connects all components; ``stack`` closes what was opened, in reverse order.

    See `Daemon` for the arguments. Raises FlockdError for what cannot be opened.
    """
    assert config.autopilot is not None
    loading = Worker("loading")
    # A process that ends while a thread is inside ONNX Runtime is aborted; nothing else runs by then.
    stack.callback(loading.leave, LOAD_S)
    closing = Worker("closing", backlog=8)
    stack.callback(closing.leave)
    telemetry = await closing.do(OPEN_S, _open_telemetry, config)
    stack.push_async_callback(_close, closing, telemetry.close)
    sinks = MessageSinks(config, telemetry, models, recordings, clock)
    stack.push_async_callback(_close_async, sinks.close)
    await closing.do(OPEN_S, source.start)
    stack.push_async_callback(_close, closing, source.stop)
    networks, link = await _both(_networks(config, loading, load_networks), connect(config.autopilot, clock=clock))
    stack.push_async_callback(_close_async, link.close)
    gate = Gate(config.safety.gate)
    streamer = SetpointStreamer(
        link.send_setpoint, link.status, gate.step, config.autopilot, config.safety, clock=clock
    )
    streamer.start()
    stack.callback(streamer.close)
    history, lag, thermometer = VehicleHistory(), LoopLag(clock), Thermometer()
    pilot_loop = PilotLoop(config, source, networks, history.at, sinks.step, sinks.event, clock)
    stack.push_async_callback(_close, closing, pilot_loop.leave)
    dead_tasks: dict[str, str] = {}
    collector = InputCollector(config, source, pilot_loop, networks, gate, lag, thermometer, dead_tasks, clock)
    requests = AutopilotRequests(link, sinks.event)
    control = Control(
        config, link, streamer, pilot_loop, collector, requests, history, operator, on_tick, clock
    )  # fmt: skip
    missions = MissionOrders(config, pilot_loop, link.vehicle_state, lambda: control.decision.state)
    loop = asyncio.get_running_loop()
    commands = OperatorCommands(
        config.telemetry.commands, operator, missions, loop, sinks.event, identity=telemetry.identity
    )
    previews = Previews(build_rig(config.rig), lambda: (pilot_loop.frames, pilot_loop.stepped))
    telemetry.announce(config.name, _about(config), commands.handle, previews.picture)
    return Components(
        link=link, gate=gate, streamer=streamer, source=source, pilot_loop=pilot_loop, networks=networks,
        control=control,
        requests=requests, refusals=RefusalWatch(link, sinks.event, clock), sinks=sinks,
        distances=ObstacleDistances(config, link, pilot_loop, history, clock),
        texts=StateTexts(link.send_text, clock), telemetry=telemetry, commands=commands, lag=lag,
        thermometer=thermometer, dead_tasks=dead_tasks,
    )  # fmt: skip


async def _networks(config: DroneConfig, loading: Worker, load: Callable[[], InterruptibleNetworks]) -> WatchedNetworks:
    networks = await loading.do(LOAD_S, load)
    loading.leave()
    return WatchedNetworks(networks, config.perception.deadline_s / config.speed_factor, cameras_at_once(config))


def _open_telemetry(config: DroneConfig) -> ZenohTelemetry:
    parameters = config.telemetry
    settings = None if parameters.zenoh_config is None else Path(parameters.zenoh_config)
    return ZenohTelemetry(parameters.fleet, listen=parameters.listen, connect=parameters.connect, settings=settings)


def _about(config: DroneConfig) -> AboutMessage:
    return AboutMessage(
        version=__version__,
        configuration=masked(config.model_dump(mode="json")),
        commands=list(config.telemetry.commands),
    )


async def _both(
    networks: Coroutine[Any, Any, WatchedNetworks], link: Coroutine[Any, Any, AutopilotLink]
) -> tuple[WatchedNetworks, AutopilotLink]:
    """Runs both concurrently; when one fails the other is cancelled."""
    tasks = asyncio.create_task(networks), asyncio.create_task(link)
    try:
        return await asyncio.gather(*tasks)
    except BaseException:
        for task in tasks:
            task.cancel()
        raise


async def _close(worker: Worker, close: Callable[[], None]) -> None:
    """Closes on a worker, within a deadline: what hangs ends with the process."""
    try:
        await worker.do(CLOSE_S, close)
    except (LateError, BusyError):
        return


async def _close_async(close: Callable[[], Awaitable[None]]) -> None:
    """The same for a coroutine."""
    try:
        async with asyncio.timeout(2 * CLOSE_S):
            await close()
    except (TimeoutError, LateError, BusyError):
        return
