"""The daemon's life cycle: start, one task for each concern, hand-over to the autopilot, end."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

from flockd import __version__
from flockd.core.config import DroneConfig
from flockd.core.errors import ConfigError, FlockdError
from flockd.core.secrets import masked
from flockd.flight.geometry import build_rig
from flockd.flight.mission import order_fault
from flockd.flight.perception import OneByOne
from flockd.flight.safety import FLYING, Decision, Event, Gate, State
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.autopilot.watches import MOST_SPEED
from flockd.onboard.daemon.autopilot_tasks import (
    AutopilotRequests,
    RefusalWatch,
    StateTexts,
    state_sentence,
)
from flockd.onboard.daemon.control import Control
from flockd.onboard.daemon.message_sinks import MessageSinks
from flockd.onboard.daemon.operator_orders import OperatorCommands, OperatorRequests
from flockd.onboard.daemon.pilot_loop import PilotLoop, VehicleHistory
from flockd.onboard.daemon.status import Components, ServiceManager, notify_service_manager, publish_status
from flockd.onboard.daemon.supervisor_inputs import InputCollector, LoopLag, Thermometer
from flockd.onboard.daemon.watched_networks import WatchedNetworks, cameras_at_once
from flockd.onboard.sources import open_source
from flockd.onboard.telemetry.preview import Previews
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage
from flockd.onboard.worker import BusyError, LateError, Worker

LOAD_S = 60.0
"""Time-out for loading the networks, from a slow card too."""
OPEN_S = 10.0
CLOSE_S = 3.0
HOLD_S = 1.5
"""Time for the autopilot to confirm Hold after the control loop has failed, which fed the service's watchdog: systemd
kills the process 2 s later."""


class DaemonError(FlockdError):
    """The flight ended because of a fault in flockd; the text says which."""


class Daemon:
    """One drone's flight program, from start to end. Call `run` once."""

    def __init__(
        self,
        config: DroneConfig,
        file: str,
        *,
        load_networks: Callable[[], OneByOne],
        models: Mapping[str, str],
        recordings: Path | None,
        service: ServiceManager,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Checks the configuration; nothing is opened before `run`.

        Args:
            config: the drone's configuration.
            file: its path, named in errors.
            load_networks: runs on a thread of its own.
            models: SHA-256 of each model, by name, for the recordings.
            recordings: the folder for recordings of flights; None: nothing is recorded.
            service: the service manager, if any.
            clock: monotonic seconds.

        Raises ConfigError for a configuration that cannot be flown.
        """
        if config.autopilot is None:
            raise ConfigError.at(file, "is missing; add it with the `address` of the autopilot", "autopilot")
        self._source = open_source(config, file, clock=clock)
        self._config = config
        self._load_networks, self._models, self._recordings = load_networks, models, recordings
        self._service, self._clock = service, clock
        self._operator = OperatorRequests()
        self._stopping = asyncio.Event()
        self._unusable: AutopilotError | None = None
        """Why the link is not used any more."""
        self.components: Components | None = None
        """All parts of the flight, once they are open."""

    def waits_for(self) -> str | None:
        """What is missing before it can fly, for people; None: nothing."""
        assert self._config.autopilot is not None
        if self.components is None:
            return f"the autopilot at {self._config.autopilot.address}, and for the networks to load"
        why = self.components.lacks_frames()
        return None if why is None else f"camera frames: {why}"

    def ask_to_stop(self) -> None:
        """Stops like SIGTERM: standstill, Hold, and the end."""
        self._operator.shutdown = True
        self._stopping.set()

    async def run(self) -> None:
        """Flies until it is asked to stop.

        Raises FlockdError if it cannot start, DaemonError if a task died or Hold was not confirmed, AutopilotError if
        the link became unusable on the ground.
        """
        async with AsyncExitStack() as stack:
            components = await self._unless_stopped(self._open(stack))
            if components is not None:
                self.components = components
                await self._fly(components)

    async def _open(self, stack: AsyncExitStack) -> Components:
        """Opens and connects all components; ``stack`` closes them in reverse order. Raises FlockdError on failure."""
        config, clock = self._config, self._clock
        assert config.autopilot is not None
        loading = Worker("loading")
        # A process that ends while a thread is inside ONNX Runtime aborts, so this comes last.
        stack.callback(loading.leave, LOAD_S)
        closing = Worker("closing", backlog=8)
        stack.callback(closing.leave)
        telemetry = await closing.do(OPEN_S, self._open_telemetry)
        stack.push_async_callback(_close, closing, telemetry.close)
        sinks = MessageSinks(config, telemetry, self._models, self._recordings, clock)
        stack.push_async_callback(_close_async, sinks.close)
        await closing.do(OPEN_S, self._source.start)
        stack.push_async_callback(_close, closing, self._source.stop)
        networks, link = await _both(self._networks(loading), self._link(stack))
        gate = Gate(config.safety.gate)
        streamer = SetpointStreamer(
            link.send_setpoint, link.status, gate.step, config.autopilot, config.safety, clock=clock
        )
        streamer.start()
        stack.callback(streamer.close)
        history, lag, thermometer = VehicleHistory(), LoopLag(clock), Thermometer()
        pilot_loop = PilotLoop(config, self._source, networks, history.at, sinks.step, sinks.event, clock)
        stack.push_async_callback(_close, closing, pilot_loop.leave)
        dead_tasks: dict[str, str] = {}
        collector = InputCollector(
            config, self._source, pilot_loop, networks, gate, lag, thermometer, dead_tasks, clock
        )
        requests = AutopilotRequests(link, sinks.event)
        control = Control(
            config, link, streamer, pilot_loop, collector, requests, history, self._operator, self._on_tick, clock
        )  # fmt: skip
        loop = asyncio.get_running_loop()
        commands = OperatorCommands(
            config.telemetry.commands, self._operator, loop, sinks.event,
            order_fault=lambda order: order_fault(config, order, link.vehicle_state()), fly=pilot_loop.take_order,
            state=lambda: control.decision.state, identity=telemetry.identity,
        )  # fmt: skip
        previews = Previews(build_rig(config.rig), lambda: (pilot_loop.frames, pilot_loop.stepped))
        about = AboutMessage(
            version=__version__,
            configuration=masked(config.model_dump(mode="json")),
            commands=list(config.telemetry.commands),
        )
        telemetry.announce(config.name, about, commands.handle, previews.picture)
        return Components(
            link=link, gate=gate, streamer=streamer, source=self._source, pilot_loop=pilot_loop, networks=networks,
            control=control, requests=requests, refusals=RefusalWatch(link, sinks.event, clock), sinks=sinks,
            texts=StateTexts(link.send_text, clock), telemetry=telemetry, commands=commands, lag=lag,
            thermometer=thermometer, dead_tasks=dead_tasks,
        )  # fmt: skip

    async def _networks(self, loading: Worker) -> WatchedNetworks:
        networks = await loading.do(LOAD_S, self._load_networks)
        loading.leave()
        deadline_s = self._config.perception.deadline_s / self._config.speed_factor
        return WatchedNetworks(networks, deadline_s, cameras_at_once(self._config))

    async def _link(self, stack: AsyncExitStack) -> AutopilotLink:
        """Opens the link; the stack closes it even if loading the networks fails meanwhile."""
        assert self._config.autopilot is not None
        link = await AutopilotLink.connect(self._config.autopilot, clock=self._clock)
        stack.push_async_callback(_close_async, link.close)
        return link

    def _open_telemetry(self) -> ZenohTelemetry:
        parameters = self._config.telemetry
        settings = None if parameters.zenoh_config is None else Path(parameters.zenoh_config)
        return ZenohTelemetry(
            parameters.fleet,
            listen=parameters.listen,
            connect=parameters.connect,
            settings=settings,
            awaits_addresses=True,
        )

    async def _unless_stopped(self, start: Coroutine[Any, Any, Components]) -> Components | None:
        """Starts; None if asked to stop before the start is complete."""
        starting = asyncio.create_task(start)
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            await asyncio.wait({starting, stopping}, return_when=asyncio.FIRST_COMPLETED)
            return starting.result() if starting.done() else None
        finally:
            stopping.cancel()
            starting.cancel()
            await asyncio.wait({starting})

    async def _fly(self, components: Components) -> None:
        """Runs one task for each concern until the flight is over."""
        assert self._config.autopilot is not None
        concerns = {
            "control": components.control.run,
            "requests": components.requests.run,
            "refusals": components.refusals.run,
            "autopilot clock": components.link.synchronise,
            "autopilot link": components.link.attend,
            "pilot": components.pilot_loop.run,
            "loop lag": components.lag.run,
            "thermometer": components.thermometer.run,
            "telemetry": lambda: publish_status(components, self._clock),
            "service": lambda: notify_service_manager(components, self._service),
        }
        async with asyncio.TaskGroup() as group:
            tasks = [
                group.create_task(self._supervised(name, run, components), name=name) for name, run in concerns.items()
            ]
            await components.over.wait()
            self._service.stopping()
            for task in tasks:
                task.cancel()
        _raise_failure(components)
        if self._unusable is not None:
            raise self._unusable

    async def _supervised(self, name: str, run: Callable[[], Awaitable[None]], components: Components) -> None:
        """A task that ends becomes an event for the supervisor, which ends the flight; the other tasks go on."""
        try:
            await run()
            components.dead_tasks[name] = "it returned"
        except Exception as error:  # noqa: BLE001 - after any error the drone has to be handed over
            components.dead_tasks[name] = repr(error)
        components.sinks.event(f"the task {name} died: {components.dead_tasks[name]}")
        if name in {"control", "requests"}:
            await self._hold_without_control(components)

    async def _hold_without_control(self, components: Components) -> None:
        """The tasks that request Hold are dead: requests it here, while the streamer sends standstill."""
        components.control.stand_still()
        if components.link.status().flight_mode == "offboard":
            try:
                async with asyncio.timeout(HOLD_S):
                    await components.link.hold()
            except (AutopilotError, TimeoutError) as error:
                components.sinks.event(f"the autopilot did not confirm Hold ({error}); setpoints end, so it fails safe")
        components.streamer.end("a task died")
        components.over.set()

    def _on_tick(self, before: Decision, now: Decision) -> None:
        """Called by the control loop: feeds the watchdog, reports changes of state, begins and ends recordings."""
        components = self.components
        assert components is not None
        if not components.networks.hopeless:
            self._service.alive()
        for report in components.link.take_reports():
            components.sinks.event(report)
        if now.state is not before.state:
            components.sinks.event(state_sentence(now))
        components.texts.update(now)
        if now.state in FLYING and before.state not in FLYING:
            fastest_m_s = components.link.status().fastest_m_s
            if fastest_m_s < self._config.safety.gate.max_speed_m_s:
                components.sinks.event(
                    f"the autopilot's {MOST_SPEED} is {fastest_m_s:g} m/s: flockd asks for no more in this flight"
                )
            components.sinks.begin_recording(components.pilot_loop.learned_before)
        elif components.sinks.recording is not None and not components.link.status().armed:
            components.sinks.end_recording()
        if now.state not in FLYING and not components.link.status().armed:
            self._unusable = self._unusable or components.link.unusable()
        handed_over = now.state in {State.IDLE, State.SILENT} and not components.requests.asking
        if self._unusable or ((self._operator.shutdown or components.dead_tasks) and handed_over):
            components.over.set()


def _raise_failure(components: Components) -> None:
    """Raises DaemonError unless the flight ended normally."""
    if components.dead_tasks:
        deaths = "; ".join(f"{name}: {why}" for name, why in components.dead_tasks.items())
        raise DaemonError(f"flockd ended because a task died ({deaths}); read its log")
    if Event.NO_ANSWER in {reason.event for reason in components.control.decision.reasons}:
        raise DaemonError(
            "the autopilot did not confirm Hold; flockd stopped sending setpoints, so that its failsafe acts; check it"
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
        await asyncio.wait(tasks)
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
